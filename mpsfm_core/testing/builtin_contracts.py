"""How the contracts of the built-in providers are checked."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from mpsfm_core.testing.case import Setup
from mpsfm_core.testing.examples import Example
from mpsfm_core.testing.painting import NORMALS_STD, RELATIVE_STD


def depth_files(folder: Path) -> Setup:
    """Depth in metres with its variance, in an NPZ beside each view's name."""

    def tell(example: Example) -> None:
        truth = example.truth()
        variance = (RELATIVE_STD * truth.depth) ** 2
        _save(folder, example, depth=truth.depth, variance=variance, valid=truth.valid)

    return Setup(options={"directory": folder}, knows="told", tell=tell)


def normal_files(folder: Path) -> Setup:
    """Normals with their variance, likewise."""

    def tell(example: Example) -> None:
        truth = example.truth()
        variance = np.full(truth.valid.shape, NORMALS_STD**2)
        _save(folder, example, normals=truth.normals, variance=variance, valid=truth.valid)

    return Setup(options={"directory": folder}, knows="told", tell=tell)


def mask_files(folder: Path) -> Setup:
    """Masks of what has a surface, likewise."""
    return Setup(
        options={"directory": folder},
        knows="told",
        tell=lambda example: _save(folder, example, mask=example.truth().valid),
    )


def from_depth(folder: Path) -> Setup:
    """Is right wherever the depth it is given is right."""
    return Setup(knows="seen")


def depth_of_matcher(folder: Path) -> Setup:
    """Only stands for a choice in the configuration."""
    reason = "one view has no matches: the extraction asks the matcher for its pairs instead"
    return Setup(expected_failures={"output-rules": reason})


def depth_of_multiview(folder: Path) -> Setup:
    """Only stands for a choice in the configuration."""
    reason = "one view is no group: the extraction asks the multi-view network instead"
    return Setup(expected_failures={"output-rules": reason})


def _save(folder: Path, example: Example, **arrays: Any) -> None:
    path = folder / f"{example.name}.npz"
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savez(path, **arrays)
