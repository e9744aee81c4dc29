"""Synthetic mapping problems of any size, in which cameras observe a hall with boxes.

The cameras stand on a grid and differ by small rotations from their neighbors, so that neighboring
views overlap well. Keypoints are noisy and some matches are wrong, as in real images after
geometric verification.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import cv2
import numpy as np
import pycolmap
from scipy.spatial import cKDTree

from mpsfm_core.data import (
    Bool,
    DepthPrior,
    Float32,
    Float64,
    Int64,
    MappingProblem,
    PinholeCamera,
    Pose,
    VerifiedPair,
)
from mpsfm_core.geometry import camera_center
from mpsfm_core.testing.synthetic.problems import (
    SyntheticNoise,
    make_verified_pair,
    render_mapping_image,
)
from mpsfm_core.testing.synthetic.scenes import AnalyticScene, Box, Surface, look_at, project

CAMERA = PinholeCamera(640, 480, 420.0, 420.0, 320.0, 240.0)
SPACING = 1.5
"""Distance in meters between neighboring cameras of the grid."""
TURN_DEG = 20.0
"""Rotation in degrees between neighboring cameras of the grid."""
REACH = 2.6
"""Largest distance in meters between the cameras of a matched image pair."""
MAX_MATCH_TURN_DEG, MAX_MATCH_ZOOM = 40.0, 1.8
"""Largest angle in degrees between the two viewing rays of a matched point, and largest ratio of
the point's distances from the two cameras."""
MIN_MATCHES = 30
"""Smallest number of surface points that two matched images have in common."""


@dataclass(frozen=True)
class PriorErrors:
    """Model of depth errors in a hall, ``depth * exp(scale * n + f(x, y) + patch)``."""

    scale: float = 0.0
    """Std of the relative depth error that a whole image shares."""
    field: float = 0.0
    """Std of relative depth errors at the nodes of a grid, interpolated by cubic splines."""
    grid: tuple[int, int] = (8, 6)
    """Numbers of columns and rows of the grid of independent depth errors."""
    patch: float = 0.0
    """Relative depth error, of either sign, inside one ellipse of the depth map."""
    patch_area: float = 0.1
    """Area of the ellipse with the additional depth error, relative to the area of the depth
    map."""
    declared: float = 0.01
    """Relative std that the depth prior reports."""


EXACT_PRIORS = PriorErrors()
CALIBRATED_PRIORS = PriorErrors(scale=0.05, field=0.04, declared=0.06)
LOCALLY_BIASED_PRIORS = replace(CALIBRATED_PRIORS, patch=0.2)
QUALITIES = {
    "exact": EXACT_PRIORS,
    "calibrated": CALIBRATED_PRIORS,
    "locally biased": LOCALLY_BIASED_PRIORS,
}


class HallProblem(NamedTuple):
    """Synthetic mapping problem of a hall or of streets with its true solution."""

    problem: MappingProblem
    truth: dict[str, Pose]
    """True camera pose ``cam_from_world`` by image name."""
    points: tuple[Int64, ...]
    """Indices (n,) of the surface points that the keypoints of each image observe."""


def make_hall_problem(
    views: int,
    errors: PriorErrors = EXACT_PRIORS,
    *,
    points_per_view: int = 60,
    map_width: int = 160,
    keypoint_noise_px: float = 0.7,
    wrong_matches: float = 0.05,
    seed: int = 0,
) -> HallProblem:
    """Create a synthetic mapping problem of a hall with boxes.

    Args:
        views: Number of views.
        errors: Model of the errors of the depth priors.
        points_per_view: Number of surface points that are sampled in each view. Every sampled point
            that a view sees becomes a keypoint of this view.
        map_width: Width of the depth and normal prior maps in pixels.
        keypoint_noise_px: Std of the errors of keypoint positions in pixels.
        wrong_matches: Ratio of wrong matches of each image pair, which connect random keypoints.
        seed: Seed of the random scene, surface points and errors.

    Returns:
        The mapping problem with its true solution.
    """
    rng = np.random.default_rng(seed)
    poses, scene = make_hall(views, rng)
    parts = [remove_hidden_boxes(scene, pose) for pose in poses]
    return observe_scene(
        parts,
        poses,
        REACH,
        errors,
        rng,
        points_per_view=points_per_view,
        map_width=map_width,
        keypoint_noise_px=keypoint_noise_px,
        wrong_matches=wrong_matches,
    )


