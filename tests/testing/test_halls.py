"""Tests of synthetic halls: true matches, declared prior errors, repeatability."""

from __future__ import annotations

import numpy as np

from mpsfm_core.geometry import project, transform
from mpsfm_core.testing.synthetic.halls import (
    CALIBRATED_PRIORS,
    EXACT_PRIORS,
    LOCALLY_BIASED_PRIORS,
    HallProblem,
    PriorErrors,
    make_hall_problem,
)

VIEWS = 9


def hall(errors: PriorErrors = EXACT_PRIORS) -> HallProblem:
    return make_hall_problem(VIEWS, errors, points_per_view=30, map_width=80)


def log_errors(errors: PriorErrors) -> list[np.ndarray]:
    """Return the relative depth errors of each view."""
    pairs = zip(hall(errors).problem.images, hall().problem.images, strict=True)
    return [np.log(image.depth.depth / true.depth.depth) for image, true in pairs]


def test_most_matches_join_what_is_the_same_point() -> None:
    problem, truth, points = hall()
    poses = list(truth.values())
    assert len(problem.pairs) >= VIEWS
    near, same = [], []
    for pair in problem.pairs:
        a, b = problem.images[pair.image_a], problem.images[pair.image_b]
        xy = a.keypoints[pair.matches[:, 0]]
        column, row = np.floor(xy / 8).astype(np.int64).T.clip(0)
        depth = a.depth.depth[row.clip(0, 59), column.clip(0, 79)].astype(np.float64)
        rays = np.column_stack([(xy - a.camera.params[2:]) / a.camera.params[:2], np.ones(len(xy))])
        rotation, translation = poses[pair.image_a]
        world = (rays * depth[:, None] - translation) @ rotation
        there = project(b.camera, transform(*poses[pair.image_b], world))
        near.append(np.linalg.norm(there - b.keypoints[pair.matches[:, 1]], axis=1) < 12)
        numbers = points[pair.image_a], points[pair.image_b]
        same.append(numbers[0][pair.matches[:, 0]] == numbers[1][pair.matches[:, 1]])
    assert 0.94 < np.concatenate(same).mean() < 0.96
    # 5 % of the matches are wrong, and depth edges cause a few more.
    assert 0.85 < np.concatenate(near).mean() < 0.97


def test_relative_poses_are_estimated_and_good() -> None:
    problem, truth, _ = hall()
    poses = list(truth.values())
    for pair in problem.pairs:
        turn = poses[pair.image_b][0] @ poses[pair.image_a][0].T
        assert np.trace(turn @ pair.rotation.T) > 1 + 2 * np.cos(np.radians(5.0))


def test_honest_priors_are_off_as_declared() -> None:
    errors = log_errors(CALIBRATED_PRIORS)
    assert 0.02 < np.std(np.concatenate([(e - e.mean()).ravel() for e in errors])) < 0.06
    assert np.std([e.mean() for e in errors]) < 3 * CALIBRATED_PRIORS.scale


def test_locally_wrong_priors_are_off_by_more_in_a_tenth_of_the_area() -> None:
    plain = log_errors(PriorErrors(patch=LOCALLY_BIASED_PRIORS.patch))
    for error in plain:
        assert abs(np.mean(np.abs(error) > 0.1) - 0.1) < 0.01
        np.testing.assert_allclose(np.abs(error).max(), np.log(1.2), rtol=1e-3)


def test_same_seed_gives_the_same_hall() -> None:
    first, second = hall(CALIBRATED_PRIORS).problem, hall(CALIBRATED_PRIORS).problem
    for a, b in zip(first.images, second.images, strict=True):
        np.testing.assert_array_equal(a.keypoints, b.keypoints)
        np.testing.assert_array_equal(a.depth.depth, b.depth.depth)
    for p, q in zip(first.pairs, second.pairs, strict=True):
        np.testing.assert_array_equal(p.matches, q.matches)
        np.testing.assert_array_equal(p.rotation, q.rotation)
