"""2D-3D correspondences of an image that is to be registered, and of its frame.

The images of one frame of a rig have constant relative poses, so the matches of all images of the
frame determine one pose. An image without a rig is the only image of its frame.

Each match to a registered image gives one correspondence between a keypoint of the new image and a
3D point. The 3D point of a match is triangulated, or lifted from the depth of the registered image
(paper section 3.2). If the depth of the registered image is unknown, the point may be anywhere on a
part of the matched keypoint's ray.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from mpsfm_core.data import Bool, Float64, Int64
from mpsfm_core.mapping.options import RegistrationOptions
from mpsfm_core.mapping.scene.scene import Scene

MIN_DEPTH_RATIO = 1e-3
"""Lower bound of the depth of the nearest possible point, relative to the depth of the most likely
point."""
MIN_POINT_ANGLE_DEG = 1.0
"""Triangulation angle below which a point lifted from depth replaces a triangulated point.
[reference robust_triangles]"""
RAY_MATCH_WEIGHT = 0.5
"""Weight of a match of unknown depth, because the match only constrains one of two image
coordinates. [tuned: benchmarks.accuracy on hololens_room, where sensor depth covers half of the
keypoints]"""


class PoseCorrespondences(NamedTuple):
    """2D-3D correspondences of the images of one frame with registered images."""

    image: int
    """Image that is to be registered, whose pose the correspondences determine."""
    keypoints: Int64
    """(m,) global keypoint numbers of the image and of the other images of its frame, the keypoints
    of one image after those of another."""
    matched_keypoints: Int64
    """(m,) global numbers of the matched keypoints in registered images."""
    points: Float64
    """(m, 3) most likely 3D points, in the world frame."""
    near_points: Float64
    """(m, 3) nearest 3D points on the rays of the matched keypoints that depth allows."""
    far_points: Float64
    """(m, 3) farthest 3D points that depth allows, equal to the nearest if the point is
    triangulated."""
    references: Int64
    """(m,) indices of the registered images with the matched keypoints."""
    depth_known: Bool
    """(m,) False if the 3D point may have any depth that occurs in the registered image."""
    weights: Float64
    """(m,) match scores in (0, 1], times :attr:`depth_weights`."""

    @property
    def depth_weights(self) -> Float64:
        """(m,) weights of the matches, 1 if the depth is known, else :data:`RAY_MATCH_WEIGHT`."""
        return _depth_weights(self.depth_known)

    @property
    def triangulated(self) -> Bool:
        """(m,) bool mask of the correspondences with a triangulated point."""
        is_point: Bool = (self.near_points == self.far_points).all(axis=1)
        return is_point

    def select(self, rows: Int64 | Bool | slice) -> PoseCorrespondences:
        """Return the correspondences that row indices, a bool mask or a slice select."""
        fields: list[Any] = [values[rows] for values in self[1:]]
        return PoseCorrespondences(self.image, *fields)

    def split_by_image(self, scene: Scene) -> list[tuple[int, slice]]:
        """Return the images of the frame that have correspondences, each with its slice of rows."""
        images = scene.graph.image_of[self.keypoints]
        starts = [0, *(np.flatnonzero(np.diff(images)) + 1).tolist()]
        ends = [*starts[1:], len(images)]
        return [
            (int(images[start]), slice(start, end))
            for start, end in zip(starts, ends, strict=True)
            if end > start
        ]

    def frames(self, scene: Scene) -> Int64:
        """Return the frame (m,) of the registered image of each correspondence."""
        frames: Int64 = scene.rigs.frame_of[self.references]
        return frames

    def max_frame_weight(self, scene: Scene) -> float:
        """Return the largest sum of :attr:`depth_weights` over the images of one frame."""
        return float(np.bincount(self.frames(scene), self.depth_weights, minlength=1).max())


def find_correspondences(
    scene: Scene, image: int, references: list[int], options: RegistrationOptions
) -> PoseCorrespondences:
    """Collect the 2D-3D correspondences of the frame of an image with registered images.

    A match uses the triangulated point of its keypoint if the triangulation angle suffices.
    If the triangulation angle is too small, the 3D point lies on the part of the matched keypoint's
    ray that the depth prior allows.

    Args:
        scene: The scene with the registered images.
        image: The image to register.
        references: Registered images whose matches, and those of the other images of their frames,
            are used.
        options: Registration options ``lifting`` and ``max_depth_deviation``.
    """
    graph, tracks = scene.graph, scene.tracks
    edges = [graph.edges_of(member) for member in scene.rigs.images_of(image)]
    source, target, scores = (
        np.concatenate([values[rows] for rows in edges])
        for values in (graph.source, graph.target, graph.score)
    )
    in_references = scene.mask(scene.rigs.complete(references))[graph.image_of[target]]
    source, target, scores = source[in_references], target[in_references], scores[in_references]
    point = tracks.point_of[target]
    triangulated = point >= 0
    distinct, rows = np.unique(point[triangulated], return_inverse=True)
    angles_deg, _ = scene.angles_deg_of(distinct)
    triangulated[triangulated] = angles_deg[rows] >= MIN_POINT_ANGLE_DEG
    depth, log_range, depth_known = _depth_ranges(scene, target, options)
    usable = triangulated | ((depth > 0) & options.lifting)
    source, target, scores, point = source[usable], target[usable], scores[usable], point[usable]
    depth_known = (triangulated | depth_known)[usable]
    triangulated, depth, log_range = triangulated[usable], depth[usable], log_range[usable]
    points = scene.at_depth(target, depth)
    points[triangulated] = tracks.xyz[point[triangulated]]
    log_range = np.where(triangulated, 0.0, log_range)
    centers = scene.centers()[graph.image_of[target]]
    rays = points - centers
    near_points = centers + rays * np.maximum(np.exp(-log_range), MIN_DEPTH_RATIO)[:, None]
    far_points = centers + rays * np.exp(log_range)[:, None]
    return PoseCorrespondences(
        image,
        source,
        target,
        points,
        near_points,
        far_points,
        graph.image_of[target],
        depth_known,
        scores * _depth_weights(depth_known),
    )


def _depth_weights(depth_known: Bool) -> Float64:
    """Return weights (m,) of matches, which are lower if the depth is unknown."""
    return np.where(depth_known, 1.0, RAY_MATCH_WEIGHT)


def _depth_ranges(
    scene: Scene, keypoints: Int64, options: RegistrationOptions
) -> tuple[Float64, Float64, Bool]:
    """Return depth (m,), half length (m,) of its log interval, and known-depth mask (m,).

    A keypoint of unknown depth gets the range of the known depths in its image, or depth 0 if no
    depth of the image is known.
    """
    depth, known = scene.depth_at(keypoints)
    log_range = options.max_depth_deviation * scene.keypoint_log_std[keypoints]
    images = scene.graph.image_of[keypoints]
    for image in map(int, np.unique(images[~known])):
        depth_map = scene.maps[image]
        known_depths = depth_map.at_keypoints()[depth_map.keypoint_valid]
        if depth_map.active and len(known_depths):
            rows = (images == image) & ~known
            log_ends = np.log([known_depths.min(), known_depths.max()])
            depth[rows] = np.exp(log_ends.mean())
            log_range[rows] = (log_ends[1] - log_ends[0]) / 2
    return depth, log_range, known
