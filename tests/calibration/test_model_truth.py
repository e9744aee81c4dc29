"""Tests of true depth from COLMAP points on an exactly known scene."""

from __future__ import annotations

import cv2
import numpy as np
import pycolmap
import pytest

from mpsfm_core.calibration.model_truth import depth_truth_from_model
from mpsfm_core.calibration.samples import DepthTruth
from mpsfm_core.data import Float64
from mpsfm_core.geometry import project
from mpsfm_core.inputs.images import ImageSet, load_images
from mpsfm_core.testing.synthetic.scenes import arc_poses

NOISE_PX = 0.5
POINTS = 600
CAMERA = pycolmap.Camera(
    model="OPENCV",
    width=320,
    height=240,
    params=[280, 282, 158, 121, -0.08, 0.01, 0.001, -0.001],
    camera_id=1,
)


@pytest.fixture(scope="module")
def points() -> Float64:
    rng = np.random.default_rng(1)
    return rng.uniform((-1.2, -1.2, 0.2), (1.2, 1.2, 1.8), (POINTS, 3))


def make_model(points: Float64, stored: Float64) -> pycolmap.Reconstruction:
    """Return a COLMAP model of five images 8 degrees apart with the point coordinates `stored`."""
    rng = np.random.default_rng(2)
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(pycolmap.Camera(CAMERA.todict()))
    tracks: list[list[tuple[int, int]]] = [[] for _ in points]
    for number, pose in enumerate(arc_poses(5, 8.0), start=1):
        camera_points = points @ pose[:, :3].T + pose[:, 3]
        xy = CAMERA.img_from_cam(camera_points)
        seen = (camera_points[:, 2] > 0) & (xy > 0).all(axis=1) & (xy < (320, 240)).all(axis=1)
        noisy = xy[seen] + NOISE_PX * rng.normal(size=(int(seen.sum()), 2))
        image = pycolmap.Image(f"{number}.png", noisy, camera_id=1, image_id=number)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pose))
        for row, point in enumerate(np.flatnonzero(seen)):
            tracks[point].append((number, row))
    for xyz, elements in zip(stored, tracks, strict=True):
        if len(elements) >= 2:
            track = pycolmap.Track([pycolmap.TrackElement(*element) for element in elements])
            model.add_point3D(xyz, track)
    return model


@pytest.fixture(scope="module")
def images(tmp_path_factory: pytest.TempPathFactory) -> ImageSet:
    folder = tmp_path_factory.mktemp("photos")
    for number in range(1, 6):
        cv2.imwrite(str(folder / f"{number}.png"), np.zeros((240, 320, 3), np.uint8))
    intrinsics = folder / "intrinsics.yaml"
    intrinsics.write_text(f"1: {{model: OPENCV, params: {CAMERA.params.tolist()}, images: all}}\n")
    return load_images(folder, intrinsics)


def errors(truth: dict[str, DepthTruth], points: Float64, images: ImageSet) -> Float64:
    """Return log depth errors over their std, and check that positions are pixels of the view."""
    found = []
    for number, pose in enumerate(arc_poses(5, 8.0), start=1):
        camera_points = points @ pose[:, :3].T + pose[:, 3]
        view_xy = project(images[number - 1].pinhole, camera_points)
        one = truth[f"{number}.png"]
        distance = np.linalg.norm(one.xy[:, None] - view_xy[None], axis=2)
        nearest = distance.argmin(axis=1)
        assert np.median(distance.min(axis=1)) < 2 * NOISE_PX
        found.append(np.log(one.depth / camera_points[nearest, 2]) / one.std)
    return np.concatenate(found)


def test_model_depth_std_is_calibrated(points: Float64, images: ImageSet) -> None:
    z = np.abs(errors(depth_truth_from_model(make_model(points, points), images), points, images))
    assert len(z) > POINTS
    # The median is robust to noisy keypoints that are nearest to a wrong point.
    assert 1.4826 * np.median(z) == pytest.approx(1, abs=0.2)


def test_model_depth_is_independent_of_model_points(points: Float64, images: ImageSet) -> None:
    """A depth prior that moved points along their rays must not influence the true depth."""
    center = -arc_poses(5, 8.0)[2][:, :3].T @ arc_poses(5, 8.0)[2][:, 3]
    pulled = center + 1.15 * (points - center)
    right = depth_truth_from_model(make_model(points, points), images)
    again = depth_truth_from_model(make_model(points, pulled), images)
    assert len(again["3.png"].depth) == pytest.approx(len(right["3.png"].depth), rel=0.02)
    assert np.abs(np.median(errors(again, points, images))) < 0.2


def test_model_depth_excludes_small_angles_and_outliers(points: Float64, images: ImageSet) -> None:
    near = points.copy()
    # The points are so far away that their rays are nearly parallel.
    near[:100] = points[:100] * 0.1 + [0, 60.0, 0]
    truth = depth_truth_from_model(make_model(near, near), images)
    assert all(one.depth.max() < 20 for one in truth.values())
    model = make_model(points, points)
    image = model.images[1]
    wrong = [p.point3D_id for p in image.points2D if p.has_point3D()][:50]
    for row, point in enumerate(image.points2D):
        if point.has_point3D() and point.point3D_id in wrong:
            image.points2D[row].xy = point.xy + np.array([25.0, -25.0])
    kept = depth_truth_from_model(model, images)
    assert len(kept["2.png"].depth) < len(
        depth_truth_from_model(make_model(points, points), images)["2.png"].depth
    )


def test_model_depth_skips_unknown_images(points: Float64, images: ImageSet) -> None:
    some = ImageSet(images.images[:2], images._options)
    assert set(depth_truth_from_model(make_model(points, points), some)) == {"1.png", "2.png"}


def test_model_depth_without_points_is_empty(images: ImageSet) -> None:
    assert depth_truth_from_model(make_model(np.zeros((0, 3)), np.zeros((0, 3))), images) == {}
