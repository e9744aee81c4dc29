"""Tests of seed poses, with which a second reconstruction starts from the poses of the first."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mpsfm_core.data import MappingProblem, PinholeCamera
from mpsfm_core.geometry import rotation_angle_deg
from mpsfm_core.mapping.initialization.seed_poses import apply_seed_poses, select_seed_images
from mpsfm_core.mapping.mapper import reconstruct
from mpsfm_core.mapping.options import MapperOptions
from mpsfm_core.mapping.scene.reconstruction import MappingReport, MappingResult, Reconstruction
from mpsfm_core.testing.synthetic.problems import make_mapping_problem
from mpsfm_core.testing.synthetic.scenes import arc_poses, room_scene

CAMERA = PinholeCamera(640, 480, 520.0, 520.0, 320.0, 240.0)
POSES = arc_poses(5, 14.0)


@pytest.fixture(scope="module")
def problem() -> MappingProblem:
    return make_mapping_problem(room_scene(), CAMERA, POSES)


@pytest.fixture(scope="module")
def mapped(problem: MappingProblem) -> MappingResult:
    """Reconstruct four of the five images."""
    return reconstruct(problem.subset([image.name for image in problem.images[:4]]))


def with_point_ids(
    mapping: MappingResult, ids: list[list[int]], **changes: object
) -> MappingResult:
    """Return the result with other points: ``ids`` has the point of each keypoint per image."""
    images = tuple(
        replace(image, point_ids=np.array(own, dtype=np.int64), **changes)
        for image, own in zip(mapping.reconstructions[0].images, ids, strict=True)
    )
    part = Reconstruction(images, np.zeros((4, 3)), np.zeros(4))
    return MappingResult((part,), MappingReport())


def test_select_seed_images_requires_multi_view_points(mapped: MappingResult) -> None:
    ids = [[0, 1, -1, 0], [1, 0, 2], [0, -1, 2, 3], [1, 3]]
    few = with_point_ids(mapped, ids)
    assert few.reconstructions[0].num_multi_view_points().tolist() == [2, 2, 1, 1]
    assert [image.index for image in select_seed_images(few, 2)] == [0, 1]
    assert not select_seed_images(with_point_ids(mapped, ids, confirmed=False), 1)
    assert not select_seed_images(MappingResult((), MappingReport()), 1)


def test_reconstruct_from_seed_poses_is_metric(
    problem: MappingProblem, mapped: MappingResult
) -> None:
    seeds = select_seed_images(mapped, 30)
    assert len(seeds) == 4
    tenth = [replace(image, translation=image.translation / 10) for image in seeds]
    guess = MapperOptions(known_poses="guess")
    (found,) = reconstruct(apply_seed_poses(problem, tenth), guess).reconstructions
    assert found.metric is not None and found.metric.trusted
    assert [image.index for image in found.images] == [0, 1, 2, 3, 4]
    first, *others = found.images
    for image in others:
        turn = image.rotation @ first.rotation.T
        true = POSES[image.index][:, :3] @ POSES[0][:, :3].T
        assert rotation_angle_deg(turn @ true.T) < 0.05
        apart = np.linalg.norm(image.translation - turn @ first.translation)
        truth = np.linalg.norm(POSES[image.index][:, 3] - true @ POSES[0][:, 3])
        assert apart == pytest.approx(truth, rel=0.02)


def test_apply_seed_poses_shares_refined_focal_length(
    problem: MappingProblem, mapped: MappingResult
) -> None:
    refined = replace(CAMERA, fx=540.0, fy=540.0)
    images = mapped.reconstructions[0].images[:2]
    known = replace(problem.images[4], known_pose=(np.eye(3), np.ones(3)))
    problem = replace(problem, images=(*problem.images[:4], known))
    started = apply_seed_poses(problem, [replace(image, camera=refined) for image in images])
    assert {image.camera for image in started.images} == {refined}
    given = [image.known_pose is not None for image in started.images]
    assert given == [True, True, False, False, True]
    assert started.images[4].known_pose is known.known_pose
