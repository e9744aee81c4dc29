"""Tests of reconstructions of real photos with the depth network FastDepth."""

from __future__ import annotations

from pathlib import Path

import pycolmap
import pytest

from mpsfm_core.evaluation import evaluate, read_poses
from mpsfm_core.evaluation.scene_folder import read_scene

pytestmark = pytest.mark.slow


@pytest.fixture
def reconstruct(mpsfm, shared_data: Path, tmp_path: Path):
    """Function that reconstructs a scene with FastDepth and returns the result folder."""
    pytest.importorskip("mpsfm_onnx")

    def run(scene: str, *settings: str, images: Path | None = None) -> Path:
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
            *(["--image-list", images] if images else []),
            *[argument for change in changes for argument in ("--set", change)],
            timeout=1200,
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


def test_room_with_motion_blur(reconstruct, shared_data: Path, tmp_path: Path) -> None:
    pytest.importorskip("mpsfm_kornia")
    room = shared_data / "data" / "hololens_room"
    names = read_scene(room).select_sets(["all"])[0].images
    listed = tmp_path / "images.txt"
    listed.write_text("\n".join(names))
    output = reconstruct("hololens_room", "features.options.max_keypoints=1500", images=listed)
    report = evaluate(read_poses(output), read_poses(room / "gt"), names)
    assert report["registered"] >= 0.8 * len(names)
    assert report["auc"]["20"] > 6  # 4 to 11 with COLMAP (benchmarks/results)
    assert pycolmap.Reconstruction(str(output / "sparse")).num_reg_images() == report["registered"]