def observe_scene(
    parts: Sequence[AnalyticScene],
    poses: Sequence[Float64],
    reach: float,
    errors: PriorErrors,
    rng: np.random.Generator,
    *,
    points_per_view: int = 60,
    map_width: int = 160,
    keypoint_noise_px: float = 0.7,
    wrong_matches: float = 0.05,
) -> HallProblem:
    """Create the mapping problem of views of a scene, in time nearly linear in their number.

    Args:
        parts: Surfaces that each view can see.
        poses: Pose ``cam_from_world`` (3, 4) of each view.
        reach: Largest distance in meters between the cameras of two views of a surface point.
        errors: Model of the errors of the depth priors.
        rng: Random generator of surface points and errors.
        points_per_view: See :func:`make_hall_problem`.
        map_width: See :func:`make_hall_problem`.
        keypoint_noise_px: See :func:`make_hall_problem`.
        wrong_matches: See :func:`make_hall_problem`.
    """
    eyes = np.array([camera_center(pose[:, :3], pose[:, 3]) for pose in poses])
    numbers, pixels = _keypoints(parts, poses, eyes, reach, points_per_view, rng)
    noise = SyntheticNoise(keypoints_px=keypoint_noise_px)
    images = []
    for i, (pose, xy) in enumerate(zip(poses, pixels, strict=True)):
        noisy = xy + keypoint_noise_px * rng.normal(size=xy.shape)
        name = f"view_{i:04d}.png"
        image = render_mapping_image(
            name, parts[i], CAMERA, pose, noisy, map_width, 0.01, 2.0, noise, rng
        )
        depth = _add_depth_errors(image.depth.depth, errors, rng)
        prior = DepthPrior.from_arrays(depth, (errors.declared * depth) ** 2)
        images.append(replace(image, depth=prior))
    pairs = []
    for a, b in _list_near_pairs(eyes, reach):
        _, rows_a, rows_b = np.intersect1d(numbers[a], numbers[b], return_indices=True)
        if len(rows_a) >= MIN_MATCHES:
            matches = np.stack([rows_a, rows_b], axis=1)
            pair = _corrupt_matches(make_verified_pair(a, b, matches, poses), wrong_matches, rng)
            pairs.append(_estimate_pose(pair, images[a].keypoints, images[b].keypoints))
    truth = {
        image.name: (pose[:, :3], pose[:, 3]) for image, pose in zip(images, poses, strict=True)
    }
    return HallProblem(MappingProblem(tuple(images), tuple(pairs)), truth, tuple(numbers))


def make_hall(views: int, rng: np.random.Generator) -> tuple[list[Float64], AnalyticScene]:
    """Create camera poses on a square grid and a hall with boxes between the cameras.

    Args:
        views: Number of views.
        rng: Random generator of the boxes and of small changes of the poses.

    Returns:
        Pose ``cam_from_world`` (3, 4) of each view, and the scene.
    """
    side = int(np.ceil(np.sqrt(views)))
    row, column = np.divmod(np.arange(views), side)
    # The cameras are in serpentine order, so that consecutive views are neighbors.
    column = np.where(row % 2 == 0, column, side - 1 - column)
    eyes = SPACING * np.column_stack([column, row, np.full(views, 1.5)])
    eyes += rng.uniform(-0.1, 0.1, eyes.shape)
    heading = np.radians(TURN_DEG) * (column + row) + rng.normal(0, 0.05, views)
    ahead = np.column_stack([np.cos(heading), np.sin(heading), rng.normal(-0.1, 0.05, views)])
    poses = [look_at(eye, eye + step) for eye, step in zip(eyes, ahead, strict=True)]
    middle, half = SPACING * (side - 1) / 2, SPACING * (side - 1) / 2 + 2.5
    surfaces: list[Surface] = [Box((middle, middle, 1.8), (half, half, 1.8))]
    for x in range(-2, side + 1):
        for y in range(-2, side + 1):
            if rng.uniform() < 0.35:
                size = rng.uniform(0.15, 0.4, 2)
                height = rng.uniform(0.2, 1.1)
                at = SPACING * (x + 0.5), SPACING * (y + 0.5), height
                surfaces.append(Box(at, (*size, height), yaw_deg=float(rng.uniform(0, 90))))
    return poses, AnalyticScene(tuple(surfaces))


def remove_hidden_boxes(scene: AnalyticScene, pose: Float64) -> AnalyticScene:
    """Remove the boxes outside of the view frustum, which the camera cannot see."""
    centers, radii = scene.bounding_spheres
    local = centers @ pose[:, :3].T + pose[:, 3]
    slope = np.array(CAMERA.size) / (2 * np.array(CAMERA.params[:2]))
    beside = np.abs(local[:, :2]) - slope * local[:, 2:]
    outside = (beside > radii[:, None] * np.hypot(1, slope)).any(axis=1) | (local[:, 2] < -radii)
    return AnalyticScene(tuple(scene.surfaces[row] for row in np.flatnonzero(~outside)))


