"""What matches say of a new image's pose: its keypoints, and the 3D points they may see."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from mpsfm_core.data import Bool, Float64, Int64
from mpsfm_core.mapping.options import RegistrationOptions
from mpsfm_core.scene.scene import Scene

MIN_DEPTH_SHARE = 1e-3
"""Smallest share of its depth that an uncertain depth may shrink to."""


class Correspondences(NamedTuple):
    """Keypoints of an image and what they see.

    ``keypoints`` (m,): of the image. ``matched`` (m,): their matches in registered images.
    ``near``, ``far``: (m, 3) world points that bound where the
    point may lie along the ray of the matched keypoint (the same point twice when triangulated);
    ``points`` (m, 3): the best guess. ``references`` (m,): the image the match comes from.
    ``scores`` (m,): of the matches, in (0, 1].
    """

    keypoints: Int64
    matched: Int64
    points: Float64
    near: Float64
    far: Float64
    references: Int64
    scores: Float64

    def select(self, chosen: Int64 | Bool) -> Correspondences:
        """Some of them, by row or mask."""
        parts: list[Any] = [values[chosen] for values in self]
        return Correspondences(*parts)


def correspondences(
    scene: Scene, image: int, references: list[int], options: RegistrationOptions
) -> Correspondences:
    """What the matches of an image to some registered images say of its pose.

    A matched keypoint gives its 3D point where that has enough parallax; else, with lifting, the
    part of its ray that depth allows.
    """
    graph, tracks = scene.graph, scene.tracks
    edges = graph.edges_of(image)
    source, target, scores = graph.source[edges], graph.target[edges], graph.score[edges]
    chosen = scene.mask(references)[graph.image_of[target]]
    source, target, scores = source[chosen], target[chosen], scores[chosen]
    point = tracks.point_of[target]
    angle = np.append(scene.track_angles_deg(), 0.0)[point]
    stable = (point >= 0) & (angle >= options.min_point_angle_deg)
    lifted, valid = scene.lift(target)
    use = stable | (valid & options.lifting)
    source, target, scores = source[use], target[use], scores[use]
    stable, point = stable[use], point[use]
    points = lifted[use]
    points[stable] = tracks.xyz[point[stable]]
    slack = np.where(stable, 0.0, options.depth_deviations * scene.keypoint_log_std[target])
    centers = scene.centers()[graph.image_of[target]]
    along = points - centers
    near = centers + along * np.maximum(np.exp(-slack), MIN_DEPTH_SHARE)[:, None]
    far = centers + along * np.exp(slack)[:, None]
    return Correspondences(source, target, points, near, far, graph.image_of[target], scores)
