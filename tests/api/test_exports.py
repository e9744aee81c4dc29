"""Tests of the names that ``mpsfm_core`` exports."""

from __future__ import annotations

import subprocess
import sys

import pytest

import mpsfm_core

LIGHT_IMPORT = """
import sys
import mpsfm_core
heavy = {"torch", "numba", "cv2", "pycolmap", "numpy", "pydantic", "pluggy", "mpsfm_core.data"}
assert not heavy & sys.modules.keys(), heavy & sys.modules.keys()
"""


@pytest.mark.parametrize("name", mpsfm_core.__all__)
def test_exported_name_exists(name: str) -> None:
    assert getattr(mpsfm_core, name) is not None
    assert name in dir(mpsfm_core)


def test_unknown_name_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="no attribute 'unknown'"):
        mpsfm_core.unknown  # noqa: B018


def test_import_loads_nothing_heavy() -> None:
    subprocess.run([sys.executable, "-c", LIGHT_IMPORT], check=True)


def test_help_imports_neither_numpy_nor_pydantic() -> None:
    script = (
        "import sys\n"
        "from mpsfm_core.cli import build_app\n"
        "build_app()(['--help'], standalone_mode=False)\n"
        "print({'numpy', 'pydantic', 'mpsfm_core.providers'} & sys.modules.keys())"
    )
    ended = subprocess.run([sys.executable, "-c", script], check=True, capture_output=True)
    assert ended.stdout.splitlines()[-1] == b"set()"


COMPRESSION = """
import mpsfm_core
import pycolmap
import io, numpy
numpy.savez_compressed(io.BytesIO(), a=numpy.random.default_rng(0).random((1000, 100)))
"""


def test_compression_works_if_pycolmap_is_imported_later() -> None:
    subprocess.run([sys.executable, "-c", COMPRESSION], check=True)


def test_import_after_pycolmap_warns() -> None:
    """A stand-in for pycolmap, because the real one aborts the process."""
    script = "import sys; sys.modules['pycolmap'] = sys; import mpsfm_core"
    ended = subprocess.run([sys.executable, "-c", script], check=True, capture_output=True)
    assert b"import mpsfm_core or zlib before pycolmap" in ended.stderr
