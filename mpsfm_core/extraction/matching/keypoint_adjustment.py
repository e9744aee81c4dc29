"""Keypoint adjustment: refine keypoints to a fraction of a pixel by aligning image patches.

Detectors localize a scene point differently in each image, and many networks return whole pixels of
a downscaled image. Two steps correct the keypoints, as in Lindenberger et al., Pixel-Perfect
Structure-from-Motion, ICCV 2021, with gray values instead of learned features.

The first step aligns the image patches around each verified match, with the warp of a
fronto-parallel plane at the depth of the match as start. The second step solves for the shifts of
all keypoints that fit all patch alignments (IRLS with a Cauchy loss).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import cv2
import numpy as np
from scipy.sparse import coo_array, csc_matrix
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import splu

from mpsfm_core.data import Bool, Float32, Float64, Int64, PinholeCamera, UInt8, VerifiedPair
from mpsfm_core.extraction.cache import content_key, digest
from mpsfm_core.extraction.context import ExtractionContext
from mpsfm_core.geometry import rays
from mpsfm_core.geometry.patch_alignment import align_patches
from mpsfm_core.support.lru_cache import LruCache
from mpsfm_core.support.memory import release_free_memory

CACHED_BYTES = 256 << 20
"""Size limit of the in-memory cache of gray images, bytes."""
BLUR_PX = 0.8
"""Standard deviation of the Gaussian blur of gray images, pixels."""
MAX_ALIGNMENTS = 4
"""Maximum number of matches per keypoint whose patches are aligned; the best scores are used."""
RADIUS_STD = 9
"""Radius of the round image patches in keypoint standard deviations. The cost of alignment grows
with the square of the radius, and larger patches are less often planar."""
MIN_CORRELATION = 0.8
"""Minimum normalized cross-correlation of aligned patches."""
MAX_SHIFT_STD = 3.0
"""Maximum shift of a keypoint, in keypoint standard deviations."""
ADJUSTED_STD_RATIO = 0.25
"""Ratio of keypoint standard deviations after and before adjustment."""
_INPUTS, _ALIGNED = "alignment-input", "alignment"
"""Subfolders of the cache with the inputs and results of remote workers."""
_NOISE_CORRELATION_PX = float(2 * np.sqrt(np.pi) * BLUR_PX)
"""Correlation length of image noise after the Gaussian blur, pixels."""
_MIN_ALIGNMENT_STD = 0.05
"""Minimum standard deviation of a patch alignment, in keypoint standard deviations. The minimum
accounts for interpolation and non-planar surfaces."""
_CAUCHY_SCALE = 0.3
"""Scale of the Cauchy loss on alignment residuals, in keypoint standard deviations."""
_NUM_REWEIGHTINGS = 3
"""Number of IRLS iterations that solve for the keypoint shifts."""
_MAX_EQUATIONS = 200_000
"""Number of aligned patches up to which one system of equations solves for all shifts, with about
350 MB of memory. [ours]"""
_MIN_DETERMINANT = 0.05
"""Minimum determinant of an affine warp; warps that shrink area further are rejected."""


@dataclass(frozen=True, eq=False)
class AlignedPair:
    """Linear equations ``shift_b - warp @ shift_a = offset`` of the keypoint shifts of a pair."""

    rows: Int64
    """(m,) indices of the matches whose patches were aligned."""
    warp: Float64
    """(m, 2, 2) affine warp from view a to view b."""
    offset: Float64
    """(m, 2) offset of the linear equations, in pixels of view b."""
    information: Float64
    """(m, 2, 2) inverse covariance of the offset, in pixels^-2 of view b."""


@dataclass(frozen=True, eq=False)
class AlignmentInput:
    """Matched keypoints of an image pair, in the cache for a remote worker."""

    images: Int64
    """(2,) indices of both images."""
    xy_a: Float64
    """(m, 2) matched keypoints of the first view, pixels."""
    xy_b: Float64
    """(m, 2) matched keypoints of the second view, pixels."""
    std_px: Float64
    """(2,) standard deviation of the keypoints of both views, pixels."""
    rotation: Float64
    """(3, 3) rotation ``b_from_a``."""
    translation: Float64
    """(3,) translation ``b_from_a``."""


_EQUATION = ("warp", "offset", "information")


class AdjustedKeypoints(NamedTuple):
    """Keypoints of one image after adjustment."""

    keypoints: Float64
    """(n, 2) adjusted keypoints, pixels."""
    measured: Bool
    """(n,) true for keypoints moved by patch alignment; other keypoints are unchanged."""


class PairSide(NamedTuple):
    """Gray image and matched keypoints of one view of an image pair."""

    camera: PinholeCamera
    image: Float32
    """(h, w) blurred gray image, the result of :func:`smooth_gray_image`."""
    xy: Float64
    """(m, 2) matched keypoints, pixels of the view."""
    std_px: float
    """Standard deviation of the keypoints, pixels of the view."""

    @property
    def step(self) -> Float64:
        """Scale factors (2,) from pixels of the view to pixels of the gray image."""
        return np.array(self.image.shape[::-1]) / (self.camera.width, self.camera.height)


class KeypointAdjuster:
    """Adjusts the keypoints of all images of a run.

    Remote workers read the matched keypoints from the cache, and write the alignment of patches to
    the cache.

    Args:
        context: Context of the extraction with images, options and progress.
        keypoints: (n, 2) keypoints of each image, pixels; empty in a remote worker.
        std_px: Standard deviation of the keypoints of each image.
    """

    def __init__(
        self,
        context: ExtractionContext,
        keypoints: Sequence[Float64] = (),
        std_px: Sequence[float] = (),
    ) -> None:
        self._context = context
        self._keypoints = keypoints
        self._std_px = std_px
        self._gray: LruCache[tuple[int, float], Float32] = LruCache(
            CACHED_BYTES, lambda image: image.nbytes
        )

    def run(self, pairs: Sequence[VerifiedPair]) -> list[AdjustedKeypoints]:
        """Align the patches of the best matches of all pairs, and adjust all keypoints."""
        counts = [len(xy) for xy in self._keypoints]
        pairs = select_best_matches(pairs, counts, MAX_ALIGNMENTS)
        context = self._context
        keys = [self._store(pair) for pair in pairs] if context.run_remotely else None
        aligned = context.each("adjustment", pairs, self._align, remote_items=keys)
        for key in keys or ():
            context.cache.forget(_INPUTS, key)
            context.cache.forget(_ALIGNED, key)
        # the solver needs about as much memory as the images
        self._gray.clear()
        context.images.release_views()
        release_free_memory()
        return adjust_keypoints(self._keypoints, self._std_px, pairs, aligned)

    def align_stored(self, key: str) -> None:
        """Align the patches of a pair in the cache, and store the result for the main process."""
        cache = self._context.cache
        given = cache.load(_INPUTS, key, AlignmentInput)
        if given is not None and cache.load(_ALIGNED, key, AlignedPair) is None:
            cache.store(_ALIGNED, key, self._align_input(given))

    def _store(self, pair: VerifiedPair) -> str:
        """Store the matched keypoints of a pair for remote workers, and return their key."""
        given = self._input(pair)
        key = self._key(given)
        self._context.cache.store(_INPUTS, key, given)
        return key

    def _key(self, given: AlignmentInput) -> str:
        """Return the key in the cache of an input and its result, which belong to one run."""
        return content_key(self._context.shared_run, digest(given))

    def _input(self, pair: VerifiedPair) -> AlignmentInput:
        images = [pair.image_a, pair.image_b]
        xy_a, xy_b = (
            self._keypoints[index][pair.matches[:, side]] for side, index in enumerate(images)
        )
        std_px = np.array([self._std_px[index] for index in images], dtype=np.float64)
        return AlignmentInput(np.array(images), xy_a, xy_b, std_px, pair.rotation, pair.translation)

    def _align(self, pair: VerifiedPair) -> AlignedPair:
        given = self._input(pair)
        if self._context.run_remotely:
            stored = self._context.cache.load(_ALIGNED, self._key(given), AlignedPair)
            if stored is not None:
                return stored
        return self._align_input(given)

    def _align_input(self, given: AlignmentInput) -> AlignedPair:
        a, b = (
            PairSide(self._context.images[index].pinhole, self._image(index, std_px), xy, std_px)
            for index, std_px, xy in zip(
                given.images.tolist(),
                given.std_px.tolist(),
                (given.xy_a, given.xy_b),
                strict=True,
            )
        )
        return align_pair(a, b, given.rotation, given.translation)

    def _image(self, index: int, std_px: float) -> Float32:
        return self._gray.get(
            (index, std_px), lambda: smooth_gray_image(self._context.view(index).image, std_px)
        )


def select_best_matches(
    pairs: Sequence[VerifiedPair], counts: Sequence[int], max_matches: int
) -> list[VerifiedPair]:
    """Select the matches that are among the best matches of either of their keypoints.

    Args:
        pairs: Verified pairs.
        counts: Number of keypoints of each image.
        max_matches: Number of best matches to select per keypoint.

    Returns:
        Image pairs with their selected matches; pairs without selected matches are omitted.
    """
    if not pairs:
        return []
    a, b = _number_keypoints(pairs, counts)
    match = np.tile(np.arange(len(a)), 2)
    keypoint = np.concatenate([a, b])
    score = np.tile(np.concatenate([pair.scores for pair in pairs]), 2)
    order = np.lexsort((match, -score, keypoint))
    rank = np.arange(len(order)) - np.searchsorted(keypoint[order], keypoint[order])
    best = np.zeros(len(a), dtype=np.bool_)
    best[match[order[rank < max_matches]]] = True
    rows_of_pairs = np.split(best, np.cumsum([len(pair) for pair in pairs])[:-1])
    return [
        replace(pair, matches=pair.matches[rows], scores=pair.scores[rows])
        for pair, rows in zip(pairs, rows_of_pairs, strict=True)
        if rows.any()
    ]


def _number_keypoints(pairs: Sequence[VerifiedPair], counts: Sequence[int]) -> tuple[Int64, Int64]:
    """Return the indices (m,) of matched keypoints in the concatenated keypoints of all images."""
    offsets = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
    a = [offsets[pair.image_a] + pair.matches[:, 0] for pair in pairs]
    b = [offsets[pair.image_b] + pair.matches[:, 1] for pair in pairs]
    return np.concatenate(a), np.concatenate(b)


def smooth_gray_image(rgb: UInt8, std_px: float) -> Float32:
    """Convert an RGB view (h, w, 3) to a blurred gray image with a keypoint std of one pixel."""
    image: Any = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY).astype(np.float32)
    if std_px > 1:
        size = [max(1, round(length / std_px)) for length in image.shape[::-1]]
        image = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    smooth: Float32 = cv2.GaussianBlur(image, (0, 0), BLUR_PX)
    return smooth


def align_pair(a: PairSide, b: PairSide, rotation: Float64, translation: Float64) -> AlignedPair:
    """Align the patches around the matches of an image pair by affine least squares.

    Template patches come from the view of higher resolution.

    Args:
        a: First view.
        b: Second view.
        rotation: (3, 3) rotation of ``cam_b_from_cam_a``.
        translation: (3,) translation of ``cam_b_from_cam_a``.
    """
    warp = fronto_parallel_warp(a, b, rotation, translation) * (b.step[:, None] / a.step)
    is_swapped = bool(np.median(np.linalg.det(warp)) > 1)
    if is_swapped:
        a, b, warp = b, a, _invert(warp)
    alignment = align_patches(
        a.image, b.image, a.xy * a.step, b.xy * b.step, warp, RADIUS_STD, _NOISE_CORRELATION_PX
    )
    rows = np.flatnonzero(
        (alignment.correlation >= MIN_CORRELATION)
        & (np.linalg.norm(alignment.shift, axis=1) <= MAX_SHIFT_STD)
        & (np.abs(np.linalg.det(alignment.warp)) > _MIN_DETERMINANT)
    )
    to_view = 1 / b.step
    warp = alignment.warp[rows] * (to_view[:, None] * a.step)
    offset = alignment.shift[rows] * to_view
    covariance = alignment.covariance[rows] * np.outer(to_view, to_view)
    information = _invert(covariance + (_MIN_ALIGNMENT_STD * b.std_px) ** 2 * np.eye(2))
    if is_swapped:
        information = warp.transpose(0, 2, 1) @ information @ warp
        warp = _invert(warp)
        offset = -np.einsum("mij,mj->mi", warp, offset)
    return AlignedPair(rows, warp, offset, information)


def fronto_parallel_warp(
    a: PairSide, b: PairSide, rotation: Float64, translation: Float64
) -> Float64:
    """Return the warps (m, 2, 2) of planes that are parallel to image a, from view a to view b.

    Each plane passes through the triangulated point of a match. If the point is not in front of
    both cameras, the plane at infinity is used.
    """
    ray_a, ray_b = rays(a.camera, a.xy) @ rotation.T, rays(b.camera, b.xy)
    # Least-squares depth z of ray_b x (z ray_a + translation) = 0.
    cross_a, cross_t = np.cross(ray_b, ray_a), np.cross(ray_b, translation)
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = -(cross_a * cross_t).sum(axis=1) / (cross_a**2).sum(axis=1)
        point = depth[:, None] * ray_a + translation
    far = ~((depth > 0) & np.isfinite(depth) & (point[:, 2] > 0))
    depth[far], point[far] = 1.0, ray_a[far]
    u = point[:, :2] / point[:, 2:]
    warp = rotation[:2, :2] - u[:, :, None] * rotation[2, :2]
    warp *= (depth / point[:, 2])[:, None, None]
    focal_a, focal_b = ([side.camera.fx, side.camera.fy] for side in (a, b))
    in_pixels: Float64 = warp * (np.array(focal_b)[:, None] / focal_a)
    return in_pixels


def adjust_keypoints(
    keypoints: Sequence[Float64],
    std_px: Sequence[float],
    pairs: Sequence[VerifiedPair],
    aligned: Sequence[AlignedPair],
    max_shift_std: float = MAX_SHIFT_STD,
) -> list[AdjustedKeypoints]:
    """Move the keypoints of all images to fit the patch alignments of all pairs.

    A Gaussian prior keeps each keypoint near its detected position.

    Args:
        keypoints: (n, 2) keypoints of each image, pixels.
        std_px: Standard deviation of the keypoints of each image.
        pairs: Image pairs whose patches were aligned.
        aligned: Linear equations of the keypoint shifts of each image pair.
        max_shift_std: Maximum keypoint shift in keypoint standard deviations; keypoints with larger
            shifts are not moved.
    """
    counts = [len(xy) for xy in keypoints]
    std = np.repeat(np.asarray(std_px, dtype=np.float64), counts)
    shifts, measured = np.zeros((len(std), 2)), np.zeros(len(std), dtype=np.bool_)
    if any(len(pair.rows) for pair in aligned):
        a, b = _number_keypoints(pairs, counts)
        starts = np.cumsum([0, *map(len, pairs)])
        rows = np.concatenate(
            [start + pair.rows for start, pair in zip(starts, aligned, strict=False)]
        )
        a, b = a[rows], b[rows]
        equations = [np.concatenate([getattr(p, name) for p in aligned]) for name in _EQUATION]
        for part in split_equations(a, b, len(std)):
            shifts += solve_shifts(std, a[part], b[part], *(values[part] for values in equations))
        measured[a] = measured[b] = True
    measured &= np.linalg.norm(shifts, axis=1) <= max_shift_std * std
    moved = np.concatenate(keypoints) + np.where(measured[:, None], shifts, 0.0)
    ends = np.cumsum(counts)[:-1]
    return list(map(AdjustedKeypoints, np.split(moved, ends), np.split(measured, ends)))


def split_equations(
    a: Int64, b: Int64, num_keypoints: int, max_equations: int = _MAX_EQUATIONS
) -> list[Int64]:
    """Split the equations of keypoint shifts into independent systems of limited size.

    Equations of different tracks share no keypoint. A track is never split.

    Args:
        a: (m,) keypoint index in view a of each aligned patch pair.
        b: (m,) keypoint index in view b of each aligned patch pair.
        num_keypoints: Number of keypoints of all images.
        max_equations: Number of equations up to which they remain one system, and target size of
            the systems.

    Returns:
        Ascending indices of the equations of each system.
    """
    if len(a) <= max_equations:
        return [np.arange(len(a))]
    edges = coo_array((np.ones(len(a), np.bool_), (a, b)), shape=(num_keypoints, num_keypoints))
    track_of = connected_components(edges, directed=False)[1][a]
    system_of_track = np.cumsum(np.bincount(track_of)) // max_equations
    system_of = system_of_track[track_of]
    order = np.argsort(system_of, kind="stable")
    return np.split(order, np.flatnonzero(np.diff(system_of[order])) + 1)


def solve_shifts(
    std: Float64, a: Int64, b: Int64, warp: Float64, offset: Float64, information: Float64
) -> Float64:
    """Solve for the shifts of all keypoints by IRLS with a Cauchy loss.

    Args:
        std: (n,) standard deviations of the detected keypoints.
        a: (m,) keypoint index in view a of each aligned patch pair.
        b: (m,) keypoint index in view b of each aligned patch pair.
        warp: (m, 2, 2) affine warps from view a to view b.
        offset: (m, 2) measured offsets ``shift_b - warp @ shift_a`` in pixels of view b.
        information: (m, 2, 2) inverse covariances of the offsets, in pixels^-2.

    Returns:
        (n, 2) keypoint shifts in pixels, zero for keypoints without aligned patch.
    """
    scale = _CAUCHY_SCALE * std[b]
    used, position = np.unique(np.concatenate([a, b]), return_inverse=True)
    a, b = position[: len(a)], position[len(a) :]
    prior = np.repeat(std[used] ** -2.0, 2)
    solution = np.zeros((len(used), 2))
    for _ in range(_NUM_REWEIGHTINGS):
        residual = solution[b] - np.einsum("mij,mj->mi", warp, solution[a]) - offset
        robust_weight = 1 / (1 + (residual**2).sum(axis=1) / scale**2)
        weight = information * robust_weight[:, None, None]
        warp_weight = warp.transpose(0, 2, 1) @ weight
        blocks = [(b, b, weight), (a, a, warp_weight @ warp), (a, b, -warp_weight)]
        blocks.append((b, a, -warp_weight.transpose(0, 2, 1)))
        gradient = np.zeros((len(used), 2))
        np.add.at(gradient, b, np.einsum("mij,mj->mi", weight, offset))
        np.add.at(gradient, a, -np.einsum("mij,mj->mi", warp_weight, offset))
        matrix = _block_matrix(blocks, len(used))
        matrix.setdiag(matrix.diagonal() + prior)
        factor = splu(matrix, options={"SymmetricMode": True})
        solution = factor.solve(gradient.ravel()).reshape(-1, 2)
    shifts = np.zeros((len(std), 2))
    shifts[used] = solution
    return shifts


def _block_matrix(blocks: list[tuple[Int64, Int64, Float64]], count: int) -> Any:
    """Sum 2 x 2 blocks (block rows, block columns, values (m, 2, 2)) into a sparse matrix."""
    two = np.arange(2)
    rows = [np.broadcast_to(2 * r[:, None, None] + two[:, None], m.shape) for r, _, m in blocks]
    columns = [np.broadcast_to(2 * c[:, None, None] + two, m.shape) for _, c, m in blocks]
    values = np.concatenate([m.ravel() for _, _, m in blocks])
    at = tuple(np.concatenate([part.ravel() for part in parts]) for parts in (rows, columns))
    return csc_matrix((values, at), shape=(2 * count, 2 * count))


def _invert(matrices: Float64) -> Float64:
    """Invert matrices (m, 2, 2); singular matrices give the identity."""
    is_regular = np.abs(np.linalg.det(matrices)) > 1e-12
    inverse: Float64 = np.linalg.inv(np.where(is_regular[:, None, None], matrices, np.eye(2)))
    return inverse
