"""Known depth where nothing was measured, moved as the measured depth beside it says.

Two things are known there. The ratio of known to true depth is much the same at neighbours, and
about 1. And surfaces are flat: inverse depth is linear in the image on a plane. How far either
holds differs between networks and photos, and what was measured tells: the one by how far known
depth is off there, the other by how much measured surfaces bend. Both are linear in the ratio, and
so is what was measured: one sparse least squares.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.sparse import csr_array, diags_array, eye_array, kron, vstack
from scipy.sparse.linalg import splu

from mpsfm_core.data import Bool, Float32, Float64
from mpsfm_core.geometry.statistics import ONE_SIGMA

_FARTHEST = 1.0
"""Of log depth that a map is moved at most: planes reach beyond infinity (ours; none came so far
on rendered_kitchen)."""


class MeasuredCorrection(NamedTuple):
    """What was measured, on a coarse grid (h, w).

    ``change``: of log depth, from what was known. ``precision``: 1 / variance, 0 where nothing was
    measured.
    """

    change: Float32
    precision: Float32


class PlanarityPrior(NamedTuple):
    """What is known of second differences of inverse depth, relative to it.

    ``bends`` (m, n): of a grid of n pixels, applied to its ratios of known to true depth.
    ``weight`` (m,): 1 / variance.
    """

    bends: csr_array
    weight: Float64


def estimate_planarity(
    log_depth: Float32, hole: Bool, found: MeasuredCorrection, least: float
) -> PlanarityPrior:
    """How flat the surfaces of a photo are.

    ``log_depth``: (h, w), what was known; in each ``hole`` it is what was known around. ``found``:
    what was measured. ``least``: the smallest std of log depth.
    The std is that of measured bends. Where the known map bends as much there may be an edge: half
    the weight. At the rim of a hole it tells nothing of edges, and where nothing was measured
    nothing is known to be flat.
    """
    second = _second_differences(*log_depth.shape)
    inverse = np.exp(-log_depth.astype(np.float64)).ravel()
    size = abs(second)
    relative = size.sum(axis=1) / (size @ inverse)
    bends = csr_array(diags_array(relative) @ second @ diags_array(inverse))
    inside = size @ (found.precision.ravel() == 0).astype(np.float64) == 0
    if not inside.any():
        return PlanarityPrior(bends, np.zeros(len(relative)))
    measured = (bends @ np.exp(-found.change.astype(np.float64)).ravel())[inside]
    std = max(float(np.quantile(np.abs(measured), ONE_SIGMA)), least)
    known = bends @ np.ones(len(inverse))
    holes = size @ hole.ravel().astype(np.float64)
    alike = (holes == 0) | (holes == size.sum(axis=1))
    return PlanarityPrior(bends, alike / (std**2 + known**2))


def solve_depth_correction(
    field: tuple[Float32, Float32, Float32], flat: PlanarityPrior, found: MeasuredCorrection
) -> Float32:
    """By how much known log depth is moved, (h, w).

    ``field``: the ratio as a Markov random field, couplings (east, south) of a pixel with its
    neighbours, and with 1. ``flat``: of the photo. ``found``: what was measured.
    """
    height, width = found.change.shape
    east, south, mass = (each.astype(np.float64) for each in field)
    across = kron(eye_array(height), _differences(width))
    down = kron(_differences(height), eye_array(width))
    ratio = np.exp(-found.change.astype(np.float64)).ravel()
    told = found.precision.ravel() / ratio**2
    matrix = (
        across.T @ diags_array(east[:, :-1].ravel()) @ across
        + down.T @ diags_array(south[:-1].ravel()) @ down
        + flat.bends.T @ diags_array(flat.weight) @ flat.bends
        + diags_array(told + mass.ravel())
    )
    factors = splu(
        matrix.tocsc(),
        permc_spec="MMD_AT_PLUS_A",
        diag_pivot_thresh=0.0,
        options={"SymmetricMode": True},
    )
    solved = factors.solve(told * ratio + mass.ravel()).reshape(height, width)
    farthest = np.exp(_FARTHEST)
    moved: Float32 = -np.log(np.clip(solved, 1 / farthest, farthest)).astype(np.float32)
    return moved


def _differences(n: int) -> csr_array:
    """Of neighbours, (n - 1, n)."""
    return csr_array(eye_array(n - 1, n, k=1) - eye_array(n - 1, n))


def _second_differences(height: int, width: int) -> csr_array:
    """Along rows, along columns and of both, (m, n) of a grid of n pixels: the sum of their squares
    is the same whichever way a surface bends."""
    down, across = _differences(height), _differences(width)
    rows = kron(eye_array(height), _differences(width - 1) @ across)
    columns = kron(_differences(height - 1) @ down, eye_array(width))
    return csr_array(vstack([rows, columns, np.sqrt(2) * kron(down, across)]))
