"""Tests of point covariances against a dense inverse, COLMAP and sampling."""

from dataclasses import replace

import numpy as np
import pycolmap
import pytest

from mpsfm_core.optimize.bundle_adjustment import BundleProblem
from mpsfm_core.optimize.covariance import (
    DAMPING,
    CalibrationStd,
    compute_point_covariances,
    compute_pose_covariance,
    propagate_depth_variance,
)
from tests.optimize.bundle_reference import (
    ceres_adjuster,
    dense_point_information,
    make_problem,
    rotation,
    soft_l1,
    to_pycolmap,
)


@pytest.mark.parametrize("depth", [True, False])
def test_point_covariance_equals_dense_inverse(depth: bool) -> None:
    problem = make_problem(5, 40, 3.5)
    problem = problem if depth else replace(problem, obs_log_depth=None)
    count = len(problem.points)
    information = dense_point_information(problem) + DAMPING * np.eye(3 * count)
    inverse = np.linalg.inv(information).reshape(count, 3, count, 3)
    expected = inverse[np.arange(count), :, np.arange(count)]
    actual = compute_point_covariances(problem, soft_l1())
    scale = np.linalg.norm(expected, axis=(1, 2), keepdims=True)
    np.testing.assert_allclose(actual / scale, expected / scale, atol=1e-6)
    np.testing.assert_array_equal(actual, actual.transpose(0, 2, 1))


def test_point_covariance_equals_colmap() -> None:
    problem = replace(make_problem(8, 300, 4), obs_log_depth=None)
    rec = to_pycolmap(problem)
    options = pycolmap.BACovarianceOptions(params=pycolmap.BACovarianceOptionsParams.POINTS)
    adjuster = ceres_adjuster(rec)
    theirs = pycolmap.estimate_ba_covariance(options, rec, adjuster)
    expected = np.stack([theirs.get_point_cov(p + 1) for p in range(300)])
    np.testing.assert_allclose(
        compute_point_covariances(problem, soft_l1()), expected, rtol=1e-6, atol=1e-12
    )


def test_depth_decreases_the_variance() -> None:
    problem = make_problem(5, 40, 3)
    with_depth = np.trace(compute_point_covariances(problem, soft_l1()), axis1=1, axis2=2)
    without = np.trace(
        compute_point_covariances(replace(problem, obs_log_depth=None), soft_l1()), axis1=1, axis2=2
    )
    assert (with_depth < without).all()


def test_covariance_equals_scatter_of_triangulated_depth() -> None:
    """Points triangulated from keypoints with 1 px of noise scatter as the covariance predicts."""
    rng = np.random.default_rng(0)
    turns = np.stack([rotation(np.array([0, 0.1, 0])), rotation(np.array([0.1, -0.2, 0.3]))])
    point = np.array([0.2, -0.1, 4.0])
    problem = BundleProblem(
        rotations=turns,
        translations=np.array([[0.1, 0, 0], [-0.8, 0, 0.2]]),
        intrinsics=np.array([[1000.0, 1000.0, 500.0, 500.0]]),
        camera_of_image=np.array([0, 0]),
        points=point[None],
        obs_image=np.array([0, 1]),
        obs_point=np.array([0, 0]),
        obs_xy=np.zeros((2, 2)),
        variable_pose=np.zeros(2, dtype=np.bool_),
    )
    in_camera = np.einsum("nij,j->ni", turns, point) + problem.translations
    xy = 1000 * in_camera[:, :2] / in_camera[:, 2:] + 500
    trivial = soft_l1(reprojection_loss=0)
    covariance = compute_point_covariances(replace(problem, obs_xy=xy), trivial)
    jacobian = np.empty((4, 3))
    for a in range(3):
        moved = in_camera + 1e-6 * turns[:, :, a]
        jacobian[:, a] = ((1000 * moved[:, :2] / moved[:, 2:] + 500 - xy) / 1e-6).ravel()
    samples = rng.normal(size=(20_000, 4)) @ np.linalg.pinv(jacobian).T
    for turn in turns:
        sampled = (samples @ turn[2]).var()
        predicted = propagate_depth_variance(covariance, turn)
        assert predicted.shape == (1,)
        assert predicted[0] == pytest.approx(sampled, rel=0.05)


def test_depth_variance_is_the_rotated_last_entry() -> None:
    rng = np.random.default_rng(0)
    factors = rng.normal(size=(50, 3, 3))
    covariances = factors @ factors.transpose(0, 2, 1)
    turns = np.stack([rotation(v) for v in rng.normal(size=(50, 3))])
    expected = [(r @ s @ r.T)[2, 2] for r, s in zip(turns, covariances, strict=True)]
    np.testing.assert_allclose(propagate_depth_variance(covariances, turns), expected, rtol=1e-12)
    one = propagate_depth_variance(covariances, turns[0])
    assert one[7] == pytest.approx((turns[0] @ covariances[7] @ turns[0].T)[2, 2], rel=1e-12)


