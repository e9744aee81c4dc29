"""Selection of the photo that textures each triangle of a mesh.

The data term is the projected area of a triangle in pixels, times the squared sharpness of the
photo, and the smoothness term counts neighboring triangles with another photo [Waechter, Moehrle
and Goesele, Let There Be Color, ECCV 2014, whose data term weights the image gradient of each
triangle]. The sharpness of a photo is its image gradient relative to the other photos of the same
triangles. The labels are optimized by iterated conditional modes, while the weight of the
smoothness term increases. The data term is averaged over the neighborhood of a triangle first, so
that the labels start with large connected regions.
"""

# mypy: allow-untyped-decorators

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import cv2
import numpy as np

from mpsfm_core.data import Float32, Float64, Int64, UInt8, View
from mpsfm_core.dense.mesh_visibility import map_projected_areas
from mpsfm_core.geometry import project, sample_nearest, transform
from mpsfm_core.mapping.scene.reconstruction import RegisteredImage
from mpsfm_core.support.jit import kernel

NO_VIEW = -1
"""Label of triangles that no photo observes."""
_MIN_COSINE = 0.1
"""Minimum cosine of the angle between the normal of a triangle and the direction to the camera, as
photos stretch steeper surfaces."""
_SMOOTHNESS_STEPS = (0.0, 0.1, 0.2, 0.4, 0.6, 0.8, 1.0, 1.0, 1.0, 1.0)
"""Weight of the smoothness term in each pass of the label optimization."""
_MIN_BRIGHTNESS = 16.0
"""Gray value that is added to the brightness by which gradients are divided, because in dark pixels
noise exceeds the gradient of the surface."""
_NUM_DIFFUSIONS = 10
"""Number of averages of the data term with the neighboring triangles."""


class _Candidates(NamedTuple):
    """Photos that observe each triangle, grouped by triangle."""

    starts: Int64
    """(m + 1,) index of the first candidate of each triangle."""
    views: Int64
    """(k,) index of the photo of each candidate."""
    costs: Float32
    """(k,) data term in [0, 1]: 0 for the photo with the largest projection of a triangle."""


def select_texture_views(
    vertices: Float64,
    triangles: Int64,
    images: Sequence[RegisteredImage],
    view_of: Callable[[str], View],
) -> Int64:
    """Select the photo that textures each triangle, with few seams between photos.

    Args:
        vertices: (n, 3) positions, world frame.
        triangles: (m, 3) vertex indices, counterclockwise as seen by the cameras.
        images: Posed images with depth maps, whose sizes are those of the occlusion test.
        view_of: Function that returns the undistorted view of an image name.

    Returns:
        Index (m,) of the image of each triangle, or :data:`NO_VIEW` if no image observes it.
    """
    neighbors = find_neighbors(triangles)
    starts, views, costs = _find_candidates(vertices, triangles, images, view_of)
    for _ in range(_NUM_DIFFUSIONS):
        costs = _diffuse_costs(starts, views, costs, neighbors)
    labels = np.full(len(triangles), NO_VIEW, np.int64)
    for smoothness in _SMOOTHNESS_STEPS:
        if (
            _update_labels(starts, views, costs, neighbors, smoothness, labels) == 0
            and smoothness == 1.0
        ):
            break
    return labels


def find_neighbors(triangles: Int64) -> Int64:
    """Find the triangles that share an edge.

    If more than two triangles share an edge, an arbitrary pair of them are neighbors.

    Args:
        triangles: (m, 3) vertex indices.

    Returns:
        Triangle index (m, 3) of the neighbor at each edge, -1 at the border of the mesh. Edge k
        connects vertices k and k + 1 of a triangle.
    """
    edges = np.sort(np.stack([triangles, np.roll(triangles, -1, axis=1)], axis=2), axis=2)
    flat = edges.reshape(-1, 2)
    order = np.lexsort(flat.T)
    same = (flat[order[1:]] == flat[order[:-1]]).all(axis=1)
    # An edge of three triangles makes two consecutive pairs, of which the second is left out.
    same[1:] &= ~same[:-1]
    first, second = order[:-1][same], order[1:][same]
    neighbors = np.full(len(flat), -1, np.int64)
    neighbors[first], neighbors[second] = second // 3, first // 3
    return neighbors.reshape(-1, 3)


