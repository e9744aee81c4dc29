"""Fusion of all depth maps into a point cloud without duplicate surfaces."""

# mypy: allow-untyped-decorators

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple, TypeVar

import numpy as np

from mpsfm_core.data import Bool, Float32, Float64, Int64, UInt8, View
from mpsfm_core.dense.view_selection import select_source_views
from mpsfm_core.geometry import camera_center, pixel_centers, resize_map, unproject
from mpsfm_core.mapping.scene.reconstruction import Reconstruction, RegisteredImage
from mpsfm_core.support.jit import kernel
from mpsfm_core.support.threads import parallel_map

DEFAULT_MAX_POINTS = 2_000_000
"""Default maximum number of points of a fused cloud, 32 bytes each in ``dense.ply`` [ours]."""
_MAX_RELATIVE_STD = 0.1
"""Maximum relative depth std of fused pixels, unless more than three quarters of the pixels have a
larger depth std [twice the std of the weaker networks in paper C]."""
_MAX_DIFFERENCE_STDS = 3.0
"""Depth difference in standard deviations from which the depth map of another image contradicts a
pixel [ours]."""
_MAX_VOTERS = 8
"""Maximum number of overlapping images whose depth confirms or contradicts an image's points."""
_MIN_PIXEL_RATIO = 0.25
"""Minimum ratio of an image's pixels with a relative depth std low enough for fusion [ours]."""
_DUPLICATE_DISTANCE = 0.02
"""Distance relative to depth below which consistent points are duplicates at any std [ours]."""
_DOMINANT_STD_RATIO = 0.5
"""Ratio of depth stds of two consistent points below which only the more certain point is used, at
any distance [ours]."""

_T = TypeVar("_T")


class _ConsistencyVotes(NamedTuple):
    """Number of images that confirm, contradict or duplicate n points of an image."""

    consistent: Bool
    """(n,) mask of points that at least as many images confirm as contradict."""
    duplicate: Bool
    """(n,) mask of points that another image observes with lower depth std."""
    views: UInt8
    """(n,) number of images whose depth is consistent with each point, including its own image."""


class FusedPointCloud(NamedTuple):
    """Point cloud of n points, fused from the depth maps of all images."""

    points: Float64
    """(n, 3) float64 positions of the points, world frame."""
    colors: UInt8
    """(n, 3) uint8 RGB colors of the points."""
    normals: Float32
    """(n, 3) float32 unit normals of the points in the world frame, facing the camera (0 if
    undefined)."""
    std: Float32
    """(n,) float32 std of each point's depth, world units."""
    views: UInt8
    """(n,) uint8 number of images whose depth is consistent with each point."""


def fuse_depth_maps(
    reconstruction: Reconstruction,
    view_of: Callable[[str], View],
    max_points: int = DEFAULT_MAX_POINTS,
    seed: int = 0,
) -> FusedPointCloud:
    """Fuse depth maps into one point cloud; the point with the lowest std replaces duplicates.

    The point cloud omits pixels with large depth std, such as sky, inconsistent pixels, held-out
    images and images without confirmed pose.

    Args:
        reconstruction: Posed images with depth maps.
        view_of: Function that returns the undistorted view of an image name, for the colors.
        max_points: Maximum number of points of the cloud. If more than ``max_points`` pixels
            remain, each depth map is subsampled randomly.
        seed: Random seed of the subsampling of depth maps.
    """
    images = reconstruction.dense_images
    voters = select_voters(images)

    def count_unique(row: int, pixels: Int64, votes: _ConsistencyVotes) -> UInt8:
        return _map_views(images[row], pixels, votes, votes.consistent & ~votes.duplicate)

    counts = _vote_on_images(images, voters, count_unique)
    total = sum(np.count_nonzero(of_image) for of_image in counts)
    ratio = min(1.0, max_points / max(1, total))
    rng = np.random.default_rng(seed)
    selected = []
    for of_image in counts:
        pixels = np.flatnonzero(of_image)
        sampled = rng.choice(len(pixels), int(ratio * len(pixels)), replace=False)
        selected.append(pixels[np.sort(sampled)])

    ends = np.cumsum([0, *map(len, selected)])
    cloud = _allocate_cloud(int(ends[-1]))

    def fill_cloud(row: int) -> None:
        image, pixels, rows = images[row], selected[row], slice(ends[row], ends[row + 1])
        cloud.points[rows], variance = _unproject_pixels(image, pixels)
        cloud.colors[rows] = _sample_colors(view_of(image.name), image, pixels)
        cloud.normals[rows] = _compute_normals(image, pixels)
        cloud.std[rows] = np.sqrt(variance)
        cloud.views[rows] = counts[row].ravel()[pixels]

    parallel_map(fill_cloud, range(len(images)))
    return cloud


def select_voters(images: Sequence[RegisteredImage]) -> list[list[int]]:
    """Select the overlapping images whose depth confirms or contradicts each image's points."""
    return select_source_views(images, _MAX_VOTERS)


