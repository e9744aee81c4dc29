"""Removing what does not fit: observations, points, images."""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from mpsfm_core.data import Int64
from mpsfm_core.mapping.options import TriangulationOptions
from mpsfm_core.mapping.scene.scene import Scene

MIN_IMAGE_POINTS = 3
"""An image that observes fewer points has no pose worth the name."""


def filter_points(
    scene: Scene, options: TriangulationOptions, images: list[int] | None = None
) -> int:
    """Remove observations that reproject badly, and points that neither rays nor depth support.

    A point of low triangulation angle stays only if some image that sees it has valid depth
    there. ``images``: only points that one of them sees; all by default. Returns the number of
    observations removed.
    """
    tracks, graph = scene.tracks, scene.graph
    points = _points_of(scene, images)
    keypoints, rows = tracks.observations_of(points)
    errors, _ = scene.project(keypoints, tracks.xyz[points[rows]])
    limit = options.max_error_px * scene.keypoint_std_px[graph.image_of[keypoints]]
    removed = tracks.remove_observations(keypoints[~(errors <= limit)])
    keypoints, rows = tracks.observations_of(points)
    supported = np.bincount(rows, scene.keypoint_valid[keypoints], minlength=len(points))
    angles, lengths = scene.angles_deg_of(points)
    unstable = (angles < options.min_angle_deg) & (supported == 0)
    removed += int(lengths[unstable].sum())
    gone = np.zeros(len(tracks.xyz), dtype=np.bool_)
    gone[points[unstable]] = True
    tracks.delete(gone)
    return removed


def _points_of(scene: Scene, images: list[int] | None) -> Int64:
    """(m,) points that some images see, ascending; all by default."""
    tracks = scene.tracks
    if images is None:
        return np.arange(len(tracks.xyz))
    seen = np.concatenate([tracks.point_of[scene.graph.keypoints_of(image)] for image in images])
    return np.unique(seen[seen >= 0])


def find_lost_images(scene: Scene) -> list[int]:
    """Registered images that observe too few points to keep their pose."""
    observed = np.flatnonzero(scene.tracks.point_of >= 0)
    counts = np.bincount(scene.graph.image_of[observed], minlength=scene.num_images)
    return [int(i) for i in scene.registered_images() if counts[i] < MIN_IMAGE_POINTS]


def find_disconnected_images(scene: Scene) -> list[int]:
    """Registered images that share no chain of points with the largest group of images."""
    observations = scene.tracks.observations()
    points = scene.tracks.point_of[observations]
    images = scene.graph.image_of[observations]
    nodes = scene.num_images + len(scene.tracks.xyz)
    links = coo_matrix(
        (np.ones(len(points)), (images, scene.num_images + points)), shape=(nodes, nodes)
    )
    group = connected_components(links, directed=False)[1][: scene.num_images]
    sizes = np.bincount(group[scene.registered])
    return [int(i) for i in scene.registered_images() if group[i] != sizes.argmax()]
