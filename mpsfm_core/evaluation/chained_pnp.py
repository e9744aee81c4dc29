"""Baseline without a mapper: pairwise PnP, chained along a spanning tree.

PnP estimates two poses per verified pair, with the depth of either image, and selects the pose with
more inliers. The relative poses are chained along the maximum spanning tree by number of inliers.
Depth priors are not rescaled, because metric depth already gives baselines of consistent length.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import breadth_first_order, connected_components, minimum_spanning_tree

from mpsfm_core.data import Int64, MappingProblem, Pose, VerifiedPair
from mpsfm_core.geometry import compose, invert
from mpsfm_core.mapping.options import RegistrationOptions
from mpsfm_core.mapping.registration.pose_hypotheses import estimate_absolute_pose
from mpsfm_core.mapping.scene.scene import Scene


class _RelativePose(NamedTuple):
    """Relative pose of an image pair from PnP."""

    pose: Pose
    """``cam_b_from_cam_a``."""
    num_inliers: int
    """Number of matches that are inliers of the relative pose."""


def estimate_chained_poses(problem: MappingProblem, seed: int = 0) -> list[dict[str, Pose]]:
    """Estimate the poses of each connected component of images.

    Returns:
        Poses ``cam_from_world`` by image name of each component, the largest first.
    """
    options = RegistrationOptions()
    # The scene has no poses, so the 3D points of each depth map are in its camera frame.
    scene = Scene(problem)
    for depth_map in scene.maps:
        depth_map.set_scale(1.0)
    links: dict[tuple[int, int], _RelativePose] = {}
    for pair in problem.pairs:
        link = _estimate_pair(scene, pair, options, seed)
        if link:
            links[pair.image_a, pair.image_b] = link
    count = len(problem.images)
    ends = np.array(list(links), dtype=np.int64).reshape(-1, 2).T
    weights = -np.array([link.num_inliers for link in links.values()], dtype=np.float64)
    tree = minimum_spanning_tree(coo_array((weights, (ends[0], ends[1])), shape=(count, count)))
    components = connected_components(tree, directed=False)[1]
    models = []
    for component in range(components.max() + 1):
        members = np.flatnonzero(components == component)
        if len(members) > 1:
            poses = _chain_poses(tree, int(members[0]), links)
            models.append({problem.images[i].name: pose for i, pose in sorted(poses.items())})
    return sorted(models, key=lambda model: -len(model))


def _chain_poses(
    tree: coo_array, root: int, links: dict[tuple[int, int], _RelativePose]
) -> dict[int, Pose]:
    """Chain relative poses from the root, whose camera frame is the world frame."""
    order, parents = breadth_first_order(tree, root, directed=False)
    poses: dict[int, Pose] = {root: (np.eye(3), np.zeros(3))}
    for image in map(int, order[1:]):
        parent = int(parents[image])
        if (parent, image) in links:
            step = links[parent, image].pose
        else:
            step = invert(*links[image, parent].pose)
        poses[image] = compose(step, poses[parent])
    return poses


def _estimate_pair(
    scene: Scene, pair: VerifiedPair, options: RegistrationOptions, seed: int
) -> _RelativePose | None:
    """Estimate the relative pose of an image pair by PnP with the depth of either image."""
    a, b = (pair.matches + scene.graph.offsets[[pair.image_a, pair.image_b]]).T
    forward = _estimate_pnp(scene, a, pair.image_b, b, options, seed)
    backward = _estimate_pnp(scene, b, pair.image_a, a, options, seed)
    if backward:
        backward = _RelativePose(invert(*backward.pose), backward.num_inliers)
    estimates = [estimate for estimate in (forward, backward) if estimate]
    return max(estimates, key=lambda estimate: estimate.num_inliers, default=None)


def _estimate_pnp(
    scene: Scene,
    source: Int64,
    image: int,
    target: Int64,
    options: RegistrationOptions,
    seed: int,
) -> _RelativePose | None:
    """Estimate the pose of an image from keypoints of another image unprojected with depth."""
    points, valid = scene.lift(source)
    xy = scene.keypoints[target[valid]]
    estimate = estimate_absolute_pose(scene.camera(image), xy, points[valid], options, seed)
    return _RelativePose(estimate[:2], int(estimate[2].sum())) if estimate else None
