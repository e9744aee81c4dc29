"""Whole reconstructions of real photos with a small real depth network."""

from __future__ import annotations

from pathlib import Path

import pycolmap
import pytest

from mpsfm_core.evaluation import evaluate, read_poses

pytestmark = pytest.mark.slow


@pytest.fixture
def reconstruct(mpsfm, shared_data: Path, tmp_path: Path):
    """Reconstructs a scene of the shared data with FastDepth; gives the output folder."""
    pytest.importorskip("mpsfm_onnx")

    def run(scene: str, *settings: str) -> Path:
        folder = shared_data / "data" / scene
        model = shared_data / "models" / "fastdepth_224.onnx"
        changes = [f"depth.options.model={model}", *settings]
        ended = mpsfm(
            "reconstruct",
            folder / "images",
            "--intrinsics",
            folder / "intrinsics.yaml",
            "--output",
            tmp_path / "out",
            "--config",
            "fast-cpu",
            *[argument for change in changes for argument in ("--set", change)],
        )
        assert ended.code == 0, ended.err
        return tmp_path / "out"

    return run


def test_fountain_with_sift(reconstruct, shared_data: Path) -> None:
    output = reconstruct("fountain", "features.use=sift", "matcher.use=mutual-nearest")
    report = evaluate(read_poses(output), read_poses(shared_data / "data" / "fountain" / "gt"))
    assert report["registered"] == 11
    assert report["auc"]["1"] > 90
    assert report["auc"]["5"] > 97


def test_kitchen_with_hardly_any_overlap(reconstruct) -> None:
    pytest.importorskip("mpsfm_kornia")
    model = pycolmap.Reconstruction(str(reconstruct("kitchen_example") / "sparse"))
    assert model.num_reg_images() == 6
    assert model.compute_mean_reprojection_error() < 2
