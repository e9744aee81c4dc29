"""Tests of densification of a COLMAP model without depth maps."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from mpsfm_core.cli import build_app
from mpsfm_core.data import DepthPrior
from mpsfm_core.data.errors import InputError
from mpsfm_core.dense.depth_range import depth_prior_from_points
from mpsfm_core.geometry import project, transform
from mpsfm_core.geometry.pycolmap_conversion import colmap_from_pinhole
from mpsfm_core.pipeline.dense_models import densify_model
from mpsfm_core.results.colmap_model import build_model, write_model
from mpsfm_core.results.ply import read_ply
from mpsfm_core.testing.synthetic.scenes import room_scene


@pytest.fixture
def model(room, tmp_path: Path) -> Path:
    """Write a COLMAP model `sparse/` with exact poses and points of the room, and `photos/`."""
    images = room.reconstruction.images
    first = images[0]
    camera = first.camera
    pose = np.column_stack([first.rotation, first.translation])
    xy = np.random.default_rng(0).uniform((2, 2), (camera.width - 2, camera.height - 2), (300, 2))
    points = room_scene().sample(camera, pose, xy).points
    ids = np.arange(len(points))
    seen = [project(camera, transform(i.rotation, i.translation, points)) for i in images]
    registered = tuple(replace(image, point_ids=ids) for image in images)
    sparse = replace(
        room.reconstruction, images=registered, points=points, errors_px=np.zeros(len(points))
    )
    colors = np.zeros((len(points), 3), np.uint8)
    built = build_model(sparse, [colmap_from_pinhole(camera)] * len(images), seen, colors)
    write_model(tmp_path / "sparse", built)
    (tmp_path / "photos").mkdir()
    for name, view in room.views.items():
        cv2.imwrite(str(tmp_path / "photos" / name), cv2.cvtColor(view.image, cv2.COLOR_RGB2BGR))
    return tmp_path


def test_dense_command_uses_depth_range_of_points(room, model: Path) -> None:
    arguments = ["dense", str(model), str(model / "photos"), "-o", str(model / "out")]
    result = CliRunner().invoke(build_app(), arguments)
    assert result.exit_code == 0 and "confirmed" in result.output
    for name, truth in room.truth.items():
        with np.load(model / "out" / "depth" / f"{name}.npz") as arrays:
            depth, variance = arrays["depth"], arrays["variance"]
        error = np.abs(depth / truth - 1)
        certain = np.sqrt(variance) < 0.05 * depth
        assert certain.mean() > 0.4 and np.median(error[certain]) < 0.015
    assert len(read_ply(model / "out" / "dense.ply")[0]) > 1000


def test_densify_model_without_points_raises(model: Path) -> None:
    import pycolmap

    bare = pycolmap.Reconstruction(str(model / "sparse"))
    for number in list(bare.points3D):
        bare.delete_point3D(number)
    bare.write(str(model / "sparse"))
    with pytest.raises(InputError, match="has no points"):
        densify_model(model, model / "photos", model / "out")
    assert not (model / "out").exists()


def test_densify_model_with_other_images_raises(model: Path, tmp_path: Path) -> None:
    other = tmp_path / "other"
    other.mkdir()
    for name in ("x.png", "y.png"):
        cv2.imwrite(str(other / name), np.zeros((8, 8, 3), np.uint8))
    with pytest.raises(InputError, match="stereo needs two photos"):
        densify_model(model, other, model / "out")


def test_depth_prior_from_points_ignores_points_behind_camera() -> None:
    found = depth_prior_from_points(np.array([-3.0, 1.0, 2.0, 4.0]))
    assert isinstance(found, DepthPrior)
    assert found.depth == pytest.approx(2.0, rel=0.1)
    assert depth_prior_from_points(np.array([-1.0])) is None
