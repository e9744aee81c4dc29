"""Agreement among the depth maps of a model, for the selection of the best model."""

from __future__ import annotations

import numpy as np

from mpsfm_core.data import Float64
from mpsfm_core.geometry import pixel_centers, project, transform, unproject
from mpsfm_core.mapping.options import ConsistencyOptions
from mpsfm_core.mapping.scene.reconstruction import Reconstruction, RegisteredImage

GRID = 24
"""Columns and rows of the pixel grid whose depth is compared with other images. [ours]"""


def measure_depth_agreement(model: Reconstruction, options: ConsistencyOptions) -> float:
    """Measure the share of pixels whose depth agrees with the depth of other images.

    The depth of a misregistered image may contradict no other image, because the two images may see
    different surfaces. However, the depth of a misregistered image agrees with the depth of other
    images at few pixels.

    Args:
        model: The reconstructed model, with refined depth maps.
        options: The options ``max_deviation`` and ``min_gap`` define when two depths agree.

    Returns:
        Share of pixels with agreeing depth, summed over all ordered pairs of images.
    """
    images = [image for image in model.images if image.confirmed]
    samples = [_sample_points(image) for image in images]
    num_agreeing = 0
    for row, (points, log_std) in enumerate(samples):
        for other, image in enumerate(images):
            if other != row:
                num_agreeing += _count_agreeing(points, log_std, image, options)
    return num_agreeing / GRID**2


def _sample_points(image: RegisteredImage) -> tuple[Float64, Float64]:
    """Return the world points (n, 3) of a depth map, and the standard deviation of log depth."""
    depth = image.depth
    rows, columns = depth.shape
    xy = pixel_centers(GRID, GRID).reshape(-1, 2) * [columns, rows] / GRID
    column, row = np.floor(xy).astype(np.int64).T
    known = depth.valid[row, column]
    z = depth.depth[row, column].astype(np.float64)
    assert depth.variance is not None  # all refined depth maps contain a variance of depth
    log_std = np.sqrt(depth.variance[row, column]) / np.where(known, z, 1.0)
    points = unproject(image.camera.resized(columns, rows), xy[known], z[known])
    return (points - image.translation) @ image.rotation, log_std[known]


def _count_agreeing(
    points: Float64, log_std: Float64, image: RegisteredImage, options: ConsistencyOptions
) -> int:
    """Count the world points whose depth agrees with the depth map of an image."""
    depth = image.depth
    rows, columns = depth.shape
    local = transform(image.rotation, image.translation, points)
    in_front = local[:, 2] > 1e-9
    local, log_std = local[in_front], log_std[in_front]
    xy = project(image.camera.resized(columns, rows), local)
    column, row = np.floor(xy).astype(np.int64).T
    inside = (column >= 0) & (column < columns) & (row >= 0) & (row < rows)
    column, row, z, log_std = column[inside], row[inside], local[inside, 2], log_std[inside]
    map_depth = depth.depth[row, column].astype(np.float64)
    assert depth.variance is not None
    with np.errstate(divide="ignore", invalid="ignore"):
        errors = np.abs(np.log(z / map_depth))
        std = np.hypot(log_std, np.sqrt(depth.variance[row, column]) / map_depth)
    agrees = errors < np.maximum(options.max_deviation * std, options.min_gap)
    return int(np.count_nonzero(agrees & depth.valid[row, column]))
