"""Synthetic mapping problem of two similar rooms, whose views match each other wrongly.

The two rooms are next to each other with the same walls, door and furniture, except for one or two
pieces of furniture. Each view of one room also matches views of the other room. Only views of the
corridor and of the differing furniture tell the two rooms apart.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations
from typing import NamedTuple

import numpy as np

from mpsfm_core.data import Bool, DepthPrior, Float64, Int64, MappingProblem, PinholeCamera
from mpsfm_core.geometry import camera_center, inside, pixel_centers
from mpsfm_core.testing.synthetic.degraded_depth import DepthErrors, degrade_depth
from mpsfm_core.testing.synthetic.problems import (
    SyntheticNoise,
    make_verified_pair,
    render_mapping_image,
)
from mpsfm_core.testing.synthetic.scenes import (
    AnalyticScene,
    Box,
    Sphere,
    Surface,
    look_at,
    project,
)

SHIFT = np.array([5.2, 0.0, 0.0])
"""Vector in meters from a point of the first room to its copy in the second room."""
CAMERA = PinholeCamera(640, 480, 400.0, 400.0, 320.0, 240.0)
VIEWS_PER_ROOM = 7
"""Number of views per room."""
_POINTS_PER_VIEW = 60
"""Number of surface points that are sampled in each view."""
_MAP_WIDTH = 160
"""Width of the depth and normal prior maps in pixels."""
MIN_MATCHES = 15
"""Smallest number of verified matches of an image pair [COLMAP min_num_inliers]."""
MIN_SIGHT = 0.3
"""Smallest free distance in meters in front of a camera, which excludes cameras inside of
furniture."""


class SymmetricProblem(NamedTuple):
    """Synthetic mapping problem of two similar rooms with its true solution."""

    problem: MappingProblem
    poses: list[Float64]
    """True pose ``cam_from_world`` (3, 4) of each view."""
    room: list[int]
    """Index of the room of each view, which is 0, 1, or -1 in the corridor."""
    false: list[bool]
    """True for each image pair whose matches connect points with their copies in the other room."""


def make_twin_rooms() -> AnalyticScene:
    """Return two rooms of 5 x 4 x 2.6 m, at x from 0 and from 5.2, and a corridor at y < 0."""
    shell = Box((5.1, 1.2, 1.3), (5.1, 2.8, 1.3))
    walls = [
        _block((5.0, 0.0, 0.0), (5.2, 4.0, 2.6)),
        _block((0.0, -0.1, 0.0), (1.0, 0.0, 2.6)),
        _block((2.6, -0.1, 0.0), (6.2, 0.0, 2.6)),
        _block((7.8, -0.1, 0.0), (10.2, 0.0, 2.6)),
    ]
    lintels = [_block((x, -0.1, 2.2), (x + 1.6, 0.0, 2.6)) for x in (1.0, 6.2)]
    same: list[Surface] = []
    for x in (0.0, SHIFT[0]):
        same += [
            Box((x + 2.6, 2.0, 0.35), (0.6, 0.4, 0.35), yaw_deg=20.0),  # table
            Sphere((x + 2.5, 2.0, 0.9), 0.2),
            _block((x + 4.4, 1.0, 0.0), (x + 5.0, 2.2, 1.9)),  # cupboard
            _block((x, 2.8, 0.0), (x + 1.4, 4.0, 0.5)),  # bed
        ]
    different: list[Surface] = [
        # Only the first room has a wardrobe, and only the second room has a bookshelf.
        _block((2.0, 3.2, 0.0), (4.6, 4.0, 1.9)),
        _block((5.2, 0.6, 0.0), (6.0, 2.4, 2.1)),
    ]
    return AnalyticScene((shell, *walls, *lintels, *same, *different))


def make_twin_room_poses(seed: int) -> tuple[list[Float64], list[int]]:
    """Create camera poses in both rooms and along the corridor.

    The camera positions vary with the seed. Cameras that would be inside of furniture are moved in
    front of the furniture.

    Args:
        seed: Seed of the camera positions.

    Returns:
        Pose ``cam_from_world`` (3, 4) of each view, and its room: 0, 1, or -1 in the corridor.
    """
    rng = np.random.default_rng(seed)
    eyes, targets, room = [], [], []
    for number in (0, 1):
        middle = np.array([2.5, 1.9, 1.4]) + number * SHIFT
        turn = rng.uniform(0, 2 * np.pi / VIEWS_PER_ROOM)
        for angle in turn + 2 * np.pi * np.arange(VIEWS_PER_ROOM) / VIEWS_PER_ROOM:
            outward = np.array([1.7 * np.cos(angle), 1.3 * np.sin(angle), 0.0])
            eyes.append(middle + outward)
            targets.append(middle - 0.7 * outward - [0.0, 0.0, 0.4])
            room.append(number)
    walk = [
        ((2.3, 0.9, 1.5), (1.7, -1.5, 1.3)),
        ((1.8, -1.2, 1.5), (2.0, 3.0, 1.1)),
        ((1.4, -1.2, 1.5), (3.2, 0.3, 1.3)),
        ((1.0, -1.0, 1.5), (6.0, -0.7, 1.2)),
        ((2.6, -0.9, 1.5), (7.5, -0.6, 1.2)),
        ((4.4, -1.1, 1.5), (8.2, 0.2, 1.2)),
        ((6.0, -1.2, 1.5), (7.6, 1.5, 1.2)),
        ((7.0, -1.2, 1.5), (7.2, 3.0, 1.1)),
        ((7.5, 0.9, 1.5), (6.9, -1.5, 1.3)),
    ]
    for eye, target in walk:
        eyes.append(np.asarray(eye))
        targets.append(np.asarray(target))
    room += [0, *[-1] * (len(walk) - 2), 1]
    jitter = rng.normal(0, 0.08, (2, len(eyes), 3))
    looks = zip(eyes + jitter[0], targets + jitter[1], strict=True)
    scene = make_twin_rooms()
    return [_move_to_free_space(scene, eye, target) for eye, target in looks], room


def _move_to_free_space(scene: AnalyticScene, eye: Float64, target: Float64) -> Float64:
    """Move a camera towards its target until the free distance in front exceeds MIN_SIGHT."""
    pixels = pixel_centers(*CAMERA.size)[::80, ::80].reshape(-1, 2)
    step = 0.1 * (target - eye) / np.linalg.norm(target - eye)
    while True:
        pose = look_at(eye, target)
        sights = scene.sample(CAMERA, pose, pixels).points - eye
        if np.linalg.norm(sights, axis=1).max() > MIN_SIGHT:
            return pose
        eye = eye + step


def make_twin_room_problem(
    seed: int = 0,
    *,
    errors: DepthErrors | None = None,
    keypoint_noise_px: float = 0.5,
) -> SymmetricProblem:
    """Create a synthetic mapping problem of two similar rooms.

    A keypoint matches the same point in another view as well as the copy of the point in the other
    room. Geometric verification keeps either the matches of equal points or those of copies,
    whichever are more frequent.

    Args:
        seed: Seed of the random poses, surface points and errors.
        errors: Model of the errors of the depth priors, which report the std of these errors. If
            None, the depth priors are exact and report a relative std of 1 %.
        keypoint_noise_px: Std of the errors of keypoint positions in pixels.

    Returns:
        The mapping problem with its true solution.
    """
    scene = make_twin_rooms()
    poses, room = make_twin_room_poses(seed)
    rng = np.random.default_rng([seed, 1])
    numbers, keypoints = _keypoints(scene, poses, rng)
    noise = SyntheticNoise(keypoints_px=keypoint_noise_px)
    images = []
    for i, (pose, xy) in enumerate(zip(poses, keypoints, strict=True)):
        noisy = xy + keypoint_noise_px * rng.normal(size=xy.shape)
        image = render_mapping_image(
            f"view_{i}.png", scene, CAMERA, pose, noisy, _MAP_WIDTH, 0.01, 2.0, noise, rng
        )
        if errors:
            depth = degrade_depth(image.depth.depth, image.name, errors, seed)
            image = replace(image, depth=DepthPrior.from_arrays(depth, (errors.std * depth) ** 2))
        images.append(image)
    pairs, false = [], []
    for a, b in combinations(range(len(poses)), 2):
        # View b may see the points of view a (shift 0) or their copies, in either direction.
        found = [
            (len(matches), abs(shift), shift, matches)
            for shift in (0, 1, -1)
            if len(matches := _matches(numbers[a], numbers[b], shift)) >= MIN_MATCHES
        ]
        if found:
            _, _, shift, matches = max(found, key=lambda item: item[:2])
            views = list(poses)
            views[b] = shift_pose(poses[b], shift)
            pairs.append(make_verified_pair(a, b, matches, views))
            false.append(shift != 0)
    return SymmetricProblem(MappingProblem(tuple(images), tuple(pairs)), poses, room, false)


def _keypoints(
    scene: AnalyticScene, poses: Sequence[Float64], rng: np.random.Generator
) -> tuple[list[Int64], list[Float64]]:
    """Return the surface points that each view sees, and their pixels.

    A point is identified by a sample number and the number of rooms (-1, 0 or 1) by which the
    sample is shifted.
    """
    size = np.array(CAMERA.size, dtype=np.float64)
    numbers: list[list[Int64]] = [[] for _ in poses]
    pixels: list[list[Float64]] = [[] for _ in poses]
    for i, pose in enumerate(poses):
        samples = scene.sample(CAMERA, pose, rng.uniform(2, size - 2, (_POINTS_PER_VIEW, 2)))
        for copy in (-1, 0, 1):
            points = samples.points + copy * SHIFT
            twins = (samples.points[:, 1] > 0) & (points[:, 0] > 0) & (points[:, 0] < 10.2)
            for j, other in enumerate(poses):
                xy, seen = _find_visible(scene, other, points)
                rows = np.flatnonzero(seen & (twins | (copy == 0)))
                label = np.full(len(rows), copy)
                numbers[j].append(np.stack([i * _POINTS_PER_VIEW + rows, label], axis=1))
                pixels[j].append(xy[rows])
    return [np.concatenate(n) for n in numbers], [np.concatenate(p) for p in pixels]


def shift_pose(pose: Float64, shift: int) -> Float64:
    """Return the pose (3, 4) of a camera that is moved back by ``shift`` rooms."""
    return np.column_stack([pose[:, :3], pose[:, 3] + shift * pose[:, :3] @ SHIFT])


def _find_visible(scene: AnalyticScene, pose: Float64, points: Float64) -> tuple[Float64, Bool]:
    """Return the pixels of world points and whether the view sees the points without occlusion."""
    xy, depth = project(CAMERA, pose, points)
    origin = camera_center(pose[:, :3], pose[:, 3])
    t, _, _ = scene.first_hit(origin, points - origin)
    return xy, (depth > 0) & inside(xy, CAMERA.size) & (np.abs(t - 1.0) < 1e-6)


def _matches(numbers_a: Int64, numbers_b: Int64, shift: int) -> Int64:
    """Return matches (m, 2) of equal points, or of points with their copies in another room."""
    code_a = numbers_a[:, 0] * 8 + numbers_a[:, 1]
    code_b = numbers_b[:, 0] * 8 + numbers_b[:, 1] - shift
    _, rows_a, rows_b = np.intersect1d(code_a, code_b, return_indices=True)
    return np.stack([rows_a, rows_b], axis=1)


def _block(low: tuple[float, float, float], high: tuple[float, float, float]) -> Box:
    """Return an axis-aligned box between two opposite corners."""
    a, b = np.array(low), np.array(high)
    middle, half = (a + b) / 2, (b - a) / 2
    return Box((middle[0], middle[1], middle[2]), (half[0], half[1], half[2]))
