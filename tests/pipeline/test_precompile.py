"""Tests of background compilation of kernels, and of kernels without a disk cache."""

from __future__ import annotations

import logging
import os
import subprocess
import sys
from pathlib import Path

import numba.core.caching
import pytest

from mpsfm_core.pipeline.precompile import Compilation
from mpsfm_core.support import jit

RUNS_WITHOUT_COMPILING = """
import sys
from pathlib import Path
from numba.core import event
from mpsfm_core.cli.demo import demo
from mpsfm_core.pipeline.precompile import start_compilation
assert start_compilation() is None
with event.install_recorder("numba:compile") as compiled:
    demo(Path(sys.argv[1]), offline=True, quiet=True)
kernels = [e.data["dispatcher"].py_func.__name__ for _, e in compiled.buffer if e.is_start]
assert not kernels, kernels
"""


def finished(code: int) -> subprocess.Popen[bytes]:
    return subprocess.Popen([sys.executable, "-c", f"raise SystemExit({code})"])


def test_compilation_that_failed_leaves_no_stamp(tmp_path: Path) -> None:
    stamp = tmp_path / "stamp"
    Compilation((finished(0), finished(1)), stamp).wait()
    assert not stamp.exists()
    Compilation((finished(0), finished(0)), stamp).wait()
    assert stamp.exists()


def test_stop_ends_running_processes(tmp_path: Path) -> None:
    process = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(600)"])
    Compilation((process, finished(0)), tmp_path / "stamp").stop()
    assert process.returncode


def test_kernel_without_disk_cache_works_and_warns(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(numba.core.caching.CacheImpl, "_locator_classes", [])
    jit._warn_without_cache.cache_clear()

    @jit.kernel()
    def double(x: float) -> float:
        return 2.0 * x

    with caplog.at_level(logging.WARNING):
        assert double(21.0) == 42.0
    assert "MPSFM_CACHE" in caplog.text


@pytest.mark.slow
def test_run_after_precompilation_compiles_nothing(tmp_path: Path) -> None:
    """Depth maps of the sample scene are downsampled and cached, like those of other photos."""
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path / "kernels")}
    subprocess.run(
        [sys.executable, "-m", "mpsfm_core.pipeline.precompile"], env=environment, check=True
    )
    run = [sys.executable, "-c", RUNS_WITHOUT_COMPILING, str(tmp_path / "demo")]
    subprocess.run(run, env=environment, check=True)
