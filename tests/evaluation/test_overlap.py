"""Tests of image overlap on constructed scenes and on a dataset scene."""

from __future__ import annotations

from itertools import combinations
from pathlib import Path

import numpy as np
import pycolmap
import pytest
import yaml

from mpsfm_core.data import PinholeCamera
from mpsfm_core.evaluation.overlap import overlap_from_depth, overlap_from_model
from mpsfm_core.evaluation.prior_quality import read_depth
from mpsfm_core.evaluation.scene_folder import read_scene
from mpsfm_core.inputs.images import load_images

CAMERA = PinholeCamera(100, 50, 50.0, 50.0, 50.0, 25.0)


def wall(*shifts: float, depth: float = 2.0):
    """Return cameras in a row in front of a wall, with an overlap loss of a quarter per meter."""
    names = [f"{k}" for k in range(len(shifts))]
    poses = {n: (np.eye(3), np.array([-s, 0.0, 0.0])) for n, s in zip(names, shifts, strict=True)}
    cameras = dict.fromkeys(names, CAMERA)
    flat = np.full((50, 100), depth, dtype=np.float32)
    return names, poses, cameras, flat


def test_overlap_of_cameras_in_front_of_wall() -> None:
    names, poses, cameras, flat = wall(0.0, 1.0, 2.0, 4.0)
    overlap = overlap_from_depth(names, poses, cameras, lambda _: flat)
    expected = [[1, 0.75, 0.5, 0], [0.75, 1, 0.75, 0.25], [0.5, 0.75, 1, 0.5], [0, 0.25, 0.5, 1]]
    np.testing.assert_allclose(overlap.two_view, expected, atol=0.02)
    assert overlap.three_view(0, 1, 2) == pytest.approx(0.5, abs=0.02)
    assert overlap.three_view(0, 2, 3) == pytest.approx(0.0, abs=0.02)
    assert overlap.three_view(3, 1, 2) == pytest.approx(0.25, abs=0.02)


def test_overlap_uses_minimum_of_pair_and_maximum_of_triplet() -> None:
    # The second camera is twice as far from the wall, so it sees four times the area of the first
    # camera.
    names, poses, cameras, flat = wall(0.0, 0.0, 1.0)
    poses["1"] = (np.eye(3), np.array([0.0, 0.0, 2.0]))
    depth = {"0": flat, "1": 2 * flat, "2": flat}
    overlap = overlap_from_depth(names, poses, cameras, depth.__getitem__)
    assert overlap.two_view[0, 1] == pytest.approx(0.25, abs=0.02)
    assert overlap.three_view(0, 1, 2) == pytest.approx(0.75, abs=0.02)


def test_overlap_ignores_occluded_and_unknown_depth() -> None:
    names, poses, cameras, flat = wall(0.0, 0.0)
    near, holes = flat.copy(), flat.copy()
    near[:, :50] = 1.0  # An object covers the left half.
    overlap = overlap_from_depth(names, poses, cameras, {"0": flat, "1": near}.__getitem__)
    assert overlap.two_view[0, 1] == pytest.approx(0.5, abs=0.02)
    holes[:, :50] = 0.0
    overlap = overlap_from_depth(names, poses, cameras, {"0": flat, "1": holes}.__getitem__)
    assert overlap.two_view[0, 1] == pytest.approx(0.5, abs=0.02)
    assert overlap.counts[1] == pytest.approx(overlap.counts[0] / 2, rel=0.05)


def test_overlap_from_model_points() -> None:
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(
        pycolmap.Camera(model="PINHOLE", width=9, height=9, params=[9, 9, 4, 4], camera_id=1)
    )
    observed = {1: [0, 1, 2, 3], 2: [2, 3, 4, 5, 6, 7, 8, 9], 3: [3, 9]}
    for number, points in observed.items():
        image = pycolmap.Image(
            name=f"{number}.jpg", keypoints=np.zeros((len(points), 2)), camera_id=1
        )
        image.image_id = number
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d())
    for point in range(10):
        track = [
            pycolmap.TrackElement(number, points.index(point))
            for number, points in observed.items()
            if point in points
        ]
        model.add_point3D(np.array([0.0, 0.0, 1.0 + point]), pycolmap.Track(track))
    overlap = overlap_from_model(model, ["1.jpg", "2.jpg", "3.jpg"])
    np.testing.assert_array_equal(overlap.counts, [4, 8, 2])
    expected = [[1, 2 / 8, 1 / 4], [2 / 8, 1, 2 / 8], [1 / 4, 2 / 8, 1]]
    np.testing.assert_allclose(overlap.two_view, expected)
    # All images see point 3, one of two points of the third image.
    assert overlap.three_view(0, 1, 2) == 0.5


@pytest.mark.slow
def test_overlap_matches_declared_overlap(shared_data: Path) -> None:
    scene = read_scene(shared_data / "data" / "rendered_kitchen")
    declared = yaml.safe_load((scene.path / "testsets.yaml").read_text())
    cameras = {i.name: i.pinhole for i in load_images(scene.images, scene.intrinsics)}
    for item in scene.select_sets(["minimal", "leq10", "leq30"]):
        overlap = overlap_from_depth(
            item.images,
            scene.truth,
            cameras,
            lambda name: read_depth(scene.path / "gt_depth" / f"{Path(name).stem}.png"),
        )
        found = max(
            overlap.three_view(*triplet) for triplet in combinations(range(len(overlap)), 3)
        )
        expected = declared[item.bucket][item.index]["max_three_view_overlap"]
        assert found == pytest.approx(expected, abs=0.01)
        np.fill_diagonal(overlap.two_view, 0)
        assert overlap.two_view.max(axis=1).min() > 0.3 - 0.01
