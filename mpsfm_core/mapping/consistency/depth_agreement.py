"""How much of what the images of a model see others see at the same depth."""

from __future__ import annotations

import numpy as np

from mpsfm_core.data import Float64
from mpsfm_core.geometry import pixel_centers, project, transform, unproject
from mpsfm_core.mapping.options import ConsistencyOptions
from mpsfm_core.mapping.scene.reconstruction import Reconstruction, RegisteredImage

GRID = 24
"""Columns and rows of the pixels of an image that are looked for in the others (ours)."""


def measure_depth_agreement(model: Reconstruction, options: ConsistencyOptions) -> float:
    """Pixels of images that lie on the surface another image sees, summed over all pairs of images,
    in terms of the pixels of one; as near as the depth check takes for the same.

    An image in a wrong place may contradict no other, seeing past what they see; but then little of
    it lies on their surfaces either.
    """
    images = [image for image in model.images if image.confirmed]
    samples = [_samples(image) for image in images]
    total = 0
    for row, (points, log_std) in enumerate(samples):
        for other, image in enumerate(images):
            if other != row:
                total += _num_agreeing(points, log_std, image, options)
    return total / GRID**2


def _samples(image: RegisteredImage) -> tuple[Float64, Float64]:
    """Points (n, 3) that an image sees, and the std of their log depth (n,)."""
    depth = image.depth
    rows, columns = depth.shape
    xy = pixel_centers(GRID, GRID).reshape(-1, 2) * [columns, rows] / GRID
    column, row = np.floor(xy).astype(np.int64).T
    known = depth.valid[row, column]
    z = depth.depth[row, column].astype(np.float64)
    assert depth.variance is not None  # of a refined map always
    std = np.sqrt(depth.variance[row, column]) / np.where(known, z, 1.0)
    local = unproject(image.camera.resized(columns, rows), xy[known], z[known])
    return (local - image.translation) @ image.rotation, std[known]


def _num_agreeing(
    points: Float64, log_std: Float64, image: RegisteredImage, options: ConsistencyOptions
) -> int:
    depth = image.depth
    rows, columns = depth.shape
    seen = transform(image.rotation, image.translation, points)
    front = seen[:, 2] > 1e-9
    seen, log_std = seen[front], log_std[front]
    column, row = np.floor(project(image.camera.resized(columns, rows), seen)).astype(np.int64).T
    inside = (column >= 0) & (column < columns) & (row >= 0) & (row < rows)
    column, row, z, log_std = column[inside], row[inside], seen[inside, 2], log_std[inside]
    there = depth.depth[row, column].astype(np.float64)
    assert depth.variance is not None
    with np.errstate(divide="ignore", invalid="ignore"):
        off = np.abs(np.log(z / there))
        std = np.hypot(log_std, np.sqrt(depth.variance[row, column]) / there)
    near = off < np.maximum(options.max_deviation * std, options.min_gap)
    return int(np.count_nonzero(near & depth.valid[row, column]))
