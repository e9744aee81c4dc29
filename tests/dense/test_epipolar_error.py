"""Tests of pose errors from patch offsets perpendicular to epipolar lines."""

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
"""Rotation axes that move pixels across or along the epipolar lines of a sideways motion."""


def turned(image: RegisteredImage, axis: list[float], pixels: float) -> RegisteredImage:
    """Rotate the pose of an image such that pixels move by about `pixels`."""
    turn = Rotation.from_rotvec(np.array(axis) * pixels / image.camera.fx).as_matrix()
    return replace(image, rotation=turn @ image.rotation, translation=turn @ image.translation)


def match_patches(room, axis: list[float], pixels: float) -> PatchOffsets:
    """Match patches of the first image in the second image, whose pose has an error."""
    first, second = room.reconstruction.images[:2]
    one, other = (
        DenseView.from_view(image, room.views[image.name], max(image.camera.size))
        for image in (first, turned(second, axis, pixels))
    )
    depth = np.log(room.truth[first.name])
    return measure_patch_offsets(one, depth, other, np.ones(depth.shape, np.bool_))


@pytest.mark.parametrize(("axis", "pixels"), [(ACROSS, 0.0), (ALONG, 2.0)])
def test_pose_error_along_epipolar_line_is_invisible(
    room, axis: list[float], pixels: float
) -> None:
    seen = match_patches(room, axis, pixels)
    assert estimate_pose_error_px([seen]) < 0.25 and seen.matched_ratio > 0.5


@pytest.mark.parametrize("pixels", [1.0, 3.0])
def test_pose_error_across_epipolar_line_is_measured(room, pixels: float) -> None:
    assert estimate_pose_error_px([match_patches(room, ACROSS, pixels)]) == pytest.approx(
        pixels, rel=0.15
    )


def test_densify_pose_error_increases_std(room) -> None:
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


def test_patch_offsets_without_pixels_are_empty(room) -> None:
    image = room.reconstruction.images[0]
    view = DenseView.from_view(image, room.views[image.name], max(image.camera.size))
    depth = np.log(room.truth[image.name])
    nothing = measure_patch_offsets(view, depth, view, np.zeros(depth.shape, np.bool_))
    assert nothing.matched_ratio == 0.0
    assert estimate_pose_error_px([nothing]) == estimate_pose_error_px([]) == 0.0


def test_patch_offsets_of_other_texture_have_low_ratio(room) -> None:
    assert match_patches(room, ACROSS, 60.0).matched_ratio < 0.1
