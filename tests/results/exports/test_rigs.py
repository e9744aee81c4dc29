"""Tests of exports of models with rigs, which COLMAP formats keep and other formats drop."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest

from mpsfm_core.inputs.rigs import read_rigs
from mpsfm_core.results.exports.formats import export

FRAME = ["a/0.png", "a/1.jpg"]


def read_poses(folder: Path) -> dict[str, np.ndarray]:
    """Read the pose matrix of each image from an export, in the convention of its format."""
    transforms = folder / "transforms.json"
    if transforms.is_file():
        frames = json.loads(transforms.read_text(encoding="utf-8"))["frames"]
        return {frame["file_path"]: np.array(frame["transform_matrix"]) for frame in frames}
    model = pycolmap.Reconstruction(str(folder / "sparse" / "0"))
    return {image.name: image.cam_from_world().matrix() for image in model.images.values()}


def test_model_of_the_result_has_the_rig(rig_result: Path) -> None:
    model = pycolmap.Reconstruction(str(rig_result / "sparse"))
    sensors = [rig.num_sensors() for rig in model.rigs.values()]
    assert sorted(sensors)[-1] == 2
    (rig,) = read_rigs(rig_result / "sparse", FRAME, None)
    assert rig.frames == (tuple(FRAME),)


def test_colmap_text_and_database_keep_the_rig(rig_result: Path, tmp_path: Path) -> None:
    export(rig_result, "colmap-text", tmp_path / "text", turn=False)
    (rig,) = read_rigs(tmp_path / "text", FRAME, None)
    export(rig_result, "colmap-db", tmp_path / "database", turn=False)
    (path,) = (tmp_path / "database").glob("*.db")
    (stored,) = read_rigs(path, FRAME, None)
    assert rig.frames == stored.frames == (tuple(FRAME),)
    for ours, theirs in zip(rig.sensor_poses, stored.sensor_poses, strict=True):
        np.testing.assert_allclose(ours[0], theirs[0], atol=1e-9)
        np.testing.assert_allclose(ours[1], theirs[1], atol=1e-9)


@pytest.mark.parametrize("format_name", ["gsplat", "nerfstudio"])
def test_formats_of_single_images_have_the_poses_of_the_rig(
    rig_result: Path, result: Path, tmp_path: Path, format_name: str
) -> None:
    for folder, name in ((rig_result, "rig"), (result, "single")):
        export(folder, format_name, tmp_path / name, turn=False)
    rig, single = (read_poses(tmp_path / name) for name in ("rig", "single"))
    assert rig.keys() == single.keys() and len(rig) == 3
    for name, pose in rig.items():
        np.testing.assert_allclose(pose, single[name], atol=1e-9)


def test_gsplat_loader_reads_images_of_a_rig_as_perspective(
    rig_result: Path, tmp_path: Path
) -> None:
    """Follow the steps of ``Parser`` in gsplat's examples/datasets/colmap.py."""
    export(rig_result, "gsplat", tmp_path)
    manager = pycolmap.Reconstruction(str(tmp_path / "sparse" / "0"))
    perspective = {
        pycolmap.CameraModelId.SIMPLE_PINHOLE,
        pycolmap.CameraModelId.PINHOLE,
        pycolmap.CameraModelId.SIMPLE_RADIAL,
        pycolmap.CameraModelId.RADIAL,
        pycolmap.CameraModelId.OPENCV,
    }
    row_of_point = {number: row for row, number in enumerate(manager.points3D)}
    names = []
    for image in manager.images.values():
        camera = manager.cameras[image.camera_id]
        assert camera.model in perspective
        pixels = cv2.imread(str(tmp_path / "images" / image.name))
        assert pixels is not None
        assert pixels.shape[:2] == (camera.height, camera.width)
        cam_from_world = image.cam_from_world().matrix()
        matrix = camera.calibration_matrix()
        for observation in image.get_observation_points2D():
            row_of_point[observation.point3D_id]
            point = manager.points3D[observation.point3D_id].xyz
            projected = matrix @ (cam_from_world @ np.append(point, 1.0))
            np.testing.assert_allclose(projected[:2] / projected[2], observation.xy, atol=1e-3)
        names.append(image.name)
    assert len(names) == 3