def _find_candidates(
    vertices: Float64,
    triangles: Int64,
    images: Sequence[RegisteredImage],
    view_of: Callable[[str], View],
) -> _Candidates:
    centers = vertices[triangles].mean(axis=1)

    def select_seen(image: RegisteredImage, areas: Float64) -> tuple[Int64, Float64, Float64]:
        seen = np.flatnonzero(areas > 0)
        xy = project(image.camera, transform(image.rotation, image.translation, centers[seen]))
        gradient = sample_nearest(_relative_gradient(view_of(image.name).image), xy)
        return seen, areas[seen], gradient

    faces, areas, gradients = zip(
        *map_projected_areas(select_seen, vertices, triangles, images, _MIN_COSINE), strict=True
    )
    face, area = np.concatenate(faces), np.concatenate(areas)
    view = np.repeat(np.arange(len(images)), [len(seen) for seen in faces])
    area *= _compare_sharpness(faces, areas, gradients)[view] ** 2
    order = np.argsort(face, kind="stable")
    face, view, area = face[order], view[order], area[order]
    largest = np.zeros(len(triangles))
    np.maximum.at(largest, face, area)
    starts = np.concatenate([[0], np.cumsum(np.bincount(face, minlength=len(triangles)))])
    return _Candidates(starts, view, (1 - area / largest[face]).astype(np.float32))


def _relative_gradient(photo: UInt8) -> Float32:
    """Return the norm (h, w) of the gradient of the brightness, relative to the brightness."""
    gray = cv2.cvtColor(photo, cv2.COLOR_RGB2GRAY).astype(np.float32)
    dx, dy = cv2.Scharr(gray, cv2.CV_32F, 1, 0), cv2.Scharr(gray, cv2.CV_32F, 0, 1)
    norm: Float32 = cv2.magnitude(dx, dy) / (gray + np.float32(_MIN_BRIGHTNESS))
    return norm


def _compare_sharpness(
    faces: Sequence[Int64], areas: Sequence[Float64], gradients: Sequence[Float64]
) -> Float64:
    """Return the sharpness of each photo in (0, 1], 1 for half of the photos.

    Photos are compared by the gradients in common triangles. In equally sharp photos, the gradient
    of a surface is inversely proportional to its size in pixels.

    Args:
        faces: Triangles (k,) that each photo observes.
        areas: Projected areas (k,) of these triangles in pixels.
        gradients: Norms (k,) of the image gradient at these triangles.
    """
    logs = [
        np.log(np.maximum(gradient * np.sqrt(area), 1e-6))
        for gradient, area in zip(gradients, areas, strict=True)
    ]
    face = np.concatenate(faces)
    count = np.bincount(face)
    mean = np.bincount(face, np.concatenate(logs)) / np.maximum(count, 1)
    sharpness = np.ones(len(faces))
    for view, (seen, log_gradient) in enumerate(zip(faces, logs, strict=True)):
        compared = count[seen] > 1
        if compared.any():
            sharpness[view] = np.exp(np.median((log_gradient - mean[seen])[compared]))
    return np.minimum(sharpness / np.median(sharpness), 1.0)


@kernel()
def _diffuse_costs(starts: Int64, views: Int64, costs: Float32, neighbors: Int64) -> Float32:
    """Average the cost of each candidate with the costs of its photo in neighboring triangles."""
    averages = np.empty_like(costs)
    for face in range(len(neighbors)):
        for k in range(starts[face], starts[face + 1]):
            total, count = costs[k], 1
            for edge in range(3):
                other = neighbors[face, edge]
                if other < 0 or starts[other] == starts[other + 1]:
                    continue
                count += 1
                cost = np.float32(1.0)  # The cost of a photo that does not observe the neighbor.
                for other_k in range(starts[other], starts[other + 1]):
                    if views[other_k] == views[k]:
                        cost = costs[other_k]
                total += cost
            averages[k] = total / count
    return averages


@kernel()
def _update_labels(
    starts: Int64,
    views: Int64,
    costs: Float32,
    neighbors: Int64,
    smoothness: float,
    labels: Int64,
) -> int:
    """Set each label to the candidate of least cost given the neighbors; count the changes.

    A triangle without candidates between two triangles of one photo gets the label of that photo,
    which contains all its vertices.
    """
    changes = 0
    for face in range(len(labels)):
        best, best_cost = labels[face], np.inf
        if starts[face] == starts[face + 1]:
            for edge in range(3):
                one, other = neighbors[face, edge], neighbors[face, edge - 1]
                if one >= 0 and other >= 0 and labels[one] == labels[other]:
                    best = labels[one]
        for k in range(starts[face], starts[face + 1]):
            cost = float(costs[k])
            for edge in range(3):
                other = neighbors[face, edge]
                if other >= 0 and labels[other] >= 0 and labels[other] != views[k]:
                    cost += smoothness
            if cost < best_cost:
                best, best_cost = views[k], cost
        if best != labels[face]:
            labels[face] = best
            changes += 1
    return changes
