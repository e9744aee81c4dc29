"""Mapping problems with a known solution, from analytic scenes."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations
from typing import NamedTuple

import numpy as np

from mpsfm_core.data import (
    DepthPrior,
    Float64,
    Int64,
    MappingImage,
    MappingProblem,
    NormalPrior,
    PinholeCamera,
    VerifiedPair,
)
from mpsfm_core.testing.synthetic.scenes import AnalyticScene


class SyntheticNoise(NamedTuple):
    """Standard deviations: keypoints in pixels, relative depth per image and per pixel."""

    keypoints_px: float = 0.0
    scale: float = 0.0
    depth: float = 0.0


def make_mapping_problem(
    scene: AnalyticScene,
    camera: PinholeCamera,
    poses: Sequence[Float64],
    *,
    points_per_view: int = 150,
    map_width: int = 160,
    declared_depth_std: float = 0.01,
    declared_normal_std_deg: float = 1.0,
    noise: SyntheticNoise | None = None,
    links: Sequence[tuple[int, int]] | None = None,
    two_view_tracks: bool = False,
    seed: int = 0,
) -> MappingProblem:
    """Views of a scene with priors and verified matches.

    ``poses``: (3, 4) ``cam_from_world`` of each view. Every view contributes
    ``points_per_view`` surface points; a view's keypoints are all points it sees. ``links``:
    pairs that have matches, by default all with at least 15 points in common.
    ``two_view_tracks``: no point is matched in more than one pair.
    """
    noise = noise or SyntheticNoise()
    rng = np.random.default_rng(seed)
    views = range(len(poses))
    ids: list[list[Int64]] = [[] for _ in views]
    xys: list[list[Float64]] = [[] for _ in views]
    size = np.array(camera.size, dtype=np.float64)
    for i in views:
        xy = rng.uniform(2, size - 2, (points_per_view, 2))
        for j in views:
            seen = scene.correspondences(camera, poses[i], camera, poses[j], xy)
            visible = np.flatnonzero(seen.visible)
            ids[j].append(i * points_per_view + visible)
            xys[j].append(seen.xy_b[visible])
    numbers = [np.concatenate(part) for part in ids]
    keypoints = [np.concatenate(part) for part in xys]
    keypoints = [xy + noise.keypoints_px * rng.normal(size=xy.shape) for xy in keypoints]
    images = [
        render_mapping_image(
            f"view_{i}.png",
            scene,
            camera,
            poses[i],
            keypoints[i],
            map_width,
            declared_depth_std,
            declared_normal_std_deg,
            noise,
            rng,
        )
        for i in views
    ]
    pairs = []
    all_links = list(links if links is not None else combinations(views, 2))
    for link, (a, b) in enumerate(all_links):
        common, rows_a, rows_b = np.intersect1d(numbers[a], numbers[b], return_indices=True)
        if two_view_tracks:
            mine = common % len(all_links) == link
            rows_a, rows_b = rows_a[mine], rows_b[mine]
        if len(rows_a) >= 15:
            pairs.append(make_verified_pair(a, b, np.stack([rows_a, rows_b], axis=1), poses))
    return MappingProblem(tuple(images), tuple(pairs))


def render_mapping_image(
    name: str,
    scene: AnalyticScene,
    camera: PinholeCamera,
    pose: Float64,
    keypoints: Float64,
    map_width: int,
    depth_std: float,
    normal_std_deg: float,
    noise: SyntheticNoise,
    rng: np.random.Generator,
) -> MappingImage:
    """A view of a scene with keypoints (n, 2) and the priors that noise leaves of the truth."""
    grid = camera.resized(map_width, round(map_width * camera.height / camera.width))
    truth = scene.render(grid, pose)
    factor = np.exp(noise.scale * rng.normal() + noise.depth * rng.normal(size=truth.depth.shape))
    depth = (truth.depth * factor).astype(np.float32)
    variance = (depth_std * depth) ** 2
    angular = np.full(depth.shape, np.radians(normal_std_deg) ** 2, dtype=np.float32)
    return MappingImage(
        name,
        camera,
        keypoints,
        DepthPrior.from_arrays(depth, variance),
        NormalPrior.from_arrays(truth.normals, angular),
        keypoint_std_px=max(noise.keypoints_px, 0.1),
    )


def make_verified_pair(a: int, b: int, matches: Int64, poses: Sequence[Float64]) -> VerifiedPair:
    """Matches (m, 2) of two views with their relative pose; ``poses``: (3, 4), by view."""
    rotation = poses[b][:, :3] @ poses[a][:, :3].T
    translation = poses[b][:, 3] - rotation @ poses[a][:, 3]
    scores = np.ones(len(matches), dtype=np.float32)
    return VerifiedPair(a, b, matches.astype(np.int64), scores, rotation, translation)
