"""One coloured point cloud from the refined depth maps."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from scipy.sparse import csr_array

from mpsfm_core.data import Bool, Float32, Float64, Int64, UInt8, View
from mpsfm_core.geometry import (
    camera_center,
    inside,
    pixel_centers,
    project,
    resize_map,
    sample_nearest,
    transform,
    unproject,
)
from mpsfm_core.results.options import ResultOptions
from mpsfm_core.scene.reconstruction import Reconstruction, RegisteredImage

_NEIGHBORS = 8
"""Images that vote on the points of one image: those that share most points with it."""
_WORSE = 1.5
"""Pixels of so many times the median std stay in any case: a network that promises little still
gives a cloud (ours)."""


def fuse_depth_maps(
    reconstruction: Reconstruction,
    view_of: Callable[[str], View],
    options: ResultOptions,
    seed: int = 0,
) -> tuple[Float64, UInt8]:
    """World points (n, 3) and their RGB colours (n, 3), from all maps.

    Uncertain pixels are left out, those that other images see through (free-space violation), and
    images that nothing confirms.
    Above ``options.dense_max_points`` a random share of each map's pixels is taken.
    """
    reconstruction = replace(reconstruction, images=reconstruction.confirmed_images)
    images = reconstruction.images
    limit = max(options.dense_max_relative_std, _WORSE * _median_relative_std(images))
    usable = [_certain(image, limit) for image in images]
    share = min(1.0, options.dense_max_points / max(1, sum(int(mask.sum()) for mask in usable)))
    neighbors = _neighbors(reconstruction)
    rng = np.random.default_rng(seed)
    clouds, colors = [np.zeros((0, 3))], [np.zeros((0, 3), np.uint8)]
    for image, mask, near in zip(images, usable, neighbors, strict=True):
        pixels = np.flatnonzero(mask)
        pixels = np.sort(rng.choice(pixels, int(share * len(pixels)), replace=False))
        points, variance = _lift(image, pixels)
        kept = _unseen_through(
            points, variance, [images[j] for j in near], options.dense_consistency_sigmas
        )
        clouds.append(points[kept])
        colors.append(_colors(view_of(image.name), image, pixels[kept]))
    return np.concatenate(clouds), np.concatenate(colors)


def _median_relative_std(images: Sequence[RegisteredImage]) -> float:
    """Over the images, of the median over the pixels."""
    spreads = [
        np.median(np.sqrt(_variance(image)[valid]) / image.depth.depth[valid])
        for image in images
        if (valid := image.depth.valid).any()
    ]
    return float(np.median(spreads)) if spreads else 0.0


def _certain(image: RegisteredImage, max_relative_std: float) -> Bool:
    certain: Bool = _variance(image) <= (max_relative_std * image.depth.depth) ** 2
    return certain & image.depth.valid


def _variance(image: RegisteredImage) -> Float32:
    assert image.depth.variance is not None  # a refined map always has one
    return image.depth.variance


def _neighbors(reconstruction: Reconstruction) -> list[Int64]:
    """For each image the rows of those that share most points with it."""
    seen = [image.point_ids[image.point_ids >= 0] for image in reconstruction.images]
    starts = np.cumsum([0, *map(len, seen)])
    sees = csr_array(
        (np.ones(starts[-1], np.int32), np.concatenate(seen), starts),
        shape=(len(seen), len(reconstruction.points)),
    )
    shared = (sees @ sees.T).toarray()
    np.fill_diagonal(shared, 0)
    order = np.argsort(-shared, axis=1, kind="stable")[:, :_NEIGHBORS]
    return [row[shared[i, row] > 0] for i, row in enumerate(order)]


def _lift(image: RegisteredImage, pixels: Int64) -> tuple[Float64, Float64]:
    """World points (n, 3) of flat pixel indices of the map, and their depth variance (n,)."""
    height, width = image.depth.shape
    camera = image.camera.resized(width, height)
    xy = pixel_centers(width, height).reshape(-1, 2)[pixels]
    local = unproject(camera, xy, image.depth.depth.ravel()[pixels])
    world = local @ image.rotation + camera_center(image.rotation, image.translation)
    return world, _variance(image).ravel()[pixels].astype(np.float64)


def _unseen_through(
    points: Float64, variance: Float64, others: list[RegisteredImage], sigmas: float
) -> Bool:
    """True for points that at least as many other images confirm as see through."""
    votes = np.zeros(len(points), dtype=np.int64)
    for other in others:
        height, width = other.depth.shape
        local = transform(other.rotation, other.translation, points)
        xy = project(other.camera.resized(width, height), local)
        seen = np.flatnonzero(inside(xy, (width, height)))
        seen = seen[sample_nearest(other.depth.valid, xy[seen])]
        ahead = sample_nearest(other.depth.depth, xy[seen]) - local[seen, 2]
        std = np.sqrt(variance[seen] + sample_nearest(_variance(other), xy[seen]))
        votes[seen] += np.where(ahead > sigmas * std, -1, np.where(ahead < -sigmas * std, 0, 1))
    return votes >= 0


def _colors(view: View, image: RegisteredImage, pixels: Int64) -> UInt8:
    height, width = image.depth.shape
    small = resize_map(view.image, width, height).reshape(-1, 3)[pixels]
    return np.round(small).astype(np.uint8)
