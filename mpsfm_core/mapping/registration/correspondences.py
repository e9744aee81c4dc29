"""What matches say of a new image's pose: its keypoints, and the 3D points they may see."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from mpsfm_core.data import Bool, Float64, Int64
from mpsfm_core.mapping.options import RegistrationOptions
from mpsfm_core.mapping.scene.scene import Scene

MIN_DEPTH_RATIO = 1e-3
"""Smallest share of its depth that an uncertain depth may shrink to."""
RAY_MATCH_WEIGHT = 0.5
"""A match of unknown depth: it fixes one of two coordinates. Ours; on hololens_room, where sensor
depth is known at half of the keypoints, with such matches and without (means of seeds): `all`
100 instead of 91 of 112 images and AUC@20 47 instead of 44, random 20 of those 28 images 134
instead of 105 of 160 and 23 instead of 18, leq10 29.0 instead of 27.9, smaller sets as before."""


class PoseCorrespondences(NamedTuple):
    """Keypoints of an image and what they see.

    ``keypoints`` (m,): of the image. ``matched`` (m,): their matches in registered images.
    ``near``, ``far``: (m, 3) world points that bound where the point may lie along the ray of the
    matched keypoint (the same point twice when triangulated); ``points`` (m, 3): the best guess.
    ``references`` (m,): the image the match comes from. ``known`` (m,) bool: whether the depth of
    the point is. ``weights`` (m,): the scores of the matches, in (0, 1], times their worth.
    """

    keypoints: Int64
    matched: Int64
    points: Float64
    near: Float64
    far: Float64
    references: Int64
    known: Bool
    weights: Float64

    @property
    def depth_weights(self) -> Float64:
        """(m,) 1, or :data:`RAY_MATCH_WEIGHT` where depth is unknown."""
        return _depth_weights(self.known)

    def select(self, chosen: Int64 | Bool) -> PoseCorrespondences:
        """Some of them, by row or mask."""
        parts: list[Any] = [values[chosen] for values in self]
        return PoseCorrespondences(*parts)


def find_correspondences(
    scene: Scene, image: int, references: list[int], options: RegistrationOptions
) -> PoseCorrespondences:
    """What the matches of an image to some registered images say of its pose.

    A matched keypoint gives its 3D point where that has enough parallax; else, with lifting, the
    part of its ray that depth allows. Where depth is unknown, that is all between the nearest and
    the farthest depth that is known elsewhere in the image.
    """
    graph, tracks = scene.graph, scene.tracks
    edges = graph.edges_of(image)
    source, target, scores = graph.source[edges], graph.target[edges], graph.score[edges]
    chosen = scene.mask(references)[graph.image_of[target]]
    source, target, scores = source[chosen], target[chosen], scores[chosen]
    point = tracks.point_of[target]
    angle = np.append(scene.track_angles_deg(), 0.0)[point]
    stable = (point >= 0) & (angle >= options.min_point_angle_deg)
    depth, slack, known = _depths(scene, target, options)
    use = stable | ((depth > 0) & options.lifting)
    source, target, scores, point = source[use], target[use], scores[use], point[use]
    stable, depth, known = stable[use], depth[use], (stable | known)[use]
    points = scene.at_depth(target, depth)
    points[stable] = tracks.xyz[point[stable]]
    slack = np.where(stable, 0.0, slack[use])
    centers = scene.centers()[graph.image_of[target]]
    along = points - centers
    near = centers + along * np.maximum(np.exp(-slack), MIN_DEPTH_RATIO)[:, None]
    far = centers + along * np.exp(slack)[:, None]
    of, weights = graph.image_of[target], scores * _depth_weights(known)
    return PoseCorrespondences(source, target, points, near, far, of, known, weights)


def _depth_weights(known: Bool) -> Float64:
    """(m,) what matches count for whose depth is known or not."""
    return np.where(known, 1.0, RAY_MATCH_WEIGHT)


def _depths(
    scene: Scene, keypoints: Int64, options: RegistrationOptions
) -> tuple[Float64, Float64, Bool]:
    """Depth of keypoints in their images, the slack of its logarithm, and where it is known.

    Elsewhere it is in the middle of the known depths of the image, and 0 where there are none.
    """
    depth, known = scene.depth_at(keypoints)
    slack = options.depth_deviations * scene.keypoint_log_std[keypoints]
    images = scene.graph.image_of[keypoints]
    for image in map(int, np.unique(images[~known])):
        depth_map = scene.maps[image]
        elsewhere = depth_map.at_keypoints()[depth_map.keypoint_valid]
        if depth_map.active and len(elsewhere):
            rows = (images == image) & ~known
            ends = np.log([elsewhere.min(), elsewhere.max()])
            depth[rows], slack[rows] = np.exp(ends.mean()), (ends[1] - ends[0]) / 2
    return depth, slack, known
