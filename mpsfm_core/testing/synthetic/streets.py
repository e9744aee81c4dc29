"""Synthetic mapping problems of any size, in which cameras move along the streets of a city.

The streets form a square grid. Each street has houses with bays on both sides, parked cars, and a
camera every few meters, whose gaze turns from one side to the other and back within a block. At a
crossing, the cameras of both streets look at the same corner, so that crossings connect the streets
and the blocks are loops. Sky and surfaces at large distances have no depth.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from mpsfm_core.data import Float64
from mpsfm_core.geometry import camera_center
from mpsfm_core.testing.synthetic.halls import (
    EXACT_PRIORS,
    HallProblem,
    PriorErrors,
    observe_scene,
    remove_hidden_boxes,
)
from mpsfm_core.testing.synthetic.scenes import AnalyticScene, Box, look_at

SPACING = 2.0
"""Distance in meters between consecutive cameras of a street."""
BLOCK = 40.0
"""Approximate distance in meters between parallel streets."""
WIDTH = 12.0
"""Distance in meters between the houses on both sides of a street."""
TURN_DEG = 45.0
"""Largest angle in degrees between the viewing direction and the street."""
REACH = 7.0
"""Largest distance in meters between the cameras of two views of a surface point."""
SIGHT = 60.0
"""Distance in meters from a camera within which the center of a visible box is."""


def make_street_problem(
    views: int, errors: PriorErrors = EXACT_PRIORS, *, map_width: int = 160, seed: int = 0
) -> HallProblem:
    """Create a synthetic mapping problem of a city with a square grid of streets.

    Args:
        views: Number of views.
        errors: Model of the errors of the depth priors.
        map_width: Width of the depth and normal prior maps in pixels.
        seed: Seed of the random scene, surface points and errors.

    Returns:
        The mapping problem with its true solution.
    """
    rng = np.random.default_rng(seed)
    num_streets = max(2, round(0.5 + np.sqrt(0.25 + views * SPACING / (2 * BLOCK))))
    block = views * SPACING / (2 * num_streets * (num_streets - 1))
    poses = _make_poses(views, num_streets, block, rng)
    houses = _make_houses(num_streets, block, rng)
    tree = cKDTree([house.center for house in houses])
    parts = []
    for pose in poses:
        eye = camera_center(pose[:, :3], pose[:, 3])
        ground = Box((eye[0], eye[1], -1.0), (SIGHT, SIGHT, 1.0))
        near = [houses[row] for row in sorted(tree.query_ball_point(eye, SIGHT))]
        parts.append(remove_hidden_boxes(AnalyticScene((ground, *near)), pose))
    return observe_scene(parts, poses, REACH, errors, rng, map_width=map_width)


def _make_poses(
    views: int, num_streets: int, block: float, rng: np.random.Generator
) -> list[Float64]:
    """Create camera poses along the streets, first to the east, then to the north.

    Args:
        views: Number of views.
        num_streets: Number of parallel streets in each of the two directions.
        block: Distance in meters between parallel streets.
        rng: Random generator of small changes of the poses.
    """
    street, along = np.divmod(SPACING * np.arange(views), block * (num_streets - 1))
    is_north = street >= num_streets
    across = block * (street % num_streets)
    turn = np.radians(TURN_DEG) * np.cos(2 * np.pi * along / block)
    heading = np.where(is_north, np.pi / 2 - turn, turn) + rng.normal(0, 0.05, views)
    x, y = np.where(is_north, [across, along], [along, across])
    eyes = np.column_stack([x, y, np.full(views, 1.7)]) + rng.uniform(-0.2, 0.2, (views, 3))
    ahead = np.column_stack([np.cos(heading), np.sin(heading), rng.normal(0.05, 0.05, views)])
    return [look_at(eye, eye + step) for eye, step in zip(eyes, ahead, strict=True)]


def _make_houses(num_streets: int, block: float, rng: np.random.Generator) -> list[Box]:
    """Create houses with bays, and parked cars, on both sides of all streets."""
    boxes = []
    for street in range(2 * num_streets):
        for start in block * np.arange(num_streets - 1):
            for side in (-1, 1):
                for along, half, distance, depth, height in _make_row(block, rng):
                    across = block * (street % num_streets) + side * distance
                    center, size = (start + along, across), (half, depth)
                    if street >= num_streets:
                        center, size = center[::-1], size[::-1]
                    boxes.append(Box((*center, height), (*size, height)))
    return boxes


def _make_row(block: float, rng: np.random.Generator) -> Float64:
    """Create the boxes on one side of a street between two crossings.

    Returns:
        Position along the street, half length, distance from the middle of the street, half depth
        and half height (n, 5) of each box in meters.
    """
    row = []
    start, end = WIDTH / 2, block - WIDTH / 2
    while start < end:
        half = min(rng.uniform(3, 5), (end - start) / 2)
        middle, front = start + half, WIDTH / 2 + rng.uniform(0, 0.6)
        row.append((middle, half, front + 3, 3.0, rng.uniform(3.5, 7)))
        bay = middle + rng.uniform(-0.5, 0.5) * half
        row.append((bay, rng.uniform(0.4, 1), front, rng.uniform(0.3, 0.8), rng.uniform(1.5, 3)))
        if rng.uniform() < 0.5:
            row.append((middle, rng.uniform(1.6, 2.2), WIDTH / 2 - 1.8, 0.9, rng.uniform(0.6, 0.9)))
        start += 2 * half
    return np.array(row)
