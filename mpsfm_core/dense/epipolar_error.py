"""How far poses are off, in pixels, as the photos themselves show.

A pixel with its depth lies in another view on a line, wherever its depth. What the patch around it
lies beside that line is an error of the poses, and nothing else is as large. Along the line poses
are off as much, but there depth gives way: two views of the same pair agree on the wrong depth.
Where few patches are found at all, two views hardly show the same.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from mpsfm_core.data import Bool, Float32, Float64
from mpsfm_core.dense.dense_view import DenseView
from mpsfm_core.geometry.patch_alignment import align_patches
from mpsfm_core.geometry.statistics import ONE_SIGMA

PATCHES = 100
"""Of a photo that are looked for in each other one (ours)."""
RADIUS = 7
"""Of a patch, pixels of the map; what lies further off is not found (ours)."""
MIN_CORRELATION = 0.8
"""Of patches that show the same (ours)."""
_NOISE_PX = 1.5
"""Within which noise of a reduced photo hangs together."""
_STEP = 1e-2
"""Of log depth, that tells the direction of the line."""


class PatchOffsets(NamedTuple):
    """Patches of a photo, looked for in another one.

    ``beside_lines``: (n,) float64, pixels of the other map, of those that were found. ``found``:
    their share, 0 to 1.
    """

    beside_lines: Float64
    found: float


def estimate_pose_error_px(pairs: Iterable[PatchOffsets]) -> float:
    """Std of the offsets beside the lines of a photo's pairs; 0 where no patch tells."""
    offsets = np.abs(np.concatenate([np.zeros(0), *(pair.beside_lines for pair in pairs)]))
    return float(np.quantile(offsets, ONE_SIGMA)) if len(offsets) else 0.0


def measure_patch_offsets(
    view: DenseView, log_depth: Float32, other: DenseView, which: Bool
) -> PatchOffsets:
    """Look for patches of the ``view``, evenly spread over ``which`` (h, w), where their
    ``log_depth`` (h, w) puts them in the ``other`` one."""
    rows, columns = np.nonzero(which)
    chosen = np.linspace(0, len(rows) - 1, min(PATCHES, len(rows))).astype(np.int64)
    rows, columns = rows[chosen], columns[chosen]
    xy = np.stack([columns, rows], axis=1).astype(np.float64) + 0.5
    depth: Float64 = np.exp(log_depth[rows, columns].astype(np.float64))
    turned, shift = other.pixels_from(view)

    def seen(pixels: Float64, depths: Float64) -> Float64:
        place = depths[:, None] * (pixels @ turned[:, :2].T + turned[:, 2]) + shift
        at: Float64 = place[:, :2] / place[:, 2:]
        return at

    at = seen(xy, depth)
    warp = np.stack([seen(xy + step, depth) - at for step in np.eye(2)], axis=2)
    along = seen(xy, depth * np.exp(_STEP)) - at
    length = np.linalg.norm(along, axis=1)
    found = align_patches(view.grey, other.grey, xy, at, warp, RADIUS, _NOISE_PX)
    near = np.linalg.norm(found.shift, axis=1) < RADIUS
    tells = (found.correlation > MIN_CORRELATION) & near & (length > 0)
    x, y = found.shift[tells].T
    beside = (y * along[tells, 0] - x * along[tells, 1]) / length[tells]
    return PatchOffsets(beside, len(beside) / max(len(chosen), 1))
