"""Tests of the localization of images in a model with fixed poses."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mpsfm_core.data import Float64, MappingProblem, PinholeCamera, Pose, Rig, VerifiedPair
from mpsfm_core.data.decisions import ImageReason, Reason
from mpsfm_core.geometry import (
    camera_center,
    compose,
    invert,
    project,
    rotation_angle_deg,
    transform,
)
from mpsfm_core.mapping.localization import (
    FixedModel,
    LocalizedImage,
    Localizer,
    snap_to_observations,
    triangulate_model,
)
from mpsfm_core.mapping.options import MapperOptions
from mpsfm_core.mapping.scene.reconstruction import RegisteredImage
from mpsfm_core.testing.synthetic.problems import make_mapping_problem
from mpsfm_core.testing.synthetic.scenes import arc_poses, room_scene

CAMERA = PinholeCamera(640, 480, 520.0, 520.0, 320.0, 240.0)
OPTIONS = MapperOptions()
POSES = arc_poses(5, 14.0)
QUERY = 4
FRAME = QUERY - 1, QUERY


@pytest.fixture(scope="module")
def problem() -> MappingProblem:
    """Five images, of which all but the last have a known pose."""
    made = make_mapping_problem(room_scene(), CAMERA, POSES)
    known = {
        image.name: (pose[:, :3].copy(), pose[:, 3].copy())
        for image, pose in zip(made.images[:QUERY], POSES, strict=False)
    }
    return made.with_poses(known)


@pytest.fixture(scope="module")
def model(problem: MappingProblem) -> FixedModel:
    return triangulate(problem)


def triangulate(problem: MappingProblem) -> FixedModel:
    """Return the model of the images with a known pose."""
    known = {image.name: image.known_pose for image in problem.images if image.known_pose}
    return triangulate_model(problem.subset(list(known)).with_poses(known), OPTIONS)


def locate(problem: MappingProblem, model: FixedModel) -> LocalizedImage:
    """Return the localized query."""
    outcome = Localizer(problem, model, OPTIONS).localize(QUERY)
    assert isinstance(outcome, LocalizedImage)
    return outcome


def reprojection(image: RegisteredImage, points: Float64) -> Float64:
    """Project points (n, 3) in the world to pixels (n, 2) of an image."""
    return project(image.camera, transform(image.rotation, image.translation, points))


def split(pose: Float64) -> Pose:
    """Return rotation and translation of a pose (3, 4)."""
    return pose[:, :3].copy(), pose[:, 3].copy()


def center_error(image: LocalizedImage) -> float:
    """Return the distance in meters from the true camera center of the query."""
    true_center = camera_center(POSES[QUERY][:, :3], POSES[QUERY][:, 3])
    return float(np.linalg.norm(camera_center(image.rotation, image.translation) - true_center))


def test_localize_query_gives_accurate_pose_with_covariance(
    problem: MappingProblem, model: FixedModel
) -> None:
    image = locate(problem, model)
    assert rotation_angle_deg(image.rotation @ POSES[QUERY][:, :3].T) < 0.05
    assert center_error(image) < 0.01
    assert 0.8 * image.num_matches < image.num_inliers <= image.num_matches
    std = np.sqrt(np.diag(image.covariance))
    assert (std > 0).all() and center_error(image) < 5 * np.linalg.norm(std[3:])
    assert sum(len(rows) for rows, _ in image.matches.values()) >= image.num_inliers


def test_localize_leaves_the_model_unchanged(problem: MappingProblem, model: FixedModel) -> None:
    localizer = Localizer(problem, model, OPTIONS)
    first, second = localizer.localize(QUERY), localizer.localize(QUERY)
    assert isinstance(first, LocalizedImage) and isinstance(second, LocalizedImage)
    assert np.array_equal(first.rotation, second.rotation)
    assert np.array_equal(first.covariance, second.covariance)


def test_localize_by_one_image_uses_points_lifted_from_its_depth(
    problem: MappingProblem, model: FixedModel
) -> None:
    pairs = tuple(p for p in problem.pairs if p.image_b != QUERY or p.image_a == QUERY - 1)
    untriangulated = {**model.state, "point_of": np.full_like(model.state["point_of"], -1)}
    without_points = replace(model, state=untriangulated)
    image = locate(replace(problem, pairs=pairs), without_points)
    assert list(image.matches) == [problem.images[QUERY - 1].name]
    assert center_error(image) < 0.1
    exact = locate(problem, model)
    assert np.trace(image.covariance) > np.trace(exact.covariance)


def test_localize_estimates_a_guessed_focal_length(
    problem: MappingProblem, model: FixedModel
) -> None:
    query = problem.images[QUERY]
    guess = replace(CAMERA, fx=1.3 * CAMERA.fx, fy=1.3 * CAMERA.fy)
    guessed = replace(query, camera=guess, focal_known=False, focal_log_std=0.7)
    image = locate(replace(problem, images=(*problem.images[:QUERY], guessed)), model)
    assert image.camera.fx == pytest.approx(CAMERA.fx, rel=0.01)
    assert center_error(image) < 0.05
    assert np.trace(image.covariance) > np.trace(locate(problem, model).covariance)


def test_wrong_depth_of_an_image_of_the_model_rejects_no_query(problem: MappingProblem) -> None:
    """The depth of one image is half of the true depth, where the image has no matches."""
    last = problem.images[QUERY - 1]
    wrong = last.depth.depth.copy()
    wrong[: len(wrong) // 2] *= np.float32(0.5)
    changed = replace(last, depth=replace(last.depth, depth=wrong))
    is_low = last.keypoints[:, 1] > CAMERA.height / 2 + 20

    def without_upper_half(pair: VerifiedPair) -> VerifiedPair:
        ends = zip((pair.image_a, pair.image_b), pair.matches.T, strict=True)
        kept = [is_low[rows] for image, rows in ends if image == QUERY - 1]
        rows = np.logical_and.reduce([np.ones(len(pair), np.bool_), *kept])
        return replace(pair, matches=pair.matches[rows], scores=pair.scores[rows])

    images = (*problem.images[: QUERY - 1], changed, problem.images[QUERY])
    problem = MappingProblem(images, tuple(map(without_upper_half, problem.pairs)))
    model = triangulate(problem)
    assert model.wrong_depth == (QUERY - 1,)
    found = locate(problem, model)
    assert center_error(found) < 0.01 and found.contradiction is None
    # Unless the wrong depth is known, the query is localized without the depth check.
    unchecked = locate(problem, replace(model, wrong_depth=()))
    assert center_error(unchecked) < 0.01 and unchecked.contradiction is not None
    assert unchecked.contradiction.code is ImageReason.CONTRADICTS_IMAGE
    assert unchecked.contradiction.values["other_image"] == last.name


def test_localize_image_without_matches_returns_the_reason(
    problem: MappingProblem, model: FixedModel
) -> None:
    pairs = tuple(pair for pair in problem.pairs if pair.image_b != QUERY)
    outcome = Localizer(replace(problem, pairs=pairs), model, OPTIONS).localize(QUERY)
    assert isinstance(outcome, Reason) and outcome.code == ImageReason.NO_VERIFIED_MATCHES


def test_snapped_matches_observe_the_points_of_the_model(
    problem: MappingProblem, model: FixedModel
) -> None:
    shift = len(problem.images[0].keypoints)
    first = problem.images[0]
    doubled = replace(first, keypoints=np.concatenate([first.keypoints, first.keypoints + 0.3]))
    pairs = tuple(
        replace(pair, matches=pair.matches + np.array([shift, 0]))
        if (pair.image_a, pair.image_b) == (0, QUERY)
        else pair
        for pair in problem.pairs
    )
    images = (doubled, *problem.images[1:])
    snapped = snap_to_observations(MappingProblem(images, pairs), model, 1.0)
    observed = model.state["point_of"][:shift] >= 0
    (pair,) = (p for p in snapped.pairs if (p.image_a, p.image_b) == (0, QUERY))
    (original,) = (p for p in problem.pairs if (p.image_a, p.image_b) == (0, QUERY))
    rows, original_rows = pair.matches[:, 0], original.matches[:, 0]
    assert observed[original_rows].any()
    assert np.array_equal(rows < shift, observed[original_rows])


def test_localize_together_reaches_an_image_by_another_query(problem: MappingProblem) -> None:
    """The last image matches only the image before it, which is a query, too."""
    chain = QUERY - 1
    images = [
        replace(i, known_pose=i.known_pose if k < chain else None)
        for k, i in enumerate(problem.images)
    ]
    pairs = tuple(p for p in problem.pairs if p.image_b != QUERY or p.image_a == chain)
    problem = MappingProblem(tuple(images), pairs)
    localizer = Localizer(problem, triangulate(problem), OPTIONS)
    outcomes = localizer.localize_together([chain, QUERY])
    assert all(isinstance(outcome, LocalizedImage) for outcome in outcomes)
    assert isinstance(outcomes[1], LocalizedImage) and center_error(outcomes[1]) < 0.05
    _, part = localizer.localize_sequence([chain, QUERY])
    assert [image.index for image in part.images] == [chain, QUERY]
    last = part.images[-1]
    observed = last.point_ids >= 0
    keypoints = problem.images[QUERY].keypoints[observed]
    errors = reprojection(last, part.points[last.point_ids[observed]]) - keypoints
    assert observed.sum() > 30 and np.median(np.linalg.norm(errors, axis=1)) < 2
    assert isinstance(localizer.localize(QUERY), Reason)


def make_rig_problem(problem: MappingProblem, scale: float) -> MappingProblem:
    """Make the last two images a frame of a rig with a baseline in units of ``scale``."""
    images = tuple(
        replace(image, known_pose=None if k in FRAME else image.known_pose)
        for k, image in enumerate(problem.images)
    )
    first, second = (split(POSES[k]) for k in FRAME)
    rotation, translation = compose(second, invert(*first))
    sensors = (np.eye(3), np.zeros(3)), (rotation, translation / scale)
    rig = Rig(sensors, (tuple(images[k].name for k in FRAME),))
    return MappingProblem(images, problem.pairs, (rig,))


def test_images_of_a_rig_share_the_pose_of_their_frame(problem: MappingProblem) -> None:
    """The second image has no matches, so its pose follows from the first image and the rig."""
    made = make_rig_problem(problem, 1.0)
    made = replace(made, pairs=tuple(p for p in made.pairs if p.image_b != FRAME[1]))
    model = triangulate(made)
    first, second = Localizer(made, model, OPTIONS).localize_together(FRAME)
    assert isinstance(first, LocalizedImage) and isinstance(second, LocalizedImage)
    assert second.num_inliers == 0 and center_error(second) < 0.05
    traces = [np.trace(image.covariance) for image in (first, second)]
    assert traces[0] == pytest.approx(traces[1]) and np.isfinite(traces[0])
    alone = Localizer(replace(made, rigs=()), model, OPTIONS).localize_together(FRAME)
    assert isinstance(alone[1], Reason)


def test_matches_of_both_images_refine_the_scale_of_a_rig(problem: MappingProblem) -> None:
    made = make_rig_problem(problem, 1.1)
    outcomes = Localizer(made, triangulate(made), OPTIONS).localize_together(FRAME)
    centers = [camera_center(o.rotation, o.translation) for o in outcomes]  # type: ignore[union-attr]
    np.testing.assert_allclose(centers, [camera_center(*split(POSES[k])) for k in FRAME], atol=0.02)