def test_unobserved_directions_have_huge_but_finite_variance() -> None:
    """Test points of a single view, a point behind the camera, and a point without observation."""
    problem = BundleProblem(
        rotations=rotation(np.array([0.3, -0.2, 0.1]))[None],
        translations=np.zeros((1, 3)),
        intrinsics=np.array([[1000.0, 1000.0, 500.0, 500.0]]),
        camera_of_image=np.array([0]),
        points=np.array([[0.1, 0.1, 0.01], [0, 0.1, 2], [1, 1, 1e3], [0, 0, -2], [0, 0, 3]]),
        obs_image=np.zeros(4, dtype=np.int64),
        obs_point=np.arange(4),
        obs_xy=np.full((4, 2), 500.0),
    )
    covariances = compute_point_covariances(problem, soft_l1())
    assert np.isfinite(covariances).all()
    np.testing.assert_allclose(covariances[3:], np.eye(3) / DAMPING * np.ones((2, 1, 1)))
    values, vectors = np.linalg.eigh(covariances[1])
    ray = problem.points[1] / np.linalg.norm(problem.points[1])
    assert values[2] > 1e4 * values[1]
    assert abs(vectors[:, 2] @ ray) > 1 - 1e-6


def pose_problem() -> tuple[tuple[np.ndarray, np.ndarray], np.ndarray, np.ndarray]:
    """Return the pose and intrinsics of a camera, and points (40, 3) in front of it."""
    rng = np.random.default_rng(3)
    points = rng.uniform([-2, -2, 4], [2, 2, 9], (40, 3))
    turn = rotation(np.array([0.1, -0.2, 0.3]))
    return (turn, np.array([0.3, -0.1, 0.2])), np.array([500.0, 520.0, 320.0, 240.0]), points @ turn


def test_pose_covariance_equals_scatter_of_refined_poses() -> None:
    pose, intrinsics, points = pose_problem()
    rng = np.random.default_rng(4)
    noise = 1e-4 * np.einsum("nij,nkj->nik", *2 * [rng.normal(size=(40, 3, 3))])
    covariance = compute_pose_covariance(pose, intrinsics, points, noise, np.ones(40))
    jacobian = np.linalg.cholesky(noise)

    def project(turned: np.ndarray, moved: np.ndarray, xyz: np.ndarray) -> np.ndarray:
        camera = xyz @ (turned @ pose[0]).T + pose[1] + moved
        return intrinsics[:2] * camera[:, :2] / camera[:, 2:]

    def derivative(step: np.ndarray) -> np.ndarray:
        change = rotation(step[:3]), step[3:]
        return (project(*change, points) - project(np.eye(3), np.zeros(3), points)).ravel() / 1e-6

    numeric = np.column_stack([derivative(1e-6 * axis) for axis in np.eye(6)])
    errors = np.zeros((80, 80))
    for row in range(40):
        for axis in range(3):
            shifted = points.copy()
            shifted[row] += 1e-6 * jacobian[row, :, axis]
            base = project(np.eye(3), np.zeros(3), points)
            column = (project(np.eye(3), np.zeros(3), shifted) - base).ravel() / 1e-6
            errors += np.outer(column, column)
    expected = np.linalg.inv(numeric.T @ np.linalg.inv(errors + np.eye(80)) @ numeric)
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    np.testing.assert_allclose(covariance / scale, expected / scale, atol=1e-4)


def test_guessed_camera_increases_the_pose_covariance() -> None:
    pose, intrinsics, points = pose_problem()
    exact = np.zeros((40, 3, 3)), np.ones(40)
    known = compute_pose_covariance(pose, intrinsics, points, *exact)
    focal = compute_pose_covariance(
        pose, intrinsics, points, *exact, CalibrationStd(0.7, 1e-9, 1e-9)
    )
    center = compute_pose_covariance(
        pose, intrinsics, points, *exact, CalibrationStd(0.7, 10.0, 1e-9)
    )
    assert focal[5, 5] > 2 * known[5, 5]
    assert np.sqrt(center[1, 1]) == pytest.approx(10.0 / 500.0, rel=0.5)


def test_scale_error_of_all_points_moves_the_camera() -> None:
    pose, intrinsics, points = pose_problem()
    exact = np.zeros((40, 3, 3)), np.full(40, 1e-3)
    origin = np.array([1.0, 2.0, 3.0])
    shifts = 0.1 * (points - origin)[..., None]
    covariance = compute_pose_covariance(pose, intrinsics, points, *exact, None, shifts)
    center = -pose[0].T @ pose[1]
    expected = 0.1 * np.linalg.norm(pose[0] @ (center - origin))
    assert np.sqrt(np.trace(covariance[3:, 3:])) == pytest.approx(expected, rel=0.01)


def test_one_point_determines_no_pose() -> None:
    pose, intrinsics, points = pose_problem()
    covariance = compute_pose_covariance(
        pose, intrinsics, points[:1], np.zeros((1, 3, 3)), np.ones(1)
    )
    assert not np.isfinite(covariance).all() or np.diag(covariance).max() > 1e6
