"""What photos show of wrong poses: offsets beside the lines on which depth is searched."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mpsfm_core.data import View
from mpsfm_core.dense.dense_view import DenseView
from mpsfm_core.dense.densify import densify
from mpsfm_core.dense.epipolar_error import (
    PatchOffsets,
    estimate_pose_error_px,
    measure_patch_offsets,
)
from mpsfm_core.dense.options import DenseOptions
from mpsfm_core.mapping.scene.reconstruction import RegisteredImage

ACROSS, ALONG = [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]
"""Axes of a turn that moves pixels across the lines of a camera that moved sideways, or along."""


def turned(image: RegisteredImage, axis: list[float], pixels: float) -> RegisteredImage:
    """The image with a pose that is wrong by about so many pixels."""
    turn = Rotation.from_rotvec(np.array(axis) * pixels / image.camera.fx).as_matrix()
    return replace(image, rotation=turn @ image.rotation, translation=turn @ image.translation)


def looked_for(room, axis: list[float], pixels: float) -> PatchOffsets:
    """Patches of the first photo of a room in the second one, which stands wrong."""
    first, second = room.reconstruction.images[:2]
    one, other = (
        DenseView.of(image, room.views[image.name], max(image.camera.size))
        for image in (first, turned(second, axis, pixels))
    )
    depth = np.log(room.truth[first.name])
    return measure_patch_offsets(one, depth, other, np.ones(depth.shape, np.bool_))


@pytest.mark.parametrize(("axis", "pixels"), [(ACROSS, 0.0), (ALONG, 2.0)])
def test_right_poses_and_what_depth_may_explain_leave_nothing(
    room, axis: list[float], pixels: float
) -> None:
    seen = looked_for(room, axis, pixels)
    assert estimate_pose_error_px([seen]) < 0.25 and seen.found > 0.5


@pytest.mark.parametrize("pixels", [1.0, 3.0])
def test_errors_across_the_lines_are_measured(room, pixels: float) -> None:
    assert estimate_pose_error_px([looked_for(room, ACROSS, pixels)]) == pytest.approx(
        pixels, rel=0.15
    )


def test_depth_is_less_sure_where_poses_are_wrong(room) -> None:
    def median_std(images: tuple[RegisteredImage, ...]) -> float:
        result, report = densify(replace(room.reconstruction, images=images), view_of, options)
        stated = []
        for image in result.images:
            assert image.depth.variance is not None
            relative = np.sqrt(image.depth.variance) / image.depth.depth
            stated.append(relative[report.measured[image.name]])
        return float(np.median(np.concatenate(stated)))

    def view_of(name: str) -> View:
        return room.views[name]

    images, options = room.reconstruction.images, DenseOptions()
    wrong = tuple(turned(image, ACROSS, 1.5 * (-1) ** image.index) for image in images)
    assert median_std(wrong) > 2 * median_std(images)


def test_without_pixels_nothing_is_said(room) -> None:
    image = room.reconstruction.images[0]
    view = DenseView.of(image, room.views[image.name], max(image.camera.size))
    depth = np.log(room.truth[image.name])
    nothing = measure_patch_offsets(view, depth, view, np.zeros(depth.shape, np.bool_))
    assert nothing.found == 0.0
    assert estimate_pose_error_px([nothing]) == estimate_pose_error_px([]) == 0.0


def test_patches_are_not_found_in_photos_of_something_else(room) -> None:
    assert looked_for(room, ACROSS, 60.0).found < 0.1
