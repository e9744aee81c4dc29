"""How the contract kit tests the providers without published weights: on tiny models of the same
families with random ones. They predict and match, and it means nothing."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from mpsfm_core.testing import Setup
from mpsfm_core.testing.examples import Example
from mpsfm_transformers import stand_in


def transformers(folder: Path) -> Setup:
    """Depth Pro, which depends on the focal length and tells it."""
    return Setup(options={"model": str(stand_in.depth_pro(folder / "depth_pro"))}, knows="nothing")


def prompt_depth_anything(folder: Path) -> Setup:
    """The sensor sees the truth, coarsely."""

    def tell(example: Example) -> None:
        path = (folder / "sensor" / example.view.name).with_suffix(".npy")
        path.parent.mkdir(parents=True, exist_ok=True)
        truth = example.truth()
        np.save(path, np.where(truth.valid, truth.depth, 0))

    model = stand_in.prompt_depth_anything(folder / "prompt_depth_anything")
    options = {"model": str(model), "directory": str(folder / "sensor")}
    return Setup(options=options, knows="nothing", tell=tell)


def superpoint_hub(folder: Path) -> Setup:
    """A detector that finds something everywhere."""
    model = stand_in.superpoint(folder / "superpoint")
    return Setup(options={"model": str(model), "max_keypoints": 300}, knows="nothing")


def lightglue_superpoint_hub(folder: Path) -> Setup:
    """For descriptors of SuperPoint."""
    return Setup(options={"model": str(stand_in.lightglue(folder / "lightglue"))}, knows="nothing")


def superglue(folder: Path) -> Setup:
    """For descriptors of SuperPoint."""
    return Setup(options={"model": str(stand_in.superglue(folder / "superglue"))}, knows="nothing")


def efficient_loftr(folder: Path) -> Setup:
    """On small images."""
    model = stand_in.efficient_loftr(folder / "efficient_loftr")
    return Setup(options={"model": str(model), "resize": 128}, knows="nothing")


def dino(folder: Path) -> Setup:
    """A few random layers still tell a room from another."""
    return Setup(options={"model": str(stand_in.dino(folder / "dino"))}, knows="nothing")