def count_consistent_views(
    images: Sequence[RegisteredImage], voters: Sequence[Sequence[int]]
) -> list[UInt8]:
    """Count for each pixel the images whose depth agrees with it, including its own image.

    Args:
        images: Images with confirmed poses.
        voters: Indices of the voting images of each image, from :func:`select_voters`.

    Returns:
        One count map (h, w) per image. The count is 0 at pixels with large depth std and at
        inconsistent pixels, which the cloud omits.
    """

    def build_counts(row: int, pixels: Int64, votes: _ConsistencyVotes) -> UInt8:
        return _map_views(images[row], pixels, votes, votes.consistent)

    return _vote_on_images(images, voters, build_counts)


def find_seen_through(
    images: Sequence[RegisteredImage],
    voters: Sequence[Sequence[int]],
    measured: Sequence[Bool],
    pixels: Sequence[Bool],
    max_relative_std: float,
) -> list[Bool]:
    """Find the pixels through which more images see than measure a surface at their depth.

    Args:
        images: Images with confirmed poses.
        voters: Indices of the voting images of each image, from :func:`select_voters`.
        measured: Mask (h, w) of the pixels of each image that vote.
        pixels: Mask (h, w) of the tested pixels of each image.
        max_relative_std: Maximum relative depth std of the tested pixels; larger stds are reduced.
    """
    voting = [
        replace(image, depth=replace(image.depth, valid=mask))
        for image, mask in zip(images, measured, strict=True)
    ]

    def find_in_image(row: int) -> Bool:
        tested = np.flatnonzero(pixels[row])
        points, variance = _unproject_pixels(images[row], tested)
        variance = np.minimum(
            variance, (max_relative_std * images[row].depth.depth.ravel()[tested]) ** 2
        )
        maps = [(voting[j], measured[j], False) for j in voters[row]]
        votes = _vote_on_points(points, variance, maps, _MAX_DIFFERENCE_STDS)
        seen_through = np.zeros(pixels[row].shape, np.bool_)
        seen_through.ravel()[tested[~votes.consistent]] = True
        return seen_through

    return parallel_map(find_in_image, range(len(images)))


def _vote_on_images(
    images: Sequence[RegisteredImage],
    voters: Sequence[Sequence[int]],
    select: Callable[[int, Int64, _ConsistencyVotes], _T],
) -> list[_T]:
    """Compute the consistency votes on each image's points, and apply a selection function.

    Args:
        images: Images with confirmed poses.
        voters: Indices of the voting images of each image.
        select: Function that receives an image index, the flat indices of its pixels with low depth
            std, and the votes on these pixels.
    """
    max_relative_std = max(_MAX_RELATIVE_STD, _relative_std_of_best_pixels(images))
    usable = [_certain_pixels(image, max_relative_std) for image in images]

    def vote_on_image(row: int) -> _T:
        pixels = np.flatnonzero(usable[row])
        points, variance = _unproject_pixels(images[row], pixels)
        maps = [(images[j], usable[j], j < row) for j in voters[row]]
        votes = _vote_on_points(points, variance, maps, _MAX_DIFFERENCE_STDS)
        return select(row, pixels, votes)

    return parallel_map(vote_on_image, range(len(images)))


def _map_views(
    image: RegisteredImage, pixels: Int64, votes: _ConsistencyVotes, selected: Bool
) -> UInt8:
    """Return the number of consistent images of each selected pixel as map (h, w), else 0."""
    counts = np.zeros(image.depth.shape, np.uint8)
    counts.ravel()[pixels[selected]] = votes.views[selected]
    return counts


def _allocate_cloud(count: int) -> FusedPointCloud:
    """Return a point cloud whose values are not set."""
    return FusedPointCloud(
        np.empty((count, 3)),
        np.empty((count, 3), np.uint8),
        np.empty((count, 3), np.float32),
        np.empty(count, np.float32),
        np.empty(count, np.uint8),
    )


def _relative_std_of_best_pixels(images: Sequence[RegisteredImage]) -> float:
    """Compute the 0.25 quantile of relative depth std in each image, and return the median."""
    quantiles = [
        np.quantile(np.sqrt(_variance(image)[valid]) / image.depth.depth[valid], _MIN_PIXEL_RATIO)
        for image in images
        if (valid := image.depth.valid).any()
    ]
    return float(np.median(quantiles)) if quantiles else 0.0


def _certain_pixels(image: RegisteredImage, max_relative_std: float) -> Bool:
    """Return the mask (h, w) of valid depth pixels with a low relative std."""
    certain: Bool = _variance(image) <= (max_relative_std * image.depth.depth) ** 2
    return certain & image.depth.valid


def _variance(image: RegisteredImage) -> Float32:
    assert image.depth.variance is not None  # Refined depth maps always have a variance.
    return image.depth.variance


