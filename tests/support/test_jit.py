"""Tests of the kernel cache with kernels of an earlier version of the code."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from mpsfm_core.optimize import resection
from mpsfm_core.support import jit

MODULE = """
from typing import NamedTuple
import numpy as np
from mpsfm_core.support.jit import kernel

class {name}(NamedTuple):
    values: np.ndarray

@kernel()
def total(pair):
    return pair.values.sum()

print(total({name}(np.ones(3))))
"""


def test_kernel_whose_cached_type_was_renamed_is_compiled_again(tmp_path: Path) -> None:
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "cache")}
    module = tmp_path / "kernels.py"
    for name in ("Earlier", "Later"):
        module.write_text(MODULE.format(name=name))
        run = subprocess.run(
            [sys.executable, "-c", "import kernels"],
            env=environment,
            cwd=tmp_path,
            capture_output=True,
            text=True,
            check=False,
        )
        assert run.stdout.strip() == "3.0", run.stderr


def test_kernel_depends_on_constants_and_functions_that_it_uses(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Numba compares only the file of a kernel, not the files that the kernel imports from."""
    function = resection.linearize_pose.py_func  # type: ignore[attr-defined]
    before = jit.describe_globals(function)
    assert before == jit.describe_globals(function)
    monkeypatch.setattr(resection, "MIN_DEPTH", 2.0)
    changed = set(jit.describe_globals(function)) - set(before)
    assert changed == {"mpsfm_core.optimize.resection.MIN_DEPTH = 2.0"}
