"""One point cloud from the depth maps of all images, every surface once."""

# mypy: allow-untyped-decorators

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple, TypeVar

import numpy as np

from mpsfm_core.data import Bool, Float32, Float64, Int64, UInt8, View
from mpsfm_core.dense.view_selection import select_source_views
from mpsfm_core.geometry import camera_center, pixel_centers, resize_map, unproject
from mpsfm_core.mapping.scene.reconstruction import Reconstruction, RegisteredImage
from mpsfm_core.results.options import ResultOptions
from mpsfm_core.support.jit import kernel
from mpsfm_core.support.threads import each

_T = TypeVar("_T")

_NEIGHBORS = 8
"""Images that vote on the points of one image: those that see most of it."""
_SUREST = 0.25
"""Share of the pixels, surest first, that stay in any case: a network that promises little still
gives a cloud (ours)."""
_SAME = 0.02
"""Relative distance up to which points that agree are one, whatever their std (ours)."""
_MUCH_SURER = 0.5
"""Std of an image, in that of another that agrees, with which its surface stands for the other's at
any distance (ours)."""


class _ConsistencyVotes(NamedTuple):
    """Of points (n,): which stay, which of them an image shows that is more certain, and how many
    images agree on each, its own counted."""

    stays: Bool
    better_elsewhere: Bool
    views: UInt8


class FusedPointCloud(NamedTuple):
    """Points of a surface, (n, ...).

    ``points``: (n, 3) float64, world. ``colors``: (n, 3) uint8, RGB. ``normals``: (n, 3) float32,
    unit, towards the camera that saw the point; zero where the depth map says none. ``std``: (n,)
    float32, of the depth, world units. ``views``: (n,) uint8, images whose depth agrees, its own
    counted: 1 for what one image alone says.
    """

    points: Float64
    colors: UInt8
    normals: Float32
    std: Float32
    views: UInt8


def fuse_depth_maps(
    reconstruction: Reconstruction,
    view_of: Callable[[str], View],
    options: ResultOptions,
    seed: int = 0,
) -> FusedPointCloud:
    """Where images agree on a surface it is taken from the one that is most certain.

    Left out are uncertain pixels, those that more images see through than confirm, and images
    without a confirmed pose. Above ``options.dense_max_points`` a random share of each map's pixels
    is taken.
    """
    images = reconstruction.confirmed_images

    def kept(_: int, pixels: Int64, verdict: _ConsistencyVotes) -> tuple[Int64, UInt8]:
        ours = verdict.stays & ~verdict.better_elsewhere
        return pixels[ours], verdict.views[ours]

    found = _judged(images, options, kept)
    total = sum(len(pixels) for pixels, _ in found)
    share = min(1.0, options.dense_max_points / max(1, total))
    rng = np.random.default_rng(seed)
    for row, (pixels, views) in enumerate(found):
        chosen = np.sort(rng.choice(len(pixels), int(share * len(pixels)), replace=False))
        found[row] = pixels[chosen], views[chosen]

    def part(row: int) -> FusedPointCloud:
        image, (pixels, views) = images[row], found[row]
        points, variance = _lift(image, pixels)
        colors = _colors(view_of(image.name), image, pixels)
        normals = _normals(image).reshape(-1, 3)[pixels]
        return FusedPointCloud(points, colors, normals, np.sqrt(variance).astype(np.float32), views)

    parts = [_EMPTY, *each(part, range(len(images)))]
    return FusedPointCloud(*map(np.concatenate, zip(*parts, strict=True)))


def consistent_pixels(images: Sequence[RegisteredImage], options: ResultOptions) -> list[Bool]:
    """For each image (h, w): certain pixels that not more images see through than confirm."""

    def mask(row: int, pixels: Int64, verdict: _ConsistencyVotes) -> Bool:
        which = np.zeros(images[row].depth.shape, np.bool_)
        which.ravel()[pixels[verdict.stays]] = True
        return which

    return _judged(images, options, mask)


def _judged(
    images: Sequence[RegisteredImage],
    options: ResultOptions,
    take: Callable[[int, Int64, _ConsistencyVotes], _T],
) -> list[_T]:
    """What is taken of each image: of its row, its certain pixels, flat, and what the others say
    of them."""
    limit = max(options.dense_max_relative_std, _std_of_surest(images))
    usable = [_certain(image, limit) for image in images]
    near = select_source_views(images, _NEIGHBORS)

    def judged(row: int) -> _T:
        pixels = np.flatnonzero(usable[row])
        points, variance = _lift(images[row], pixels)
        others = [(images[j], usable[j], j < row) for j in near[row]]
        verdict = _votes(points, variance, others, options.dense_consistency_sigmas)
        return take(row, pixels, verdict)

    return each(judged, range(len(images)))


