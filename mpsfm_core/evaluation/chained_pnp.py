"""The least that depth alone achieves: pairwise PnP from lifted matches, chained along a tree.

A reference point without any mapper: each verified pair gets the pose with most inliers of two PnP
estimates, from the depth of one image and of the other; a maximum spanning tree by these inliers
chains the poses. Metric depth is taken as it is, so that lengths agree from pair to pair.
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


class _Link(NamedTuple):
    """``cam_b_from_cam_a`` of a pair and the matches that agree with it."""

    pose: Pose
    num_inliers: int


def estimate_chained_poses(problem: MappingProblem, seed: int = 0) -> list[dict[str, Pose]]:
    """Poses by image name, one dictionary for each connected group of images, largest first."""
    options = RegistrationOptions()
    scene = Scene(problem)  # no image has a pose: lifts are in the frame of their camera
    for depth_map in scene.maps:
        depth_map.set_scale(1.0)
    links: dict[tuple[int, int], _Link] = {}
    for pair in problem.pairs:
        link = _best_link(scene, pair, options, seed)
        if link:
            links[pair.image_a, pair.image_b] = link
    count = len(problem.images)
    ends = np.array(list(links), dtype=np.int64).reshape(-1, 2).T
    weights = -np.array([link.num_inliers for link in links.values()], dtype=np.float64)
    tree = minimum_spanning_tree(coo_array((weights, (ends[0], ends[1])), shape=(count, count)))
    groups = connected_components(tree, directed=False)[1]
    models = []
    for group in range(groups.max() + 1):
        members = np.flatnonzero(groups == group)
        if len(members) > 1:
            poses = _chain(tree, int(members[0]), links)
            models.append({problem.images[i].name: pose for i, pose in sorted(poses.items())})
    return sorted(models, key=lambda model: -len(model))


def _chain(tree: coo_array, root: int, links: dict[tuple[int, int], _Link]) -> dict[int, Pose]:
    """``cam_from_world`` of all images that the tree connects with the root, where the world is."""
    order, before = breadth_first_order(tree, root, directed=False)
    poses: dict[int, Pose] = {root: (np.eye(3), np.zeros(3))}
    for image in map(int, order[1:]):
        parent = int(before[image])
        if (parent, image) in links:
            step = links[parent, image].pose
        else:
            step = invert(*links[image, parent].pose)
        poses[image] = compose(step, poses[parent])
    return poses


def _best_link(
    scene: Scene, pair: VerifiedPair, options: RegistrationOptions, seed: int
) -> _Link | None:
    a, b = (pair.matches + scene.graph.offsets[[pair.image_a, pair.image_b]]).T
    there = _link(scene, a, pair.image_b, b, options, seed)
    back = _link(scene, b, pair.image_a, a, options, seed)
    if back:
        back = _Link(invert(*back.pose), back.num_inliers)
    found = [link for link in (there, back) if link]
    return max(found, key=lambda link: link.num_inliers, default=None)


def _link(
    scene: Scene,
    source: Int64,
    image: int,
    target: Int64,
    options: RegistrationOptions,
    seed: int,
) -> _Link | None:
    """PnP of an image's keypoints (m,) on the lifts of those they match in another image."""
    points, valid = scene.lift(source)
    xy = scene.keypoints[target[valid]]
    found = estimate_absolute_pose(scene.camera(image), xy, points[valid], options, seed)
    return _Link(found[:2], int(found[2].sum())) if found else None
