"""Removing what does not fit: observations, points, images."""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from mpsfm_core.mapping.options import TriangulationOptions
from mpsfm_core.scene.scene import Scene

MIN_IMAGE_POINTS = 3
"""An image that observes fewer points has no pose worth the name."""


def filter_points(scene: Scene, options: TriangulationOptions) -> int:
    """Remove observations that reproject badly, and points that neither rays nor depth support.

    A point of low triangulation angle stays only if some image that sees it has valid depth
    there. Returns the number of observations removed.
    """
    tracks, graph = scene.tracks, scene.graph
    observations = tracks.observations()
    points = tracks.point_of[observations]
    errors, _ = scene.project(observations, tracks.xyz[points])
    limit = options.max_error_px * scene.keypoint_std_px[graph.image_of[observations]]
    removed = tracks.remove_observations(observations[~(errors <= limit)])
    observations = tracks.observations()
    valid = np.concatenate([m.keypoint_valid for m in scene.maps])[observations]
    supported = np.bincount(tracks.point_of[observations], valid, minlength=len(tracks.xyz))
    unstable = (scene.track_angles_deg() < options.min_angle_deg) & (supported == 0)
    removed += int(unstable[tracks.point_of[observations]].sum())
    tracks.delete(unstable)
    return removed


def lost_images(scene: Scene) -> list[int]:
    """Registered images that observe too few points to keep their pose."""
    observed = np.flatnonzero(scene.tracks.point_of >= 0)
    counts = np.bincount(scene.graph.image_of[observed], minlength=scene.num_images)
    return [int(i) for i in scene.registered_images() if counts[i] < MIN_IMAGE_POINTS]


def disconnected_images(scene: Scene) -> list[int]:
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
