"""Tests of the written COLMAP model, read with pycolmap."""

from __future__ import annotations

import resource
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from mpsfm_core.geometry.pycolmap_conversion import colmap_from_pinhole
from mpsfm_core.results import colmap_model
from mpsfm_core.results.colmap_model import average_point_colors, build_model, write_model

DISTORTED = pycolmap.Camera(
    model="OPENCV", width=200, height=150, params=[150, 151, 100, 75, 0.1, -0.05, 0.001, -0.002]
)


def keypoints_of(solved):
    return [solved.problem.images[image.index].keypoints for image in solved.best.images]


@pytest.fixture
def model(solved) -> pycolmap.Reconstruction:
    cameras = [colmap_from_pinhole(image.camera) for image in solved.best.images]
    colors = average_point_colors(solved.best, keypoints_of(solved), solved.views.__getitem__)
    return build_model(solved.best, cameras, keypoints_of(solved), colors)


@pytest.mark.parametrize("text", [False, True])
def test_written_model_equals_the_reconstruction(solved, model, tmp_path, text) -> None:
    write_model(tmp_path, model, text=text)
    read = pycolmap.Reconstruction(str(tmp_path))
    assert read.num_reg_images() == 3
    assert read.num_cameras() == 1
    # Three images observe 40 points; the five points that only one image observes are left out.
    assert read.num_points3D() == 40
    assert read.compute_num_observations() == 120
    for image in solved.best.images:
        stored = read.find_image_with_name(image.name)
        np.testing.assert_allclose(
            stored.cam_from_world().matrix()[:, :3], image.rotation, atol=1e-9
        )
        np.testing.assert_allclose(
            [point.xy for point in stored.points2D],
            solved.problem.images[image.index].keypoints,
            atol=1e-9,
        )
        for row, point in enumerate(stored.points2D):
            assert point.has_point3D() == (row < 40)
    # The poses, points, camera and keypoints belong together.
    assert read.compute_mean_reprojection_error() < 1e-6


def test_reprojection_errors_use_the_camera_of_the_model(solved) -> None:
    xy = []
    for image, keypoints in zip(solved.best.images, keypoints_of(solved), strict=True):
        local = solved.best.points @ image.rotation.T + image.translation
        seen = image.point_ids >= 0
        exact = DISTORTED.img_from_cam(local[image.point_ids[seen]])
        padded = np.vstack([exact, [[0, 0]]])
        xy.append(np.where(seen[:, None], padded, keypoints) + np.array([3.0, 4.0]))
    colors = np.zeros((len(solved.best.points), 3), np.uint8)
    model = build_model(solved.best, [DISTORTED] * 3, xy, colors)
    assert next(iter(model.cameras.values())).model_name == "OPENCV"
    assert [point.error for point in model.points3D.values()] == pytest.approx([5.0] * 40)


def test_different_cameras_are_not_merged(solved) -> None:
    cameras = [colmap_from_pinhole(image.camera) for image in solved.best.images]
    cameras[1] = DISTORTED
    colors = np.zeros((len(solved.best.points), 3), np.uint8)
    model = build_model(solved.best, cameras, keypoints_of(solved), colors)
    by_name = {image.name: image.camera_id for image in model.images.values()}
    assert by_name["images/0.png"] == by_name["images/2.png"] != by_name["images/1.png"]


def test_points_have_the_color_of_the_photos(solved, model) -> None:
    expected = average_point_colors(solved.best, keypoints_of(solved), solved.views.__getitem__)
    stored = {tuple(point.xyz): point.color for point in model.points3D.values()}
    for xyz, color in zip(solved.best.points[:40], expected[:40], strict=True):
        np.testing.assert_array_equal(stored[tuple(xyz)], color)
    image, view = solved.best.images[1], solved.views["images/1.png"]
    # A point that one image observes has the color of its pixel.
    x, y = solved.problem.images[1].keypoints[41]
    np.testing.assert_array_equal(expected[image.point_ids[41]], view.image[int(y), int(x)])


@pytest.mark.parametrize("text", [False, True])
def test_checked_free_space_covers_all_files(
    model, tmp_path: Path, text: bool, monkeypatch
) -> None:
    sizes = []
    monkeypatch.setattr(colmap_model, "_check_free_space", lambda path, size: sizes.append(size))
    write_model(tmp_path, model, text=text)
    written = sum(path.stat().st_size for path in tmp_path.iterdir())
    assert written <= sizes[0] <= 20 * written


def test_write_model_on_full_disk_raises_and_leaves_no_file(model, tmp_path: Path) -> None:
    _, limit = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (4096, limit))
    try:
        with pytest.raises(OSError, match="File too large"):
            write_model(tmp_path, model)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("text", [False, True])
@pytest.mark.parametrize("part", ["cameras", "images", "points3D", "frames", "rigs"])
@pytest.mark.parametrize("kept", [0.0, 0.5, 0.98])
def test_write_model_with_truncated_file_raises(
    model: pycolmap.Reconstruction, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    text: bool, part: str, kept: float,
) -> None:  # fmt: skip
    write_model(tmp_path, model, text=text)
    name = "write_text" if text else "write_binary"
    write = getattr(pycolmap.Reconstruction, name)

    def cut(self: pycolmap.Reconstruction, folder: str) -> None:
        write(self, folder)
        path = Path(folder) / f"{part}.{'txt' if text else 'bin'}"
        path.write_bytes(path.read_bytes()[: int(kept * path.stat().st_size)])

    monkeypatch.setattr(pycolmap.Reconstruction, name, cut)
    with pytest.raises(OSError, match="are incomplete"):
        write_model(tmp_path, model, text=text)
