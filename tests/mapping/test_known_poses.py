"""Tests of images with known poses: fixed, refined, or without common points."""

from __future__ import annotations

import logging
from dataclasses import replace

import numpy as np
import pytest

from mpsfm_core.data import DepthPrior, Float64, MappingProblem, PinholeCamera
from mpsfm_core.data.decisions import ImageReason
from mpsfm_core.geometry import rotation_angle_deg
from mpsfm_core.mapping.mapper import reconstruct
from mpsfm_core.mapping.options import MapperOptions
from mpsfm_core.mapping.scene.reconstruction import RegisteredImage
from mpsfm_core.testing.synthetic.problems import SyntheticNoise, make_mapping_problem
from mpsfm_core.testing.synthetic.scenes import arc_poses, room_scene

CAMERA = PinholeCamera(640, 480, 520.0, 520.0, 320.0, 240.0)
FIXED = MapperOptions(known_poses="fixed")
RING = [(0, 1), (1, 2), (2, 3), (3, 4)]


def with_poses(problem: MappingProblem, poses: dict[int, Float64]) -> MappingProblem:
    """Return the mapping problem with known poses of some images."""
    images = tuple(
        replace(image, known_pose=(poses[i][:, :3].copy(), poses[i][:, 3].copy()))
        if i in poses
        else image
        for i, image in enumerate(problem.images)
    )
    return MappingProblem(images, problem.pairs)


def depth_ratio(image: RegisteredImage, poses: list[Float64]) -> float:
    """Return the median ratio of refined to true depth of an image."""
    rows, columns = image.depth.shape
    truth = room_scene().render(CAMERA.resized(columns, rows), poses[image.index]).depth
    return float(np.median(image.depth.depth[image.depth.valid] / truth[image.depth.valid]))


def test_fixed_poses_stay_and_give_the_world_its_unit() -> None:
    poses = arc_poses(4, 14.0)
    problem = make_mapping_problem(room_scene(), CAMERA, poses, noise=SyntheticNoise(scale=0.1))
    doubled = {i: np.column_stack([p[:, :3], 2 * p[:, 3]]) for i, p in enumerate(poses)}
    fixed = MapperOptions(known_poses="fixed")
    reconstruction = reconstruct(with_poses(problem, doubled), fixed).reconstructions[0]
    assert len(reconstruction.images) == 4
    for image in reconstruction.images:
        assert np.array_equal(image.rotation, doubled[image.index][:, :3])
        assert np.array_equal(image.translation, doubled[image.index][:, 3])
        assert depth_ratio(image, poses) == pytest.approx(2.0, rel=0.01)


def test_partial_model_is_extended_by_other_images() -> None:
    poses = arc_poses(5, 14.0)
    problem = with_poses(
        make_mapping_problem(room_scene(), CAMERA, poses), {i: poses[i] for i in (0, 1, 2)}
    )
    reconstruction = reconstruct(problem).reconstructions[0]
    assert len(reconstruction.images) == 5
    for image in reconstruction.images:
        assert rotation_angle_deg(image.rotation @ poses[image.index][:, :3].T) < 0.05
    first = reconstruction.images[0]
    assert np.allclose(first.translation, poses[0][:, 3], atol=0.02)


def test_fixed_poses_determine_the_scale_of_each_prior() -> None:
    poses = arc_poses(4, 14.0)
    problem = with_poses(make_mapping_problem(room_scene(), CAMERA, poses), dict(enumerate(poses)))
    first, *others = problem.images
    depth = first.depth
    assert depth.variance is not None
    far = DepthPrior(4 * depth.depth, 16 * depth.variance, depth.valid, metric=True)
    problem = replace(problem, images=(replace(first, depth=far), *others))
    for image in reconstruct(problem, FIXED).reconstructions[0].images:
        assert depth_ratio(image, poses) == pytest.approx(1.0, rel=0.01)


def test_images_without_pose_are_left_out_if_poses_are_fixed() -> None:
    poses = arc_poses(4, 14.0)
    problem = make_mapping_problem(room_scene(), CAMERA, poses)
    problem = with_poses(problem, {i: poses[i] for i in (0, 1, 2)})
    result = reconstruct(problem, FIXED)
    assert [image.index for image in result.reconstructions[0].images] == [0, 1, 2]
    reasons = result.report.image_reasons
    assert reasons == {"view_3.png": ImageReason.NO_KNOWN_POSE.because()}


@pytest.fixture
def apart() -> tuple[MappingProblem, list[Float64]]:
    """Return a chain of five images, of which images 0, 2 and 4 have known poses but no common
    matches."""
    poses = arc_poses(5, 14.0)
    problem = make_mapping_problem(room_scene(), CAMERA, poses, links=RING)
    return with_poses(problem, {i: poses[i] for i in (0, 2, 4)}), poses


def test_known_poses_without_common_points_lose_no_image(
    apart: tuple[MappingProblem, list[Float64]], caplog: pytest.LogCaptureFixture
) -> None:
    problem, poses = apart
    (model,) = reconstruct(problem).reconstructions
    assert len(model.images) == 5
    first = model.images[0]
    for image in model.images:
        turn = image.rotation @ first.rotation.T
        truth = poses[image.index][:, :3] @ poses[0][:, :3].T
        assert rotation_angle_deg(turn @ truth.T) < 0.5
    assert "starts without these poses" in caplog.text
    assert model.metric is not None and model.metric.trusted, "the world is ours"


def test_fixed_poses_without_common_points_give_no_scale(
    apart: tuple[MappingProblem, list[Float64]], caplog: pytest.LogCaptureFixture
) -> None:
    problem, poses = apart
    with caplog.at_level(logging.WARNING):
        (model,) = reconstruct(problem, FIXED).reconstructions
    assert [image.index for image in model.images] == [0, 2, 4]
    assert all(np.array_equal(i.translation, poses[i.index][:, 3]) for i in model.images)
    assert model.metric is None
    assert "the scale of their depth is unknown" in caplog.text