def _unproject_pixels(image: RegisteredImage, pixels: Int64) -> tuple[Float64, Float64]:
    """Unproject pixels, given as flat indices, to world points (n, 3) with depth variances (n,)."""
    height, width = image.depth.shape
    camera = image.camera.resized(width, height)
    xy = pixel_centers(width, height).reshape(-1, 2)[pixels]
    local = unproject(camera, xy, image.depth.depth.ravel()[pixels])
    world = local @ image.rotation + camera_center(image.rotation, image.translation)
    return world, _variance(image).ravel()[pixels].astype(np.float64)


def _vote_on_points(
    points: Float64,
    variance: Float64,
    voters: Sequence[tuple[RegisteredImage, Bool, bool]],
    sigmas: float,
) -> _ConsistencyVotes:
    """Count the images that confirm, contradict or duplicate the points of one image.

    Args:
        points: (n, 3) points of the image, world frame.
        variance: (n,) variance of the points' depth.
        voters: Neighboring images, masks of their pixels with low depth std, and True if the
            neighbor's point is kept when two duplicate points have equal variance.
        sigmas: Largest difference of consistent depths in stds.
    """
    votes = np.zeros(len(points), np.int64)
    views = np.ones(len(points), np.uint8)
    duplicate = np.zeros(len(points), np.bool_)
    for voter, usable, wins_ties in voters:
        height, width = voter.depth.shape
        camera = voter.camera.resized(width, height)
        projection = camera.matrix @ voter.rotation, camera.matrix @ voter.translation
        maps = (voter.depth.depth, voter.depth.valid, _variance(voter), usable)
        _vote(points, variance, *projection, *maps, wins_ties, sigmas, votes, views, duplicate)
    return _ConsistencyVotes(votes >= 0, duplicate, views)


@kernel()
def _vote(
    points: Float64,
    variance: Float64,
    matrix: Float64,
    offset: Float64,
    depth: Float32,
    valid: Bool,
    depth_variance: Float32,
    usable: Bool,
    wins_ties: bool,
    sigmas: float,
    votes: Int64,
    views: UInt8,
    duplicate: Bool,
) -> None:
    """Compare points with the depth map of a neighboring image, and add the image's votes.

    The homogeneous pixel of a point in the neighboring image is ``matrix @ point + offset``.
    """
    height, width = depth.shape
    for k in range(len(points)):
        u, v, z = offset
        for axis in range(3):
            u += matrix[0, axis] * points[k, axis]
            v += matrix[1, axis] * points[k, axis]
            z += matrix[2, axis] * points[k, axis]
        if z <= 0 or u < 0 or v < 0 or u > width * z or v > height * z:
            continue
        row, column = min(int(v / z), height - 1), min(int(u / z), width - 1)
        if not valid[row, column]:
            continue
        difference, voter_variance = depth[row, column] - z, depth_variance[row, column]
        limit = sigmas * math.sqrt(variance[k] + voter_variance)
        if difference > limit:  # The point is in front of the neighboring image's surface.
            votes[k] -= 1
        if abs(difference) > limit:
            continue
        votes[k] += 1
        views[k] += 1
        better = voter_variance < variance[k] or (wins_ties and voter_variance == variance[k])
        close = abs(difference) <= _DUPLICATE_DISTANCE * z
        replaces = close or voter_variance <= _DOMINANT_STD_RATIO**2 * variance[k]
        if better and replaces and usable[row, column]:
            duplicate[k] = True


def _compute_normals(image: RegisteredImage, pixels: Int64) -> Float32:
    """Compute normals (n, 3) in the world frame at pixels, zero at holes and image borders.

    Args:
        image: Image with depth map.
        pixels: (n,) flat indices of pixels.
    """
    height, width = image.depth.shape
    camera = image.camera.resized(width, height)
    depth, valid = image.depth.depth, image.depth.valid
    rows, columns = np.divmod(pixels, width)
    is_inner = (rows > 0) & (rows < height - 1) & (columns > 0) & (columns < width - 1)
    inner = np.flatnonzero(is_inner)
    rows, columns = rows[inner], columns[inner]
    neighbors = [(rows + y, columns + x) for x, y in ((1, 0), (-1, 0), (0, 1), (0, -1))]
    usable = np.all([valid[neighbor] for neighbor in neighbors], axis=0)
    right, left, below, above = (
        unproject(camera, np.stack([x[usable], y[usable]], axis=1) + 0.5, depth[y, x][usable])
        for y, x in neighbors
    )
    normal = np.cross(below - above, right - left)  # a surface normal that faces the camera
    length = np.linalg.norm(normal, axis=-1, keepdims=True)
    normals = np.zeros((len(pixels), 3), np.float32)
    normals[inner[usable]] = normal / np.where(length > 0, length, 1) @ image.rotation
    return normals


def _sample_colors(view: View, image: RegisteredImage, pixels: Int64) -> UInt8:
    height, width = image.depth.shape
    small = resize_map(view.image, width, height).reshape(-1, 3)[pixels]
    return np.round(small).astype(np.uint8)
