"""ContractSetup functions for the built-in providers."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from mpsfm_core.testing.contract_case import ContractSetup
from mpsfm_core.testing.examples import Example
from mpsfm_core.testing.painted_views import NORMALS_STD, RELATIVE_STD


def depth_files(folder: Path) -> ContractSetup:
    """Return a ContractSetup that writes metric depth with variance to an NPZ file per view."""

    def write_truth(example: Example) -> None:
        truth = example.truth()
        variance = (RELATIVE_STD * truth.depth) ** 2
        _save(folder, example, depth=truth.depth, variance=variance, valid=truth.valid)

    return ContractSetup(
        options={"directory": folder}, truth_source="prepared", prepare=write_truth
    )


def normal_files(folder: Path) -> ContractSetup:
    """Return a ContractSetup that writes normals with variance to an NPZ file per view."""

    def write_truth(example: Example) -> None:
        truth = example.truth()
        variance = np.full(truth.valid.shape, NORMALS_STD**2)
        _save(folder, example, normals=truth.normals, variance=variance, valid=truth.valid)

    return ContractSetup(
        options={"directory": folder}, truth_source="prepared", prepare=write_truth
    )


def mask_files(folder: Path) -> ContractSetup:
    """Return a ContractSetup that writes the mask of all surfaces to an NPZ file per view."""
    return ContractSetup(
        options={"directory": folder},
        truth_source="prepared",
        prepare=lambda example: _save(folder, example, mask=example.truth().valid),
    )


def from_depth(folder: Path) -> ContractSetup:
    """Return a ContractSetup for normals from depth, which are correct if the depth is correct."""
    return ContractSetup(truth_source="image")


def depth_of_matcher(folder: Path) -> ContractSetup:
    """Return a ContractSetup in which prediction from one view is expected to fail."""
    reason = "one view has no matches: the extraction uses the pairs of the matcher instead"
    return ContractSetup(expected_failures={"output-rules": reason})


def depth_of_multiview(folder: Path) -> ContractSetup:
    """Return a ContractSetup in which prediction from one view is expected to fail."""
    reason = "one view is no group: the extraction runs the multi-view network instead"
    return ContractSetup(expected_failures={"output-rules": reason})


def _save(folder: Path, example: Example, **arrays: Any) -> None:
    path = folder / f"{example.name}.npz"
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savez(path, **arrays)
