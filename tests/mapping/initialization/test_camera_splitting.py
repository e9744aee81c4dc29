"""Tests that images with another zoom than their assumed camera get their own camera."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mpsfm_core.data import MappingImage, MappingProblem
from mpsfm_core.mapping.initialization.camera_splitting import (
    find_deviating_focals,
    split_cameras,
)
from mpsfm_core.mapping.initialization.refined_focal_lengths import apply_refined_focal_lengths
from mpsfm_core.mapping.initialization.seed_poses import apply_seed_poses
from mpsfm_core.mapping.options import MapperOptions
from mpsfm_core.mapping.scene.conversion import convert_scene
from mpsfm_core.mapping.scene.reconstruction import Reconstruction
from mpsfm_core.mapping.triangulation import complete_and_merge_tracks
from tests.mapping.focal_scenes import CAMERA, POSES, make_room, register_true_poses

OPTIONS = MapperOptions()


def zoom(image: MappingImage, factor: float) -> MappingImage:
    """Return an image enlarged about its center, with the intrinsics that it had before."""
    center = [CAMERA.cx, CAMERA.cy]
    return replace(image, keypoints=(image.keypoints - center) * factor + center)


@pytest.fixture(scope="module")
def room() -> MappingProblem:
    problem = make_room()
    images = tuple(replace(image, focal_known=False) for image in problem.images)
    return replace(problem, images=images)


@pytest.fixture(scope="module")
def model(room: MappingProblem) -> Reconstruction:
    """Return the model of all images except image 1."""
    return convert_scene(register_true_poses(room, (0, 2, 3, 4)).scene)


@pytest.mark.parametrize("factor", [1.15, 1.6])
def test_find_deviating_focals_finds_a_zoomed_image(
    room: MappingProblem, model: Reconstruction, factor: float
) -> None:
    images = [zoom(image, factor if i == 1 else 1) for i, image in enumerate(room.images)]
    problem = replace(room, images=tuple(images))
    focals = find_deviating_focals(problem, model, OPTIONS.registration, seed=0)
    assert focals == {1: pytest.approx(factor * CAMERA.fx, rel=0.01)}
    split = apply_refined_focal_lengths(problem, model, OPTIONS)
    assert split is not None
    assert [image.camera_id for image in split.images] == [0, 1, 0, 0, 0]


def test_find_deviating_focals_without_zoom_finds_none(
    room: MappingProblem, model: Reconstruction
) -> None:
    assert find_deviating_focals(room, model, OPTIONS.registration, seed=0) == {}
    assert apply_refined_focal_lengths(room, model, OPTIONS) is None


def test_find_deviating_focals_examines_either_shared_or_own_cameras(
    room: MappingProblem, model: Reconstruction
) -> None:
    zoomed = zoom(room.images[1], 1.6)
    expected = pytest.approx(1.6 * CAMERA.fx, rel=0.01)
    for own, focals in ((replace(zoomed, focal_known=True), {}), (zoomed, {1: expected})):
        problem = replace(
            room, images=(room.images[0], replace(own, camera_id=7), *room.images[2:])
        )
        arguments = problem, model, OPTIONS.registration, 0
        assert find_deviating_focals(*arguments) == {}
        assert find_deviating_focals(*arguments, is_shared=False) == focals


@pytest.mark.slow
def test_reregister_images_replaces_a_focal_length_that_the_pose_compensates(
    room: MappingProblem,
) -> None:
    zoomed = replace(zoom(room.images[1], 1.08), camera_id=7)
    known = [replace(image, focal_known=True) for image in room.images]
    problem = replace(room, images=(known[0], zoomed, *known[2:]))
    component = register_true_poses(problem, (0, 2, 3, 4))
    approach = np.array([0.0, 0.0, 4.0 * (1 - 1 / 1.08)])  # compensates at a distance of 4
    component.scene.register(1, POSES[1][:, :3], POSES[1][:, 3] - approach)
    complete_and_merge_tracks(component.scene, OPTIONS.triangulation, create=True)
    component.reregister_images(np.arange(5) == 1)
    assert component.scene.camera(1).fx == pytest.approx(1.08 * CAMERA.fx, rel=0.01)


def test_apply_seed_poses_keeps_own_cameras(room: MappingProblem, model: Reconstruction) -> None:
    other = replace(CAMERA, fx=900.0, fy=900.0)
    seeds = [replace(i, camera=other) if i.index == 3 else i for i in model.images]
    seeded = apply_seed_poses(room, seeds).images
    assert [image.camera.fx for image in seeded] == [CAMERA.fx] * 3 + [900.0, CAMERA.fx]
    assert seeded[3].camera_id not in {image.camera_id for image in seeded[:3]}
    assert seeded[1].camera_id == seeded[0].camera_id


def test_split_cameras_keeps_the_prior(room: MappingProblem) -> None:
    images = split_cameras(room.images, {2: 600.0})
    assert images[2].camera.params.tolist() == [600.0, 600.0, CAMERA.cx, CAMERA.cy]
    assert images[2].focal_prior_px == CAMERA.fx
    assert np.all([images[i] is room.images[i] for i in (0, 1, 3, 4)])
