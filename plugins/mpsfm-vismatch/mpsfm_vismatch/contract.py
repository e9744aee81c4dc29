"""Contract setups without weights."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path

from mpsfm_core.testing import ContractSetup

_REAL = "sift-nn"
_STAND_IN = "mpsfm_vismatch.stand_in"
_SMALL = {"network": f"{_STAND_IN}:Matching", "resize": 96}
"""Small size, so that comparing all pixels is quick."""


def vismatch(folder: Path) -> ContractSetup:
    """Use a matcher of the collection without weights, or a stand-in if it is not installed."""
    return ContractSetup(
        options={"network": _REAL} if find_spec("vismatch") else _SMALL, truth_source="image"
    )


def vismatch_sparse(folder: Path) -> ContractSetup:
    """Use the same matcher at keypoints of any detector."""
    options = {"network": _REAL} if find_spec("vismatch") else _SMALL
    return ContractSetup(options={**options, "snap_px": 3.0}, truth_source="image")


def vismatch_roma(folder: Path) -> ContractSetup:
    """Use a symmetric stand-in with every position of a coarse grid."""
    options = {"network": f"{_STAND_IN}:Warping", "cell": 1, "min_certainty": 0.5}
    return ContractSetup(options=options, truth_source="image")


def vismatch_roma_sparse(folder: Path) -> ContractSetup:
    """Use the same stand-in with a larger snap distance for its coarse grid."""
    options = {"network": f"{_STAND_IN}:Warping", "snap_px": 3.0, "min_certainty": 0.5}
    return ContractSetup(options=options, truth_source="image")


def vismatch_mast3r(folder: Path) -> ContractSetup:
    """Use a small stand-in, so that comparing all pixels is quick."""
    return ContractSetup(
        options={"network": f"{_STAND_IN}:Pointing", "size": 128}, truth_source="image"
    )


def vismatch_mast3r_sparse(folder: Path) -> ContractSetup:
    """Use the same stand-in at keypoints of any detector."""
    return ContractSetup(
        options={"network": f"{_STAND_IN}:Pointing", "size": 128}, truth_source="image"
    )
