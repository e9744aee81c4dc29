"""Keypoint adjustment: where the keypoints of matches lie to a fraction of a pixel.

Learned keypoints are whole pixels of a reduced image, and no detector finds exactly the same spot
of a scene twice. So the patches around each verified match are aligned, and then every keypoint
moves a little, so that it fits all alignments that it is in (Lindenberger et al., Pixel-Perfect
Structure-from-Motion, ICCV 2021, do it with features of a network). Patches are warped to begin
with as a plane would be that faces the camera at the depth of the match.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import cv2
import numpy as np
from scipy.sparse import csc_matrix
from scipy.sparse.linalg import splu

from mpsfm_core.data import Bool, Float32, Float64, Int64, PinholeCamera, UInt8, VerifiedPair
from mpsfm_core.extraction.context import ExtractionContext
from mpsfm_core.extraction.options import AdjustmentOptions
from mpsfm_core.geometry import rays
from mpsfm_core.geometry.patch_alignment import align_patches
from mpsfm_core.support.lru_cache import LruCache

CACHED_BYTES = 256 << 20
"""Of smooth_gray_image images that are kept."""
BLUR_PX = 0.8
"""Std of the Gaussian that images are smoothed by, so that they can be interpolated (ours)."""
_NOISE_PX = float(2 * np.sqrt(np.pi) * BLUR_PX)
"""Within which noise that was smoothed so hangs together."""
_FLOOR = 0.05
"""Std of an alignment at least, in stds of a keypoint: interpolation, and surfaces that are no
planes (ours)."""
_TAIL = 0.3
"""Scale of Cauchy's loss on what an alignment says and the shifts do not, in stds of a keypoint
(ours)."""
_ROUNDS = 3
"""Of reweighted least squares."""
_SINGULAR = 0.05
"""Ratio of areas below which a warp squeezes a patch to nothing."""


@dataclass(frozen=True, eq=False)
class AlignedPair:
    """What the patches of a pair say of the shifts of its keypoints:
    ``shift_b - warp @ shift_a = offset``.

    ``warp`` (m, 2, 2), ``offset`` (m, 2) pixels, ``information`` (m, 2, 2) pixels^-2, all float64,
    in views; ``rows`` (m,) int64: of the matches whose patches are alike.
    """

    rows: Int64
    warp: Float64
    offset: Float64
    information: Float64


_EQUATION = ("warp", "offset", "information")


class AdjustedKeypoints(NamedTuple):
    """Of one image: keypoints (n, 2), and which of them were measured (n,)."""

    keypoints: Float64
    measured: Bool


class PairSide(NamedTuple):
    """One side of a pair: its ``camera``, the smooth_gray_image ``image`` (see :func:`smooth_gray_image`), and the keypoints
    of the matches ``xy`` (m, 2), pixels of the camera, of noise ``std_px``."""

    camera: PinholeCamera
    image: Float32
    xy: Float64
    std_px: float

    @property
    def step(self) -> Float64:
        """(2,) pixels of the smooth_gray_image image in one of the view."""
        return np.array(self.image.shape[::-1]) / (self.camera.width, self.camera.height)


class KeypointAdjuster:
    """Aligns the patches of verified matches on the views of a run.

    ``keypoints`` (n, 2), ``std_px``: of each image, and their noise.
    """

    def __init__(
        self, context: ExtractionContext, keypoints: Sequence[Float64], std_px: Sequence[float]
    ) -> None:
        self._context = context
        self._keypoints = keypoints
        self._std_px = std_px
        self._grey: LruCache[int, Float32] = LruCache(CACHED_BYTES, lambda image: image.nbytes)

    def run(self, pairs: Sequence[VerifiedPair]) -> list[AdjustedKeypoints]:
        """The stage."""
        options = self._context.config.adjustment
        counts = [len(xy) for xy in self._keypoints]
        pairs = select_best_matches(pairs, counts, options.max_alignments)
        aligned = self._context.each("adjustment", pairs, self._aligned)
        return adjust_keypoints(self._keypoints, self._std_px, pairs, aligned, options.max_shift)

    def _aligned(self, pair: VerifiedPair) -> AlignedPair:
        a, b = (
            PairSide(
                self._context.images[index].pinhole,
                self._image(index),
                self._keypoints[index][pair.matches[:, column]],
                self._std_px[index],
            )
            for column, index in enumerate((pair.image_a, pair.image_b))
        )
        options = self._context.config.adjustment
        return align_pair(a, b, pair.rotation, pair.translation, options)

    def _image(self, index: int) -> Float32:
        std_px = self._std_px[index]
        return self._grey.get(
            index, lambda: smooth_gray_image(self._context.view(index).image, std_px)
        )


def select_best_matches(
    pairs: Sequence[VerifiedPair], counts: Sequence[int], most: int
) -> list[VerifiedPair]:
    """The pairs with those matches alone that are among the ``most`` best of one of their
    keypoints; ``counts``: keypoints of each image."""
    if not pairs:
        return []
    a, b = _numbered(pairs, counts)
    match = np.tile(np.arange(len(a)), 2)
    keypoint = np.concatenate([a, b])
    score = np.tile(np.concatenate([pair.scores for pair in pairs]), 2)
    order = np.lexsort((match, -score, keypoint))
    rank = np.arange(len(order)) - np.searchsorted(keypoint[order], keypoint[order])
    best = np.zeros(len(a), dtype=np.bool_)
    best[match[order[rank < most]]] = True
    of_pairs = np.split(best, np.cumsum([len(pair) for pair in pairs])[:-1])
    return [
        replace(pair, matches=pair.matches[rows], scores=pair.scores[rows])
        for pair, rows in zip(pairs, of_pairs, strict=True)
        if rows.any()
    ]


def _numbered(pairs: Sequence[VerifiedPair], counts: Sequence[int]) -> tuple[Int64, Int64]:
    """Keypoints of all matches (m,), on either side, numbered through all images."""
    offsets = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
    a = [offsets[pair.image_a] + pair.matches[:, 0] for pair in pairs]
    b = [offsets[pair.image_b] + pair.matches[:, 1] for pair in pairs]
    return np.concatenate(a), np.concatenate(b)


def smooth_gray_image(rgb: UInt8, std_px: float) -> Float32:
    """A view (h, w, 3) as patches of it are aligned: smooth_gray_image, smooth, and no larger than that its
    keypoints err by a pixel."""
    image: Any = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY).astype(np.float32)
    if std_px > 1:
        size = [max(1, round(length / std_px)) for length in image.shape[::-1]]
        image = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    smooth: Float32 = cv2.GaussianBlur(image, (0, 0), BLUR_PX)
    return smooth


def align_pair(
    a: PairSide, b: PairSide, rotation: Float64, translation: Float64, options: AdjustmentOptions
) -> AlignedPair:
    """Align the patches of a pair's matches; the template is of the image that shows more detail.

    ``rotation`` (3, 3), ``translation`` (3,): ``cam_b_from_cam_a``.
    """
    warp = fronto_parallel_warp(a, b, rotation, translation) * (b.step[:, None] / a.step)
    swapped = bool(np.median(np.linalg.det(warp)) > 1)
    if swapped:
        a, b, warp = b, a, _inverse(warp)
    found = align_patches(
        a.image, b.image, a.xy * a.step, b.xy * b.step, warp, options.radius, _NOISE_PX
    )
    rows = np.flatnonzero(
        (found.correlation >= options.min_correlation)
        & (np.linalg.norm(found.shift, axis=1) <= options.max_shift)
        & (np.abs(np.linalg.det(found.warp)) > _SINGULAR)
    )
    to_view = 1 / b.step
    warp = found.warp[rows] * (to_view[:, None] * a.step)
    offset = found.shift[rows] * to_view
    covariance = found.covariance[rows] * np.outer(to_view, to_view)
    information = _inverse(covariance + (_FLOOR * b.std_px) ** 2 * np.eye(2))
    if swapped:
        information = warp.transpose(0, 2, 1) @ information @ warp
        warp = _inverse(warp)
        offset = -np.einsum("mij,mj->mi", warp, offset)
    return AlignedPair(rows, warp, offset, information)


def fronto_parallel_warp(
    a: PairSide, b: PairSide, rotation: Float64, translation: Float64
) -> Float64:
    """(m, 2, 2) offsets in view a to offsets in view b, of planes through the points that matches
    show, parallel to image a.

    Where rays do not meet in front of both cameras the plane is far away.
    """
    ray_a, ray_b = rays(a.camera, a.xy) @ rotation.T, rays(b.camera, b.xy)
    # The depth z at which z ray_a + translation comes nearest to being parallel to ray_b.
    across, beside = np.cross(ray_b, ray_a), np.cross(ray_b, translation)
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = -(across * beside).sum(axis=1) / (across**2).sum(axis=1)
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
    max_shift: float,
) -> list[AdjustedKeypoints]:
    """Move the keypoints of all images so that they fit the alignments of all pairs.

    A keypoint is expected where it was found, within its ``std_px``; alignments that others
    contradict lose weight (Cauchy's loss). One that would move farther than ``max_shift`` of its
    stds stays, and counts as not measured.
    """
    counts = [len(xy) for xy in keypoints]
    std = np.repeat(np.asarray(std_px, dtype=np.float64), counts)
    shifts, measured = np.zeros((len(std), 2)), np.zeros(len(std), dtype=np.bool_)
    if any(len(found.rows) for found in aligned):
        a, b = _numbered(pairs, counts)
        starts = np.cumsum([0, *map(len, pairs)])
        rows = np.concatenate(
            [start + found.rows for start, found in zip(starts, aligned, strict=False)]
        )
        together = [np.concatenate([getattr(f, name) for f in aligned]) for name in _EQUATION]
        shifts = solve_shifts(std, a[rows], b[rows], *together)
        measured[a[rows]] = measured[b[rows]] = True
    measured &= np.linalg.norm(shifts, axis=1) <= max_shift * std
    moved = np.concatenate(keypoints) + np.where(measured[:, None], shifts, 0.0)
    ends = np.cumsum(counts)[:-1]
    return list(map(AdjustedKeypoints, np.split(moved, ends), np.split(measured, ends)))


def solve_shifts(
    std: Float64, a: Int64, b: Int64, warp: Float64, offset: Float64, information: Float64
) -> Float64:
    """(n, 2) shifts of keypoints of noise ``std`` (n,), from alignments of ``a`` (m,) and ``b``
    (m,) as :class:`AlignedPair` has them."""
    count = len(std)
    scale = _TAIL * std[b]
    used, position = np.unique(np.concatenate([a, b]), return_inverse=True)
    a, b = position[: len(a)], position[len(a) :]
    prior = np.repeat(std[used] ** -2.0, 2)
    found = np.zeros((len(used), 2))
    for _ in range(_ROUNDS):
        left = found[b] - np.einsum("mij,mj->mi", warp, found[a]) - offset
        trust = 1 / (1 + (left**2).sum(axis=1) / scale**2)
        weight = information * trust[:, None, None]
        weighed = warp.transpose(0, 2, 1) @ weight
        blocks = [(b, b, weight), (a, a, weighed @ warp), (a, b, -weighed)]
        blocks.append((b, a, -weighed.transpose(0, 2, 1)))
        right = np.zeros((len(used), 2))
        np.add.at(right, b, np.einsum("mij,mj->mi", weight, offset))
        np.add.at(right, a, -np.einsum("mij,mj->mi", weighed, offset))
        matrix = _block_matrix(blocks, len(used))
        matrix.setdiag(matrix.diagonal() + prior)
        found = splu(matrix, options={"SymmetricMode": True}).solve(right.ravel()).reshape(-1, 2)
    shifts = np.zeros((count, 2))
    shifts[used] = found
    return shifts


def _block_matrix(blocks: list[tuple[Int64, Int64, Float64]], count: int) -> Any:
    """Sum of blocks (row, column, (m, 2, 2)), sparse."""
    two = np.arange(2)
    rows = [np.broadcast_to(2 * r[:, None, None] + two[:, None], m.shape) for r, _, m in blocks]
    columns = [np.broadcast_to(2 * c[:, None, None] + two, m.shape) for _, c, m in blocks]
    values = np.concatenate([m.ravel() for _, _, m in blocks])
    at = tuple(np.concatenate([part.ravel() for part in parts]) for parts in (rows, columns))
    return csc_matrix((values, at), shape=(2 * count, 2 * count))


def _inverse(matrices: Float64) -> Float64:
    """Of (m, 2, 2); the identity for those that have none."""
    safe = np.abs(np.linalg.det(matrices)) > 1e-12
    inverse: Float64 = np.linalg.inv(np.where(safe[:, None, None], matrices, np.eye(2)))
    return inverse
