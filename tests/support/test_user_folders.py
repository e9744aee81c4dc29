"""Tests with container accounts: no passwd entry, no home, or a home without write access."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from mpsfm_core.support.user_folders import user_cache_folder, user_data_folder

ROOT = Path(__file__).resolve().parents[2]
UID = "54321"
"""Return a user id without a passwd entry."""
IMPORT_KERNELS = (
    "import mpsfm_core.dense.stereo_kernels, mpsfm_core.optimize.bundle_kernels, numba;"
    "print(numba.config.CACHE_DIR)"
)

needs_root = pytest.mark.skipif(
    not hasattr(os, "geteuid") or os.geteuid() != 0 or shutil.which("setpriv") is None,
    reason="changing the user id needs root and setpriv",
)


def run_without_account(*command: str, **environment: str) -> subprocess.CompletedProcess[str]:
    """Run Python as a user id without a passwd entry, with only the given environment variables."""
    change_user = ["setpriv", f"--reuid={UID}", f"--regid={UID}", "--clear-groups"]
    return subprocess.run(
        [*change_user, sys.executable, *command],
        env={"PATH": os.defpath, "PYTHONPATH": str(ROOT), **environment},
        capture_output=True,
        text=True,
        check=False,
        timeout=300,
    )


def make_writable(folder: Path) -> Path:
    """Allow every user to read and write a folder."""
    folder.mkdir(exist_ok=True)
    folder.chmod(0o777)
    for parent in folder.parents:
        if parent != Path("/tmp") and parent.is_relative_to("/tmp"):
            parent.chmod(0o755)
    return folder


@needs_root
def test_doctor_runs_without_an_account(tmp_path: Path) -> None:
    cache = make_writable(tmp_path / "cache")
    result = run_without_account("-m", "mpsfm_core", "doctor", MPSFM_CACHE=str(cache))
    assert result.returncode == 0, result.stderr
    assert "internal error" not in result.stderr


@needs_root
def test_kernels_are_kept_in_the_cache_folder(tmp_path: Path) -> None:
    cache = make_writable(tmp_path / "cache")
    result = run_without_account("-c", IMPORT_KERNELS, MPSFM_CACHE=str(cache))
    assert result.returncode == 0, result.stderr
    assert result.stdout.strip() == str(cache / "kernels")
    assert result.stderr == ""


@needs_root
@pytest.mark.parametrize("home", ["/proc", "/nonexistent"])
def test_home_that_cannot_be_written_is_one_warning(home: str) -> None:
    result = run_without_account("-c", IMPORT_KERNELS, HOME=home)
    assert result.returncode == 0, result.stderr
    (warning,) = result.stderr.splitlines()
    assert "set MPSFM_CACHE" in warning


@needs_root
def test_account_without_home_and_cache_is_one_warning() -> None:
    result = run_without_account("-c", IMPORT_KERNELS)
    assert result.returncode == 0, result.stderr
    (warning,) = result.stderr.splitlines()
    assert "no home folder" in warning and "MPSFM_CACHE" in warning


def test_cache_variable_is_used(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("MPSFM_CACHE", str(tmp_path))
    assert user_cache_folder() == tmp_path
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("MPSFM_CACHE", "~/cache")
    assert user_cache_folder() == tmp_path / "cache"
    monkeypatch.delenv("XDG_DATA_HOME", raising=False)
    assert user_data_folder().is_relative_to(tmp_path)
