"""Tests of the names that ``mpsfm_core`` exports."""

from __future__ import annotations

import subprocess
import sys

import pytest

import mpsfm_core

LIGHT_IMPORT = """
import sys
import mpsfm_core
heavy = {"torch", "numba", "cv2", "pycolmap", "mpsfm_core.api", "mpsfm_core.pipeline.run"}
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
