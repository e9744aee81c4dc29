"""Tests of the pose from ray segments: derivatives, optimum against scipy and COLMAP, truth."""

from __future__ import annotations

import numpy as np
import pycolmap
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from mpsfm_core.data import Float64, Pose
from mpsfm_core.geometry import rotation_angle_deg
from mpsfm_core.optimize.resection import (
    POSE,
    FrameImage,
    RaySegments,
    linearize_pose,
    measure_segments,
    refine_pose,
)

INTRINSICS = np.array([500.0, 480.0, 320.0, 240.0])
NARROWING = np.array([5.0, 3.0, 2.0, *np.ones(9)])
TRUTH = Rotation.from_rotvec([0.1, -0.2, 0.05]).as_matrix(), np.array([0.3, -0.1, 0.2])


def moved(pose: Pose, step: Float64) -> Pose:
    return Rotation.from_rotvec(step[:3]).as_matrix() @ pose[0], pose[1] + step[3:]


def project(pose: Pose, points: Float64) -> Float64:
    camera = points @ pose[0].T + pose[1]
    return camera[:, :2] / camera[:, 2:] * INTRINSICS[:2] + INTRINSICS[2:]


def segments(
    count: int = 60, *, slack: float = 0.1, noise_px: float = 0.0, limit: float = 4.0, seed: int = 0
) -> RaySegments:
    """Return ray segments of a camera at the origin, whose points the true pose observes."""
    rng = np.random.default_rng(seed)
    points = rng.uniform([-2, -2, 3], [2, 2, 8], (count, 3))
    middle = points * np.exp(rng.uniform(-slack, slack, (count, 1)))
    return RaySegments(
        near=middle * np.exp(-slack),
        far=middle * np.exp(slack),
        xy=project(TRUTH, points) + rng.normal(0, noise_px, (count, 2)),
        limit=np.full(count, limit),
        weight=rng.uniform(0.2, 1, count),
    )


def errors(pose: Pose) -> tuple[float, float]:
    """Return the rotation error in degrees and the translation error of a pose."""
    turn = float(rotation_angle_deg(pose[0] @ TRUTH[0].T))
    return turn, float(np.linalg.norm(pose[1] - TRUTH[1]))


def alone(seen: RaySegments) -> list[FrameImage]:
    """Return the only image of a frame."""
    return [FrameImage((np.eye(3), np.zeros(3)), INTRINSICS, seen)]


def objective(pose: Pose, seen: RaySegments, scale: float = 1.0) -> tuple[float, Float64, Float64]:
    matrix, gradient = np.empty((POSE, POSE)), np.empty(POSE)
    cost = linearize_pose(*pose, INTRINSICS, seen, scale, matrix, gradient)
    return cost, gradient, matrix


def densely(pose: Pose, seen: RaySegments) -> tuple[Float64, Float64]:
    """Compute pixel distances and depths from many points of each segment."""
    share = np.linspace(0, 1, 20001)[:, None, None]
    points = (1 - share) * seen.near + share * seen.far
    camera = points @ pose[0].T + pose[1]
    pixels = camera[..., :2] / camera[..., 2:] * INTRINSICS[:2] + INTRINSICS[2:]
    distances = np.linalg.norm(pixels - seen.xy, axis=-1)
    best = distances.argmin(axis=0)
    columns = np.arange(len(seen.xy))
    return distances[best, columns], camera[best, columns, 2]


def test_distance_and_depth_are_those_of_the_nearest_point_of_the_segment() -> None:
    seen = segments(slack=0.3, noise_px=5.0)
    pose = moved(TRUTH, np.array([0.01, 0.02, -0.01, 0.05, 0.02, -0.1]))
    found, expected = measure_segments(pose, INTRINSICS, seen), densely(pose, seen)
    np.testing.assert_allclose(found[0], expected[0], atol=1e-3)
    np.testing.assert_allclose(found[1], expected[1], rtol=1e-3)


def test_points_behind_the_camera_have_no_distance_and_depth() -> None:
    seen = segments(4)
    seen.near[1] = -seen.near[1]
    seen.far[2] = -seen.far[2]
    distance, depth = measure_segments(TRUTH, INTRINSICS, seen)
    assert np.isnan(distance).tolist() == np.isnan(depth).tolist() == [False, True, True, False]


@pytest.mark.parametrize("slack", [0.0, 0.02, 0.5])
@pytest.mark.parametrize("scale", [1.0, 5.0])
def test_gradient_equals_finite_differences(slack: float, scale: float) -> None:
    seen = segments(slack=slack, noise_px=2.0)
    pose = moved(TRUTH, np.array([0.002, -0.003, 0.001, 0.01, -0.02, 0.015]))
    cost, gradient, _ = objective(pose, seen, scale)
    assert 0 < cost < seen.weight.sum() / 6
    step = 1e-6
    numeric = [
        objective(moved(pose, step * axis), seen, scale)[0]
        - objective(moved(pose, -step * axis), seen, scale)[0]
        for axis in np.eye(POSE)
    ]
    np.testing.assert_allclose(gradient, np.array(numeric) / (2 * step), rtol=1e-5, atol=1e-6)