def _keypoints(
    parts: Sequence[AnalyticScene],
    poses: Sequence[Float64],
    eyes: Float64,
    reach: float,
    points_per_view: int,
    rng: np.random.Generator,
) -> tuple[list[Int64], list[Float64]]:
    """Return the indices and the pixels of the surface points that each view sees."""
    size = np.array(CAMERA.size, dtype=np.float64)
    numbers: list[list[Int64]] = [[] for _ in poses]
    pixels: list[list[Float64]] = [[] for _ in poses]
    for i, pose in enumerate(poses):
        seen = parts[i].sample(CAMERA, pose, rng.uniform(2, size - 2, (points_per_view, 2)))
        for j in map(int, np.flatnonzero(np.linalg.norm(eyes - eyes[i], axis=1) <= reach)):
            xy, depth = project(CAMERA, poses[j], seen.points)
            visible = seen.valid & (depth > 0) & (xy > 0).all(axis=1) & (xy < size).all(axis=1)
            visible &= _can_match(seen.points - eyes[i], seen.points - eyes[j])
            rows = np.flatnonzero(visible)
            t, _, _ = parts[j].first_hit(eyes[j], seen.points[rows] - eyes[j])
            rows = rows[np.abs(t - 1) < 1e-6]
            numbers[j].append(i * points_per_view + rows)
            pixels[j].append(xy[rows])
    return [np.concatenate(n) for n in numbers], [np.concatenate(p) for p in pixels]


def _list_near_pairs(eyes: Float64, reach: float) -> list[tuple[int, int]]:
    """Return the sorted pairs of views whose distances to a third view may be within the reach."""
    pairs = cKDTree(eyes).query_pairs(2 * reach + 1e-6)
    return sorted(pairs)


def _can_match(rays_a: Float64, rays_b: Float64) -> Bool:
    """Return which points can be matched, given their viewing rays (m, 3) from two views."""
    a, b = np.linalg.norm(rays_a, axis=1), np.linalg.norm(rays_b, axis=1)
    cosine = (rays_a * rays_b).sum(axis=1) / (a * b)
    alike: Bool = (cosine > np.cos(np.radians(MAX_MATCH_TURN_DEG))) & (
        np.maximum(a, b) < MAX_MATCH_ZOOM * np.minimum(a, b)
    )
    return alike


def _corrupt_matches(pair: VerifiedPair, share: float, rng: np.random.Generator) -> VerifiedPair:
    """Make a given ratio of the matches wrong by permuting keypoints of the second image."""
    matches = pair.matches.copy()
    wrong = rng.choice(len(matches), round(share * len(matches)), replace=False)
    matches[wrong, 1] = np.roll(matches[wrong, 1], 1)
    return replace(pair, matches=matches)


def _estimate_pose(pair: VerifiedPair, keypoints_a: Float64, keypoints_b: Float64) -> VerifiedPair:
    """Replace the relative pose of an image pair by the estimate from its noisy matches."""
    camera = pycolmap.Camera(model="PINHOLE", width=640, height=480, params=CAMERA.params)
    found = pycolmap.estimate_essential_matrix(
        keypoints_a[pair.matches[:, 0]],
        keypoints_b[pair.matches[:, 1]],
        camera,
        camera,
        pycolmap.RANSACOptions(
            max_error=2.0, min_num_trials=50, max_num_trials=1000, random_seed=0
        ),
    )
    pose = found["cam2_from_cam1"]
    return replace(pair, rotation=pose.rotation.matrix(), translation=np.array(pose.translation))


def _add_depth_errors(depth: Float32, errors: PriorErrors, rng: np.random.Generator) -> Float32:
    """Add the errors of a depth network to a depth map (h, w)."""
    height, width = depth.shape
    log_factor = errors.scale * rng.normal() + errors.field * _draw_error_field(
        depth.shape, errors, rng
    )
    axes = np.sqrt(errors.patch_area / np.pi) * np.array([width, height])
    center = rng.uniform(axes, np.array([width, height]) - axes)
    sign = rng.choice([-1.0, 1.0])
    y, x = np.mgrid[:height, :width] + 0.5
    inside = ((x - center[0]) / axes[0]) ** 2 + ((y - center[1]) / axes[1]) ** 2 < 1
    log_factor += sign * np.log1p(errors.patch) * inside
    wrong: Float32 = (depth * np.exp(log_factor)).astype(np.float32)
    return wrong


def _draw_error_field(
    shape: tuple[int, ...], errors: PriorErrors, rng: np.random.Generator
) -> Float64:
    """Interpolate independent errors of std 1 from the nodes of a grid to a depth map (h, w)."""
    nodes = rng.normal(size=errors.grid[::-1])
    field: Float64 = cv2.resize(nodes, shape[::-1], interpolation=cv2.INTER_CUBIC)
    return field
