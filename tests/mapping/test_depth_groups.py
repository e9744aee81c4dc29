"""Tests of depth groups, whose images share a scale and have network poses as hypotheses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from mpsfm_core.data import DepthPrior, Float64, MappingProblem, PinholeCamera
from mpsfm_core.geometry import rotation_angle_deg
from mpsfm_core.mapping.events import NullMappingEvents
from mpsfm_core.mapping.mapper import Mapper
from mpsfm_core.mapping.options import MapperOptions, RegistrationOptions
from mpsfm_core.mapping.registration.correspondences import find_correspondences
from mpsfm_core.mapping.registration.pose_estimation import estimate_candidate_poses
from mpsfm_core.mapping.registration.pose_hypotheses import PoseHypothesis, PoseHypothesisGenerator
from mpsfm_core.mapping.scene.scene import Scene
from mpsfm_core.testing.synthetic.problems import SyntheticNoise, make_mapping_problem
from mpsfm_core.testing.synthetic.scenes import arc_poses, room_scene

CAMERA = PinholeCamera(320, 240, 260.0, 260.0, 160.0, 120.0)
UNITS = (1.0, 3.0)
POSES = arc_poses(4, 14.0)


def in_units(
    groups: Sequence[int | None], poses: Sequence[Float64] | None = None
) -> MappingProblem:
    """Return images of the room whose depth has the unit of their group, with some noise."""
    noise = SyntheticNoise(keypoints_px=0.5, depth=0.02)
    problem = make_mapping_problem(
        room_scene(), CAMERA, POSES[: len(groups)], noise=noise, declared_depth_std=0.02
    )
    images = []
    for number, (image, group) in enumerate(zip(problem.images, groups, strict=True)):
        unit = 1.0 if group is None else UNITS[group]
        assert image.depth.variance is not None
        depth = DepthPrior.from_arrays(
            image.depth.depth * unit,
            image.depth.variance * unit**2,
            image.depth.valid,
            metric=False,
        )
        pose = None
        if poses is not None:
            pose = poses[number][:, :3].copy(), unit * poses[number][:, 3]
        images.append(replace(image, depth=depth, depth_group=group, proposed_pose=pose))
    return MappingProblem(tuple(images), problem.pairs)


@pytest.mark.parametrize("global_initialization", [True, False])
def test_images_of_depth_group_share_scale(global_initialization: bool) -> None:
    options = MapperOptions(global_initialization=global_initialization)
    mapper = Mapper(in_units([0, 0, 1, 1]), options, NullMappingEvents())
    mapper.reconstruct_component()
    scene = mapper.component.scene
    assert scene.registered.all()
    scales = [depth_map.scale for depth_map in scene.maps]
    assert scales[0] == scales[1] and scales[2] == scales[3]
    assert scales[0] / scales[2] == pytest.approx(UNITS[1] / UNITS[0], rel=0.02)


def test_images_without_depth_group_have_own_scales() -> None:
    mapper = Mapper(in_units([None] * 3), MapperOptions(), NullMappingEvents())
    mapper.reconstruct_component()
    assert len({depth_map.scale for depth_map in mapper.component.scene.maps}) == 3


def proposals(problem: MappingProblem, reference: int = 0, image: int = 1) -> list[PoseHypothesis]:
    """Return the hypotheses from network poses, with one registered reference image."""
    scene = Scene(problem)
    scene.register(reference, POSES[reference][:, :3], POSES[reference][:, 3])
    scene.maps[reference].set_scale(1 / UNITS[problem.images[reference].depth_group or 0])
    options = RegistrationOptions()
    correspondences = find_correspondences(scene, image, [reference], options)
    made = [
        estimate()
        for estimate in PoseHypothesisGenerator(
            scene, correspondences, options, 0
        ).generate_from_all()
    ]
    return [h for h in made if h is not None and h.source == "multi-view network"]


def test_network_pose_is_scaled_to_depth_group() -> None:
    """The network poses have their own frame and unit."""
    turn = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    own_frame = [np.column_stack([pose[:, :3] @ turn, pose[:, 3]]) for pose in POSES]
    (found,) = proposals(in_units([1, 1], own_frame))
    np.testing.assert_allclose(found.rotation, POSES[1][:, :3], atol=1e-9)
    np.testing.assert_allclose(found.translation, POSES[1][:, 3], atol=1e-9)


def test_network_pose_between_depth_groups_is_ignored() -> None:
    assert not proposals(in_units([0, 1], POSES))


def test_wrong_network_pose_is_outvoted_by_matches() -> None:
    """The pose with the most support is selected, not the pose of the network."""
    wrong = [POSES[0], POSES[3], POSES[2], POSES[1]]
    problem = in_units([0, 0, 0, 0], wrong)
    scene = Scene(problem)
    scene.register(0, POSES[0][:, :3], POSES[0][:, 3])
    scene.maps[0].set_scale(1.0)
    options = RegistrationOptions()
    correspondences = find_correspondences(scene, 1, [0], options)
    best = estimate_candidate_poses(scene, correspondences, options, seed=0, attempt=0)[0]
    assert rotation_angle_deg(best.rotation @ POSES[1][:, :3].T) < 1.0