_EMPTY = FusedPointCloud(
    np.zeros((0, 3)),
    np.zeros((0, 3), np.uint8),
    np.zeros((0, 3), np.float32),
    np.zeros(0, np.float32),
    np.zeros(0, np.uint8),
)


def _std_of_surest(images: Sequence[RegisteredImage]) -> float:
    """The largest relative std of the share that stays; the median over the images."""
    spreads = [
        np.quantile(np.sqrt(_variance(image)[valid]) / image.depth.depth[valid], _SUREST)
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


def _lift(image: RegisteredImage, pixels: Int64) -> tuple[Float64, Float64]:
    """World points (n, 3) of flat pixel indices of the map, and their depth variance (n,)."""
    height, width = image.depth.shape
    camera = image.camera.resized(width, height)
    xy = pixel_centers(width, height).reshape(-1, 2)[pixels]
    local = unproject(camera, xy, image.depth.depth.ravel()[pixels])
    world = local @ image.rotation + camera_center(image.rotation, image.translation)
    return world, _variance(image).ravel()[pixels].astype(np.float64)


def _votes(
    points: Float64,
    variance: Float64,
    others: Sequence[tuple[RegisteredImage, Bool, bool]],
    sigmas: float,
) -> _ConsistencyVotes:
    """What other images say of points.

    ``others``: images, which of their pixels may become points, and whether they come first among
    equally certain ones.
    """
    votes = np.zeros(len(points), np.int64)
    views = np.ones(len(points), np.uint8)
    theirs = np.zeros(len(points), np.bool_)
    for other, usable, first in others:
        height, width = other.depth.shape
        camera = other.camera.resized(width, height)
        turned, shift = camera.matrix @ other.rotation, camera.matrix @ other.translation
        map_ = (other.depth.depth, other.depth.valid, _variance(other), usable)
        _vote(points, variance, turned, shift, *map_, first, sigmas, votes, views, theirs)
    return _ConsistencyVotes(votes >= 0, theirs, views)


@kernel()
def _vote(
    points: Float64,
    variance: Float64,
    turned: Float64,
    shift: Float64,
    depth: Float32,
    valid: Bool,
    depth_variance: Float32,
    usable: Bool,
    first: bool,
    sigmas: float,
    votes: Int64,
    views: UInt8,
    theirs: Bool,
) -> None:
    """Add what one image says to ``votes``, ``views`` and ``theirs``; a point is there at the
    homogeneous pixel ``turned @ point + shift``."""
    height, width = depth.shape
    for k in range(len(points)):
        u, v, z = shift
        for axis in range(3):
            u += turned[0, axis] * points[k, axis]
            v += turned[1, axis] * points[k, axis]
            z += turned[2, axis] * points[k, axis]
        if z <= 0 or u < 0 or v < 0 or u > width * z or v > height * z:
            continue
        row, column = min(int(v / z), height - 1), min(int(u / z), width - 1)
        if not valid[row, column]:
            continue
        ahead, other_variance = depth[row, column] - z, depth_variance[row, column]
        limit = sigmas * math.sqrt(variance[k] + other_variance)
        if ahead > limit:
            votes[k] -= 1
        if abs(ahead) > limit:
            continue
        votes[k] += 1
        views[k] += 1
        surer = other_variance < variance[k] or (first and other_variance == variance[k])
        same = abs(ahead) <= _SAME * z or other_variance <= _MUCH_SURER**2 * variance[k]
        if surer and same and usable[row, column]:
            theirs[k] = True


def _normals(image: RegisteredImage) -> Float32:
    """World normals (h, w, 3) float32 of a map; zero at holes and borders."""
    height, width = image.depth.shape
    camera = image.camera.resized(width, height)
    local = unproject(camera, pixel_centers(width, height), image.depth.depth)
    normals = np.zeros((height, width, 3), np.float32)
    across, down = local[1:-1, 2:] - local[1:-1, :-2], local[2:, 1:-1] - local[:-2, 1:-1]
    normal = np.cross(down, across)  # towards the camera: x right, y down, z forward
    valid = image.depth.valid
    usable = valid[1:-1, 2:] & valid[1:-1, :-2] & valid[2:, 1:-1] & valid[:-2, 1:-1]
    length = np.linalg.norm(normal, axis=-1, keepdims=True)
    unit = normal / np.where(length > 0, length, 1)
    normals[1:-1, 1:-1] = np.where(usable[..., None], unit @ image.rotation, 0)
    return normals


def _colors(view: View, image: RegisteredImage, pixels: Int64) -> UInt8:
    height, width = image.depth.shape
    small = resize_map(view.image, width, height).reshape(-1, 3)[pixels]
    return np.round(small).astype(np.uint8)
