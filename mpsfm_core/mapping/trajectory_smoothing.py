"""Smoothing of the camera trajectory of a video with a constant-velocity prior.

The prior is white noise on the acceleration of camera center and rotation (Barfoot, State
Estimation for Robotics, 2017). Its power is estimated from the trajectory itself. A Kalman filter
and a Rauch-Tung-Striebel smoother combine the prior with the poses and covariances of all frames.
Accurate poses hardly change, and frames without a pose are interpolated with a larger covariance.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from mpsfm_core.data import Float64, Pose
from mpsfm_core.geometry import camera_center

_DOF = 6
"""Degrees of freedom of a pose: rotation vector and camera center, in the world frame."""
_MEDIAN_CHI2 = 0.4549
"""Median of the chi-squared distribution with one degree of freedom."""
_MIN_MOTION_RATIO = 0.05
"""Minimum share of the observed variance of acceleration that is not measurement noise. [ours]"""
_NO_MOTION = 1e-12
"""Lower bound of variances, for a trajectory without motion."""


@dataclass(frozen=True, eq=False)
class SmoothedPose:
    """Pose of the smoothed trajectory."""

    pose: Pose
    """``cam_from_world`` as rotation (3, 3) and translation (3,)."""
    covariance: Float64
    """(6, 6) covariance of ``w`` and ``dc`` in ``R <- exp(w) R, c <- c + dc`` with rotation ``R``
    of ``world_from_cam`` and camera center ``c``, in radians and units of the model."""


def smooth_trajectory(
    times: Sequence[float], poses: Sequence[tuple[Pose, Float64] | None]
) -> list[SmoothedPose]:
    """Estimate the poses of all frames of a trajectory, also of frames without a measured pose.

    Args:
        times: Time of each frame in seconds, ascending.
        poses: Pose ``cam_from_world`` with its covariance (6, 6) of ``w`` and ``dt`` in ``R <-
            exp(w) R, t <- t + dt``, or None. The first and last frame have a pose.
    """
    seconds = np.asarray(times, dtype=np.float64)
    measured = np.array([pose is not None for pose in poses])
    rotations, centers = _fill_gaps(seconds, poses)
    noise = [None if pose is None else _covariance_in_world(*pose) for pose in poses]
    if len(poses) == 1:
        assert noise[0] is not None
        return [_correct_pose(rotations[0], centers[0], np.zeros(_DOF), noise[0])]
    steps = np.diff(seconds)
    increments = np.column_stack(
        [
            Rotation.from_matrix(rotations[1:] @ rotations[:-1].transpose(0, 2, 1)).as_rotvec(),
            np.diff(centers, axis=0),
        ]
    )
    power = _estimate_power(steps, increments, measured, noise)
    states, covariances = _smooth(steps, increments, noise, power)
    return [
        _correct_pose(rotation, center, state, covariance)
        for rotation, center, state, covariance in zip(
            rotations, centers, states, covariances, strict=True
        )
    ]


def interpolate_pose(first: Pose, second: Pose, ratio: float) -> Pose:
    """Interpolate two poses ``cam_from_world``; a ratio of 0 gives the first pose."""
    turn = Rotation.from_matrix(second[0] @ first[0].T).as_rotvec()
    rotation = Rotation.from_rotvec(ratio * turn).as_matrix() @ first[0]
    center = (1 - ratio) * camera_center(*first) + ratio * camera_center(*second)
    return rotation, -rotation @ center


def _fill_gaps(
    seconds: Float64, poses: Sequence[tuple[Pose, Float64] | None]
) -> tuple[Float64, Float64]:
    """Interpolate missing poses; return rotations ``world_from_cam`` and centers of all frames."""
    known = [row for row, pose in enumerate(poses) if pose is not None]
    filled: list[Pose] = []
    for row in range(len(poses)):
        after = int(np.searchsorted(known, row))
        pose = poses[row]
        if pose is not None:
            filled.append(pose[0])
            continue
        first, second = poses[known[after - 1]], poses[known[after]]
        assert first is not None and second is not None
        start, end = seconds[known[after - 1]], seconds[known[after]]
        ratio = float((seconds[row] - start) / (end - start))
        filled.append(interpolate_pose(first[0], second[0], ratio))
    rotations = np.stack([pose[0].T for pose in filled])
    return rotations, np.stack([camera_center(*pose) for pose in filled])


def _covariance_in_world(pose: Pose, covariance: Float64) -> Float64:
    """Convert the covariance of ``w`` and ``dt`` to rotation and camera center in the world."""
    rotation, (x, y, z) = pose
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    jacobian = np.zeros((_DOF, _DOF))
    jacobian[:3, :3] = -rotation.T
    jacobian[3:, :3] = -rotation.T @ cross
    jacobian[3:, 3:] = -rotation.T
    world: Float64 = jacobian @ covariance @ jacobian.T
    return world


def _estimate_power(
    steps: Float64,
    increments: Float64,
    measured: np.ndarray[tuple[int], np.dtype[np.bool_]],
    noise: Sequence[Float64 | None],
) -> Float64:
    """Estimate the power (6,) of the acceleration noise of rotation and of the camera center."""
    velocity = increments / steps[:, None]
    rows = np.flatnonzero(measured[:-2] & measured[1:-1] & measured[2:]) + 1
    speed = np.median(velocity**2, axis=0) / max(float(np.median(steps)), _NO_MOTION)
    if not len(rows):
        return np.maximum(_pool(speed), _NO_MOTION)
    variance = np.array([_NO_MOTION * np.ones(_DOF) if n is None else np.diag(n) for n in noise])
    before, after = steps[rows - 1, None], steps[rows, None]
    change = (velocity[rows] - velocity[rows - 1]) ** 2
    expected = variance[rows - 1] / before**2 + variance[rows + 1] / after**2
    expected += variance[rows] * (1 / before + 1 / after) ** 2
    scale = 3 / (before + after)
    observed = np.median(change * scale, axis=0) / _MEDIAN_CHI2
    explained = np.median(expected * scale, axis=0)
    power = np.maximum(observed - explained, _MIN_MOTION_RATIO * observed)
    return np.maximum(_pool(power), _NO_MOTION)


def _pool(values: Float64) -> Float64:
    """Replace the values (6,) by the mean over rotation axes and the mean over center axes."""
    return np.repeat([values[:3].mean(), values[3:].mean()], 3)


def _smooth(
    steps: Float64, increments: Float64, noise: Sequence[Float64 | None], power: Float64
) -> tuple[Float64, Float64]:
    """Run filter and smoother; return pose corrections (n, 6) and covariances (n, 6, 6)."""
    count, eye = len(noise), np.eye(_DOF)
    first = noise[0]
    assert first is not None
    state = np.concatenate([np.zeros(_DOF), increments[0] / steps[0]])
    spread = np.zeros((2 * _DOF, 2 * _DOF))
    spread[:_DOF, :_DOF] = first
    spread[_DOF:, _DOF:] = np.diag(state[_DOF:] ** 2 + 100 * power * steps[0])
    filtered, predicted, transitions = [(state, spread)], [], []
    for row in range(1, count):
        dt = steps[row - 1]
        transition = np.eye(2 * _DOF)
        transition[:_DOF, _DOF:] = dt * eye
        drift = np.kron([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]], np.diag(power))
        state = transition @ state
        state[:_DOF] -= increments[row - 1]
        spread = transition @ spread @ transition.T + drift
        predicted.append((state, spread))
        transitions.append((transition, drift))
        measurement = noise[row]
        if measurement is not None:
            gain = np.linalg.solve(spread[:_DOF, :_DOF] + measurement, spread[:_DOF]).T
            state = state - gain @ state[:_DOF]
            kept = np.eye(2 * _DOF)
            kept[:, :_DOF] -= gain
            spread = kept @ spread @ kept.T + gain @ measurement @ gain.T  # Joseph form
        filtered.append((state, spread))
    states, spreads = [filtered[-1][0]], [filtered[-1][1]]
    for row in range(count - 2, -1, -1):
        (state, spread), (ahead, ahead_spread) = filtered[row], predicted[row]
        transition, drift = transitions[row]
        gain = np.linalg.solve(ahead_spread, transition @ spread).T
        kept = np.eye(2 * _DOF) - gain @ transition
        states.append(state + gain @ (states[-1] - ahead))
        # This form of the covariance is positive semidefinite despite rounding.
        spreads.append(kept @ spread @ kept.T + gain @ (spreads[-1] + drift) @ gain.T)
    return (
        np.stack(states[::-1])[:, :_DOF],
        np.stack(spreads[::-1])[:, :_DOF, :_DOF],
    )


def _correct_pose(
    rotation: Float64, center: Float64, correction: Float64, covariance: Float64
) -> SmoothedPose:
    cam_from_world = (Rotation.from_rotvec(correction[:3]).as_matrix() @ rotation).T
    symmetric = (covariance + covariance.T) / 2
    return SmoothedPose((cam_from_world, -cam_from_world @ (center + correction[3:])), symmetric)
