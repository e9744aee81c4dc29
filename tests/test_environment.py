"""Test that a user's shell does not change the outcome of tests."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
HOSTILE = {
    "MPSFM_OFFLINE": "1",
    "HF_HUB_OFFLINE": "1",
    "MPSFM_CACHE": "/dev/null/cache",
    "MPSFM_EXPORTS": "/dev/null/exports",
    "MPSFM_ENVIRONMENTS": "/dev/null/environments",
    "MPSFM_PLUGIN_TIMEOUT_S": "soon",
    "MPSFM_PAIR_SCORES": "/dev/null/scores",
    "HOME": "/dev/null/home",
    "XDG_CACHE_HOME": "/dev/null/cache",
    "XDG_DATA_HOME": "/dev/null/data",
    "TZ": "Pacific/Chatham",
    "PYTHONIOENCODING": "cp1252",
    "PYTHONWARNINGS": "error",
    "NO_COLOR": "1",
    "FORCE_COLOR": "1",
    "COLUMNS": "37",
    "TERM": "dumb",
    "HTTP_PROXY": "http://127.0.0.1:9",
    "HTTPS_PROXY": "http://127.0.0.1:9",
    "ALL_PROXY": "socks5://127.0.0.1:9",
    "MPLBACKEND": "TkAgg",
    "NUMBA_DISABLE_JIT": "1",
    "OPENCV_LOG_LEVEL": "DEBUG",
}
LOCALES = {
    "turkish": {"LANG": "tr_TR.ISO-8859-9", "LC_ALL": "tr_TR.ISO-8859-9"},
    "ascii, no home": {
        "HOME": None,
        "LC_ALL": "C",
        "PYTHONUTF8": "0",
        "PYTHONCOERCECLOCALE": "0",
    },
}
TESTS = (
    "tests/config/test_configs.py::test_shipped_configuration_resolves_offline",
    "tests/cli/test_encodings.py::test_names_that_are_not_utf8_are_reported_and_skipped",
    "tests/test_environment.py::test_process_has_the_environment_of_the_tests",
)


def test_process_has_the_environment_of_the_tests(tmp_path: Path) -> None:
    allowed = {"HOME", "LANG", "LC_CTYPE", "TZ", "MPLBACKEND", "MPSFM_SHARED", "NUMBA_CACHE_DIR"}
    assert not (HOSTILE.keys() | {"LC_ALL", "LANGUAGE"}) & os.environ.keys() - allowed
    assert os.access(Path.home(), os.W_OK)
    (tmp_path / "\u03b1").touch()
    assert (tmp_path / "\u03b1").stat().st_mode & 0o777 == 0o644


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(LOCALES))
def test_hostile_shell_changes_no_outcome(name: str) -> None:
    changed = {**HOSTILE, **LOCALES[name]}
    kept = {key: value for key, value in os.environ.items() if key != "HOME"}
    environment = kept | {key: value for key, value in changed.items() if value is not None}
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", *TESTS]
    before = os.umask(0o077)
    try:
        ended = subprocess.run(
            command, env=environment, cwd=ROOT, capture_output=True, text=True, check=False
        )
    finally:
        os.umask(before)
    assert ended.returncode == 0, ended.stdout[-3000:] + ended.stderr[-1000:]
    assert " passed" in ended.stdout
