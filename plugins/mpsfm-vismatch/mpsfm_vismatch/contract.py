"""Matchers without learned weights for the provider contract tests."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path

from mpsfm_core.testing import ContractSetup

_REAL = "sift-nn"
_STAND_IN = "mpsfm_vismatch.stand_in"
_SMALL = {"network": f"{_STAND_IN}:Matching", "resize": 128}
"""Options of a matcher with small images, where comparing all pixels is fast."""
_NOT_INVARIANT = {"matcher-sizes": "comparing patches is not invariant to scale"}
_TOO_COARSE = {
    **_NOT_INVARIANT,
    "matcher-large-view": "the patches of the small images are too coarse to snap keypoints",
}


def vismatch(folder: Path) -> ContractSetup:
    """Return vismatch's matcher ``sift-nn``, or a patch matcher if vismatch is not installed."""
    return ContractSetup(
        options={"network": _REAL} if find_spec("vismatch") else _SMALL, truth_source="image"
    )


def vismatch_sparse(folder: Path) -> ContractSetup:
    """Return options that match given keypoints by ``sift-nn``, or by a patch matcher."""
    options = {"network": _REAL} if find_spec("vismatch") else _SMALL
    return ContractSetup(
        options={**options, "snap_px": 3.0},
        truth_source="image",
        expected_failures={} if find_spec("vismatch") else _TOO_COARSE,
    )


def vismatch_roma(folder: Path) -> ContractSetup:
    """Return a patch matcher with RoMa's symmetric warp, sampled at every grid position."""
    options = {"network": f"{_STAND_IN}:Warping", "cell": 1, "min_certainty": 0.5}
    return ContractSetup(options=options, truth_source="image")


def vismatch_roma_sparse(folder: Path) -> ContractSetup:
    """Return a patch matcher with RoMa's warp for keypoints within 3 pixels of the warp."""
    return ContractSetup(
        options={"network": f"{_STAND_IN}:Warping", "snap_px": 3.0, "min_certainty": 0.5},
        truth_source="image",
        expected_failures=_TOO_COARSE,
    )


def vismatch_mast3r(folder: Path) -> ContractSetup:
    """Return a patch matcher with MASt3R's outputs, for small images."""
    return ContractSetup(
        options={"network": f"{_STAND_IN}:Pointing", "size": 128}, truth_source="image"
    )


def vismatch_mast3r_sparse(folder: Path) -> ContractSetup:
    """Return a patch matcher with MASt3R's outputs, for given keypoints."""
    return ContractSetup(
        options={"network": f"{_STAND_IN}:Pointing", "size": 128},
        truth_source="image",
        expected_failures=_NOT_INVARIANT,
    )
