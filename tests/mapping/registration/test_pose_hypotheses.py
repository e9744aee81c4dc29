"""Tests of pose hypotheses with unknown focal length."""

from __future__ import annotations

from dataclasses import replace

import pytest

from mpsfm_core.data import MappingProblem
from mpsfm_core.geometry import rotation_angle_deg
from mpsfm_core.mapping.options import RegistrationOptions
from mpsfm_core.mapping.registration.correspondences import find_correspondences
from mpsfm_core.mapping.registration.pose_estimation import estimate_candidate_poses
from mpsfm_core.mapping.registration.pose_support import ScoredPose
from mpsfm_core.mapping.scene.scene import Scene
from tests.mapping.focal_scenes import (
    CAMERA,
    POSES,
    guess_focals,
    make_room,
    register_true_poses,
    scale_focal,
)


@pytest.fixture(scope="module")
def room() -> MappingProblem:
    return make_room()


def estimate_poses(scene: Scene, options: RegistrationOptions) -> list[ScoredPose]:
    """Estimate poses of the last image from the other four."""
    correspondences = find_correspondences(scene, 4, [0, 1, 2, 3], options)
    return estimate_candidate_poses(scene, correspondences, options, seed=0, attempt=0)


def guess_last_focal(room: MappingProblem, factor: float, log_std: float = 0.7) -> Scene:
    """Return a scene with four known cameras and a guessed focal length of the last image."""
    camera = scale_focal(CAMERA, factor)
    guess = replace(room.images[4], camera=camera, focal_known=False, focal_log_std=log_std)
    scene = register_true_poses(replace(room, images=(*room.images[:4], guess)), range(4)).scene
    for depth_map in scene.maps[:4]:
        depth_map.set_scale(1.0)
    return scene


@pytest.mark.parametrize(("factor", "log_std"), [(0.45, 0.7), (1.6, 0.7), (3.0, 0.7), (0.4, 0.1)])
def test_candidate_poses_with_unknown_or_wrong_focal_length_estimate_it(
    room: MappingProblem, factor: float, log_std: float
) -> None:
    scene = guess_last_focal(room, factor, log_std)
    best = estimate_poses(scene, RegistrationOptions())[0]
    assert best.focal_px == pytest.approx(CAMERA.fx, rel=0.02)
    assert rotation_angle_deg(best.rotation @ POSES[4][:, :3].T) < 0.3
    scene.register(4, best.rotation, best.translation, best.focal_px)
    assert scene.camera(4).fx == best.focal_px
    assert scene.camera(4).fy == pytest.approx(best.focal_px)


def test_candidate_poses_without_estimate_focal_keep_the_guess(room: MappingProblem) -> None:
    poses = estimate_poses(guess_last_focal(room, 1.6), RegistrationOptions(estimate_focal=False))
    assert all(pose.focal_px is None for pose in poses)


def test_candidate_poses_of_registered_camera_keep_its_focal_length(room: MappingProblem) -> None:
    scene = register_true_poses(guess_focals(room, [1.3] * 5), range(4)).scene
    assert not scene.has_free_focal(4)
    poses = estimate_poses(scene, RegistrationOptions())
    assert all(pose.focal_px is None for pose in poses)
