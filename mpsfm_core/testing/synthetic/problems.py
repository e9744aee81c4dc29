"""Synthetic mapping problems with a known solution."""

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
    """Standard deviations of the errors in a synthetic mapping problem."""

    keypoints_px: float = 0.0
    """Std of the errors of keypoint positions in pixels."""
    scale: float = 0.0
    """Std of the relative depth error that a whole image shares."""
    depth: float = 0.0
    """Std of the independent relative depth error of each pixel."""


_NORMAL_STD_DEG = 1.0
"""Angular std that the normal priors declare, in degrees."""


def make_mapping_problem(
    scene: AnalyticScene,
    camera: PinholeCamera,
    poses: Sequence[Float64],
    *,
    points_per_view: int = 150,
    map_width: int = 160,
    declared_depth_std: float = 0.01,
    noise: SyntheticNoise | None = None,
    links: Sequence[tuple[int, int]] | None = None,
    two_view_tracks: bool = False,
    seed: int = 0,
) -> MappingProblem:
    """Create a synthetic mapping problem with exact poses, priors and verified matches.

    Args:
        scene: Scene to render.
        camera: Camera that all synthetic views share.
        poses: Pose ``cam_from_world`` (3, 4) of each view.
        points_per_view: Number of surface points that are sampled in each view. Every sampled point
            that a view sees becomes a keypoint of this view.
        map_width: Width of the prior maps in pixels.
        declared_depth_std: Relative std that the depth priors declare.
        noise: Standard deviations of the errors of keypoints and depth, by default zero.
        links: Image pairs to match, by default all. Image pairs with fewer than 15 common points
            are dropped.
        two_view_tracks: If true, match each surface point in at most one image pair.
        seed: Seed of the random surface points and noise.

    Returns:
        The mapping problem.
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
            _NORMAL_STD_DEG,
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
    """Render the depth and normal priors of a view and add errors.

    Args:
        name: Name of the image.
        scene: Scene to render.
        camera: Camera of the view.
        pose: ``cam_from_world`` (3, 4).
        keypoints: Keypoints (n, 2) of the view in pixels.
        map_width: Width of the prior maps in pixels.
        depth_std: Relative std that the depth prior declares.
        normal_std_deg: Angular std that the normal prior declares.
        noise: Standard deviations of the depth errors.
        rng: Random generator of the errors.
    """
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
    """Return matches (m, 2) of two views as a verified pair with the true relative pose.

    Args:
        a: Index of the first view of the image pair.
        b: Index of the second view of the image pair.
        matches: Matches as keypoint indices (m, 2) in both images.
        poses: Pose ``cam_from_world`` (3, 4) of each view.
    """
    rotation = poses[b][:, :3] @ poses[a][:, :3].T
    translation = poses[b][:, 3] - rotation @ poses[a][:, 3]
    scores = np.ones(len(matches), dtype=np.float32)
    return VerifiedPair(a, b, matches.astype(np.int64), scores, rotation, translation)