def test_matrix_equals_finite_differences_of_residuals() -> None:
    """Segments have length zero, and a large limit gives all weights the same value."""
    limit = 1e5
    seen = segments(slack=0.0, noise_px=1.0, limit=limit)
    pose = moved(TRUTH, np.full(POSE, 0.01))
    step = 1e-6
    jacobian = np.stack(
        [
            project(moved(pose, step * axis), seen.near)
            - project(moved(pose, -step * axis), seen.near)
            for axis in np.eye(POSE)
        ],
        axis=-1,
    ) / (2 * step)
    weights = seen.weight / limit**2
    expected = np.einsum("n,nij,nik->jk", weights, jacobian, jacobian)
    np.testing.assert_allclose(objective(pose, seen)[2], expected, rtol=1e-5)


def test_pose_with_wrong_matches_is_found_from_distant_start() -> None:
    seen = segments(200, slack=0.05)
    rng = np.random.default_rng(1)
    wrong = rng.random(200) < 0.3
    seen.xy[wrong] = rng.uniform(0, 480, (wrong.sum(), 2))
    start = moved(TRUTH, np.array([0.02, -0.02, 0.02, 0.1, 0.1, -0.1]))
    off = measure_segments(start, INTRINSICS, seen)[0][~wrong]
    assert np.median(off) > 4.0
    found = refine_pose(start, alone(seen), scales=NARROWING)
    turn, shift = errors(found)
    assert turn < 0.05
    assert shift < 0.01


def test_optimum_of_noisy_points_equals_scipy() -> None:
    seen = segments(80, slack=0.0, noise_px=1.0)

    def residuals(step: Float64) -> Float64:
        """Their squares are twice the objective's summands."""
        distance = np.linalg.norm(project(moved(TRUTH, step), seen.near) - seen.xy, axis=1)
        ratio = np.minimum(1, (distance / seen.limit) ** 2)
        values: Float64 = np.sqrt(seen.weight * (1 - (1 - ratio) ** 3) / 3)
        return values

    expected = moved(TRUTH, least_squares(residuals, np.zeros(POSE), xtol=1e-12, ftol=1e-12).x)
    found = refine_pose(TRUTH, alone(seen), scales=np.ones(50))
    np.testing.assert_allclose(found[0], expected[0], atol=1e-6)
    np.testing.assert_allclose(found[1], expected[1], atol=1e-5)


def test_pose_from_points_is_as_accurate_as_colmap() -> None:
    """COLMAP minimizes another robust loss of the same errors."""
    seen = segments(200, slack=0.0, noise_px=0.5, seed=3)
    start = moved(TRUTH, np.array([0.01, -0.01, 0.01, 0.05, 0.05, -0.05]))
    found = refine_pose(start, alone(seen), scales=NARROWING)
    camera = pycolmap.Camera(model="PINHOLE", width=640, height=480, params=INTRINSICS)
    colmap = pycolmap.refine_absolute_pose(
        pycolmap.Rigid3d(pycolmap.Rotation3d(start[0]), start[1]),
        seen.xy,
        seen.near,
        np.ones(200, dtype=np.bool_),
        camera,
    )["cam_from_world"]
    other = errors((colmap.rotation.matrix(), colmap.translation))
    assert all(mine < 1.3 * theirs for mine, theirs in zip(errors(found), other, strict=True))


def test_undetermined_pose_is_unchanged() -> None:
    seen = segments(5)
    far_off = seen._replace(xy=seen.xy + 1e4)
    found = refine_pose(TRUTH, alone(far_off), scales=np.ones(3))
    np.testing.assert_array_equal(found[0], TRUTH[0])
    np.testing.assert_array_equal(found[1], TRUTH[1])
    one = RaySegments(*(values[:1] for values in seen))
    assert np.isfinite(refine_pose(TRUTH, alone(one), scales=np.ones(3))[1]).all()


def test_pose_of_frame_is_determined_by_all_images() -> None:
    """Two points in each of three images determine the pose, and no image determines it alone."""
    images = []
    for number, angle in enumerate((0.0, 1.5, 3.0)):
        relative = (
            Rotation.from_rotvec([0.1, angle, 0.0]).as_matrix(),
            np.array([0.1 * number, 0.2, 0.0]),
        )
        of_image = relative[0] @ TRUTH[0], relative[0] @ TRUTH[1] + relative[1]
        rays = np.random.default_rng(number).uniform(-0.5, 0.5, (2, 2))
        depth = np.array([2.0, 3.0])[:, None]
        points = (depth * np.column_stack([rays, np.ones(2)]) - of_image[1]) @ of_image[0]
        xy = rays * INTRINSICS[:2] + INTRINSICS[2:]
        seen = RaySegments(points, points, xy, np.full(2, 4.0), np.ones(2))
        images.append(FrameImage(relative, INTRINSICS, seen))
    start = moved(TRUTH, np.array([0.01, -0.02, 0.01, 0.02, 0.03, -0.03]))
    turn, shift = errors(refine_pose(start, images, scales=NARROWING))
    assert turn < 1e-4
    assert shift < 1e-4
    turn, shift = errors(refine_pose(start, images[:1], scales=NARROWING))
    assert shift > 1e-3
