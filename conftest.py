"""Give all tests of the repository the same environment, whatever the user's shell has set."""

from __future__ import annotations

import os
import shutil
import sys
import tempfile
import time
from pathlib import Path

import pytest

_KEPT = frozenset(
    (
        *("PATH", "PYTHONPATH", "PYTHONDONTWRITEBYTECODE", "VIRTUAL_ENV"),
        *("TMPDIR", "TEMP", "TMP", "SYSTEMROOT", "PATHEXT", "COMSPEC", "WINDIR"),
        *("LD_LIBRARY_PATH", "DYLD_LIBRARY_PATH", "NUMBA_NUM_THREADS", "NUMBA_CACHE_DIR"),
        *("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "MPSFM_SHARED"),
    )
)
"""Variables that name programs, libraries, thread limits and test data."""
_KEPT_PREFIXES = ("PYTEST_", "COV_", "COVERAGE_", "CUDA_", "NVIDIA_")
"""Prefixes of the variables of pytest, of its plugins and of GPU drivers."""
_SHARED_DATA = Path(__file__).resolve().parents[1] / "shared"
"""Default folder of scenes and models that the repository does not contain."""


def _replace_environment(home: Path) -> None:
    """Replace environment variables, umask and time zone of this process.

    Processes that tests start inherit the environment.
    """
    for name in set(os.environ) - _KEPT:
        if not name.startswith(_KEPT_PREFIXES):
            del os.environ[name]
    os.environ |= {"HOME": str(home), "LANG": "C.UTF-8", "TZ": "UTC", "MPLBACKEND": "agg"}
    os.umask(0o022)
    if hasattr(time, "tzset"):
        time.tzset()


# pytest imports this module before the test modules, whose libraries read the environment.
_HOME = Path(tempfile.mkdtemp(prefix="mpsfm-tests-home-"))
_replace_environment(_HOME)


def pytest_configure(config: pytest.Config) -> None:
    """Start pytest again in UTF-8 mode if the locale encodes file names differently."""
    if sys.getfilesystemencoding() != "utf-8":
        shutil.rmtree(_HOME)
        config.pluginmanager.getplugin("capturemanager").stop_global_capturing()
        os.execve(sys.executable, sys.orig_argv, {**os.environ, "PYTHONUTF8": "1"})


def pytest_unconfigure() -> None:
    """Remove the home folder of the tests."""
    shutil.rmtree(_HOME, ignore_errors=True)


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Return the folder of real scenes and models, ``$MPSFM_SHARED`` or ``../shared``."""
    folder = Path(os.environ.get("MPSFM_SHARED", _SHARED_DATA))
    if not folder.is_dir():
        pytest.skip("no shared scenes and models here (set MPSFM_SHARED)")
    return folder
