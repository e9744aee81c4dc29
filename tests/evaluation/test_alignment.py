"""Tests of trajectory errors after a similarity transform."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mpsfm_core.evaluation.alignment import trajectory_errors
from mpsfm_core.evaluation.pose_auc import Pose
from mpsfm_core.geometry import camera_center
from mpsfm_core.geometry.similarity import umeyama


def poses_at(centers: np.ndarray, rotations: np.ndarray) -> dict[str, Pose]:
    return {
        str(i): (rotation, -rotation @ center)
        for i, (center, rotation) in enumerate(zip(centers, rotations, strict=True))
    }


def test_umeyama_recovers_exact_similarity() -> None:
    rng = np.random.default_rng(0)
    for flat in (1.0, 0.0):
        points = rng.normal(size=(20, 3)) * [1.0, 1.0, flat]
        rotation = Rotation.random(rng=rng).as_matrix()
        target = 2.5 * points @ rotation.T + [1.0, -2.0, 3.0]
        found = umeyama(points, target)
        assert found.scale == pytest.approx(2.5)
        np.testing.assert_allclose(found.rotation, rotation, atol=1e-12)
        np.testing.assert_allclose(found.apply(points), target, atol=1e-12)


def test_umeyama_is_least_squares_without_reflection() -> None:
    rng = np.random.default_rng(1)
    a = rng.normal(size=(12, 3))
    b = a * [1.0, 1.0, -1.0] + 0.1 * rng.normal(size=(12, 3))
    found = umeyama(a, b)
    assert np.linalg.det(found.rotation) == pytest.approx(1)
    best = ((found.apply(a) - b) ** 2).sum()
    for _ in range(200):
        turn = Rotation.from_rotvec(0.05 * rng.normal(size=3)).as_matrix() @ found.rotation
        scale = found.scale * (1 + 0.05 * rng.normal())
        moved = scale * a @ turn.T
        assert ((moved - moved.mean(0) - b + b.mean(0)) ** 2).sum() >= best


def test_trajectory_errors_are_in_unit_of_truth() -> None:
    rng = np.random.default_rng(2)
    centers = rng.normal(size=(8, 3))
    rotations = Rotation.random(8, rng=rng).as_matrix()
    truth = poses_at(centers, rotations)
    frame = Rotation.random(rng=rng).as_matrix()
    estimated = poses_at(0.1 * centers @ frame + 5.0, rotations @ frame)
    turned = Rotation.from_euler("x", 3, degrees=True).as_matrix() @ estimated["4"][0]
    estimated["4"] = (turned, -turned @ camera_center(*estimated["4"]))
    errors = trajectory_errors(estimated, truth)
    assert errors is not None
    assert errors.ate_rmse == pytest.approx(0, abs=1e-9)
    assert errors.truth_from_estimate.scale == pytest.approx(10)
    # One of eight orientations has an error of 3 degrees, which rotates the mean by 3/8 degrees.
    assert errors.rotations_deg[4] == pytest.approx(3 * 7 / 8, abs=0.01)
    assert np.delete(errors.rotations_deg, 4) == pytest.approx([3 / 8] * 7, abs=0.01)


def test_ate_measures_displaced_camera() -> None:
    angles = np.linspace(0, 2 * np.pi, 1000, endpoint=False)
    centers = np.stack([np.cos(angles), np.sin(angles), 0 * angles], axis=1)
    truth = poses_at(centers, np.broadcast_to(np.eye(3), (1000, 3, 3)))
    centers[10] += [0, 0, 0.5]
    estimated = poses_at(centers, np.broadcast_to(np.eye(3), (1000, 3, 3)))
    errors = trajectory_errors(estimated, truth)
    assert errors is not None
    assert errors.centers[10] == pytest.approx(0.5, abs=0.005)
    assert errors.ate_rmse == pytest.approx(0.5 / np.sqrt(1000), rel=0.01)


def test_trajectory_errors_degenerate_centers_return_none() -> None:
    truth = poses_at(np.eye(3), np.stack([np.eye(3)] * 3))
    assert trajectory_errors({name: truth[name] for name in ("0", "1")}, truth) is None
    assert trajectory_errors(poses_at(np.zeros((3, 3)), np.stack([np.eye(3)] * 3)), truth) is None


def test_rpe_measures_steps() -> None:
    rng = np.random.default_rng(4)
    centers = np.cumsum(rng.normal(size=(6, 3)), axis=0)
    rotations = Rotation.random(6, rng=rng).as_matrix()
    truth = poses_at(centers, rotations)
    frame = Rotation.random(rng=rng).as_matrix()
    exact = trajectory_errors(poses_at(3 * centers @ frame, rotations @ frame), truth)
    assert exact is not None
    assert exact.rpe_rmse == pytest.approx(0, abs=1e-9)
    assert exact.rpe_rmse_deg == pytest.approx(0, abs=1e-6)
    # The first image is rotated by 4 degrees about its center, so the first relative pose has
    # errors of rotation and translation.
    turn = Rotation.from_euler("y", 4, degrees=True).as_matrix()
    turned = dict(truth)
    turned["0"] = (turn @ truth["0"][0], turn @ truth["0"][1])
    errors = trajectory_errors(turned, truth)
    assert errors is not None
    assert errors.step_turns_deg == pytest.approx([4, 0, 0, 0, 0], abs=1e-6)
    step = truth["0"][1] - truth["0"][0] @ truth["1"][0].T @ truth["1"][1]
    assert errors.steps[0] == pytest.approx(np.linalg.norm(turn @ step - step), rel=1e-6)
    assert errors.steps[1:] == pytest.approx([0] * 4, abs=1e-9)
