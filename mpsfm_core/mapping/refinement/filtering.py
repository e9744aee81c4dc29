"""Filtering of observations and points, and detection of images with too few points."""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from mpsfm_core.mapping.options import TriangulationOptions
from mpsfm_core.mapping.scene.scene import Scene
from mpsfm_core.mapping.scene.tracks import NO_POINT

MIN_IMAGE_POINTS = 3
"""Minimum number of observed 3D points that determine the pose of an image."""


def filter_points(
    scene: Scene, options: TriangulationOptions, images: list[int] | None = None
) -> int:
    """Remove outlier observations, and points that neither parallax nor depth determines.

    A point with a small triangulation angle is only kept if one of its images has a valid depth
    prior at the point.

    Args:
        scene: The scene.
        options: Triangulation options with the limits ``max_error_px`` and ``min_angle_deg``.
        images: Images whose observed points are filtered, or None to filter all points.

    Returns:
        The number of removed observations.
    """
    tracks, graph = scene.tracks, scene.graph
    points = np.arange(len(tracks.xyz)) if images is None else scene.points_of(images)
    keypoints, rows = tracks.observations_of(points)
    errors_px, _ = scene.project(keypoints, tracks.xyz[points[rows]])
    max_errors_px = options.max_error_px * scene.keypoint_std_px[graph.image_of[keypoints]]
    num_removed = tracks.remove_observations(keypoints[~(errors_px <= max_errors_px)])
    keypoints, rows = tracks.observations_of(points)
    num_depths = np.bincount(rows, scene.keypoint_valid[keypoints], minlength=len(points))
    angles_deg, lengths = scene.angles_deg_of(points, (keypoints, rows))
    is_unstable = (angles_deg < options.min_angle_deg) & (num_depths == 0)
    num_removed += int(lengths[is_unstable].sum())
    tracks.point_of[keypoints[is_unstable[rows]]] = NO_POINT
    return num_removed


def find_lost_images(scene: Scene) -> list[int]:
    """Return the registered images whose frames observe fewer than ``MIN_IMAGE_POINTS`` points."""
    observed = np.flatnonzero(scene.tracks.point_of >= 0)
    frames = scene.rigs.frame_of
    counts = np.bincount(frames[scene.graph.image_of[observed]], minlength=scene.num_images)[frames]
    return [int(i) for i in scene.registered_images() if counts[i] < MIN_IMAGE_POINTS]


def find_disconnected_images(scene: Scene) -> list[int]:
    """Return the registered images that no chain of shared points connects to the largest part."""
    observations = scene.tracks.observations()
    points = scene.tracks.point_of[observations]
    images = scene.rigs.frame_of[scene.graph.image_of[observations]]
    num_nodes = scene.num_images + len(scene.tracks.xyz)
    edges = coo_matrix(
        (np.ones(len(points)), (images, scene.num_images + points)), shape=(num_nodes, num_nodes)
    )
    component = connected_components(edges, directed=False)[1][scene.rigs.frame_of]
    sizes = np.bincount(component[scene.registered])
    return [int(i) for i in scene.registered_images() if component[i] != sizes.argmax()]
