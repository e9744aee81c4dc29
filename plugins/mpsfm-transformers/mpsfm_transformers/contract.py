"""Tiny models of the supported architectures for the provider contract tests.

The weights are random, so predictions are valid but not accurate.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from mpsfm_core.testing import ContractSetup
from mpsfm_core.testing.examples import Example
from mpsfm_transformers import stand_in


def transformers(folder: Path) -> ContractSetup:
    """Write a tiny Depth Pro, which uses and also estimates the focal length."""
    return ContractSetup(
        options={"model": str(stand_in.depth_pro(folder / "depth_pro"))}, truth_source="none"
    )


def prompt_depth_anything(folder: Path) -> ContractSetup:
    """Write a tiny Prompt Depth Anything, and the true depth of test images as sensor depth."""

    def write_depth(example: Example) -> None:
        path = (folder / "sensor" / example.view.name).with_suffix(".npy")
        path.parent.mkdir(parents=True, exist_ok=True)
        truth = example.truth()
        np.save(path, np.where(truth.valid, truth.depth, 0))

    model = stand_in.prompt_depth_anything(folder / "prompt_depth_anything")
    options = {"model": str(model), "directory": str(folder / "sensor")}
    return ContractSetup(options=options, truth_source="none", prepare=write_depth)


def superpoint_hub(folder: Path) -> ContractSetup:
    """Write a tiny SuperPoint that detects keypoints everywhere."""
    model = stand_in.superpoint(folder / "superpoint")
    return ContractSetup(options={"model": str(model), "max_keypoints": 300}, truth_source="none")


def lightglue_superpoint_hub(folder: Path) -> ContractSetup:
    """Write a tiny LightGlue for SuperPoint descriptors."""
    return ContractSetup(
        options={"model": str(stand_in.lightglue(folder / "lightglue"))}, truth_source="none"
    )


def superglue(folder: Path) -> ContractSetup:
    """Write a tiny SuperGlue for SuperPoint descriptors."""
    return ContractSetup(
        options={"model": str(stand_in.superglue(folder / "superglue"))}, truth_source="none"
    )


def efficient_loftr(folder: Path) -> ContractSetup:
    """Write a tiny Efficient LoFTR for small images."""
    model = stand_in.efficient_loftr(folder / "efficient_loftr")
    return ContractSetup(options={"model": str(model), "resize": 128}, truth_source="none")


def dino(folder: Path) -> ContractSetup:
    """Write a DINOv2 with a few random layers, which distinguish two scenes well enough."""
    return ContractSetup(
        options={"model": str(stand_in.dino(folder / "dino"))}, truth_source="none"
    )
