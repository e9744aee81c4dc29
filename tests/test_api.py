"""The names that ``mpsfm_core`` exports, and the signature of its functions."""

from __future__ import annotations

import inspect
import subprocess
import sys

import pytest

import mpsfm_core
from mpsfm_core.pipeline import run

LIGHT_IMPORT = """
import sys
import mpsfm_core
heavy = {"torch", "numba", "scipy.optimize", "mpsfm_core.mapping", "mpsfm_core.pipeline.run"}
assert not heavy & sys.modules.keys(), heavy & sys.modules.keys()
"""


@pytest.mark.parametrize("name", mpsfm_core.__all__)
def test_exported_name_exists(name: str) -> None:
    assert getattr(mpsfm_core, name) is not None


def test_unknown_name_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="no attribute 'unknown'"):
        mpsfm_core.unknown  # noqa: B018


def test_import_loads_nothing_heavy() -> None:
    subprocess.run([sys.executable, "-c", LIGHT_IMPORT], check=True)


def test_reconstruct_has_the_signature_of_the_pipeline() -> None:
    public, internal = (
        inspect.signature(function) for function in (mpsfm_core.reconstruct, run.reconstruct)
    )
    assert list(public.parameters) == list(internal.parameters)
    for name, parameter in public.parameters.items():
        assert parameter.default == internal.parameters[name].default
        assert parameter.kind == internal.parameters[name].kind
