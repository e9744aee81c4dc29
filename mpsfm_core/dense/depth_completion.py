"""Depth completion, which corrects refined depth at pixels without stereo depth.

Two assumptions constrain the depth of a pixel without stereo depth. The first assumption is that
the ratio of input depth to true depth is smooth and close to 1. The second assumption is that
surfaces are planar, so that inverse depth is linear in the image. The variances of the smoothness
and the planarity assumption are estimated at pixels with stereo depth. The smoothness and the
planarity assumption are linear in the ratio of input to true depth, so completion is a sparse
linear least-squares problem.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.sparse import csr_array, diags_array, eye_array, kron, vstack
from scipy.sparse.linalg import splu

from mpsfm_core.data import Bool, Float32, Float64
from mpsfm_core.geometry.statistics import ONE_SIGMA

_MAX_CORRECTION = 1.0
"""Maximum correction of log depth, because extrapolated planes can reach infinite depth [ours]."""


class MeasuredCorrection(NamedTuple):
    """Log depth corrections of the refined depth map from stereo, on a coarse grid."""

    change: Float32
    """(h, w) log of stereo depth minus log of input depth."""
    precision: Float32
    """(h, w) inverse variance of each log depth correction, 0 at pixels without stereo depth."""


class PlanarityPrior(NamedTuple):
    """Gaussian prior for planar surfaces, on relative second differences of inverse depth."""

    bends: csr_array
    """(m, n) matrix that maps n ratios of input to true depth to m relative second differences of
    inverse depth."""
    weight: Float64
    """(m,) inverse variance of each relative second difference of inverse depth."""


def estimate_planarity(
    log_depth: Float32, hole: Bool, correction: MeasuredCorrection, min_std: float
) -> PlanarityPrior:
    """Estimate the weights of the planarity prior from the stereo depth of an image.

    The prior std of second differences is estimated from the stereo depth. If the second difference
    of input depth at a pixel equals the prior std, a depth edge is likely and the planarity weight
    is halved. Depth edges at the rim of a hole cannot be detected, so the planarity weight at the
    rim is 0. Without stereo depth all planarity weights are 0.

    Args:
        log_depth: (h, w) log of input depth, with holes filled from neighboring pixels.
        hole: (h, w) mask of pixels without input depth.
        correction: Corrections of log depth by stereo, at the pixels of the input depth.
        min_std: Minimum std of log depth.
    """
    second = _second_differences(*log_depth.shape)
    inverse = np.exp(-log_depth.astype(np.float64)).ravel()
    size = abs(second)
    relative = size.sum(axis=1) / (size @ inverse)
    bends = csr_array(diags_array(relative) @ second @ diags_array(inverse))
    measured = size @ (correction.precision.ravel() == 0).astype(np.float64) == 0
    if not measured.any():
        return PlanarityPrior(bends, np.zeros(len(relative)))
    measured_bends = (bends @ np.exp(-correction.change.astype(np.float64)).ravel())[measured]
    std = max(float(np.quantile(np.abs(measured_bends), ONE_SIGMA)), min_std)
    known_bends = bends @ np.ones(len(inverse))
    hole_weight = size @ hole.ravel().astype(np.float64)
    not_at_rim = (hole_weight == 0) | (hole_weight == size.sum(axis=1))
    return PlanarityPrior(bends, not_at_rim / (std**2 + known_bends**2))


def solve_depth_correction(
    field: tuple[Float32, Float32, Float32], planarity: PlanarityPrior, measured: MeasuredCorrection
) -> Float32:
    """Solve for the correction of the log of input depth at every pixel.

    Args:
        field: Three precision maps (h, w) of the Gaussian Markov random field of the ratio of input
            to true depth. The maps are the precisions of three quantities: the difference between
            a pixel's depth ratio and the ratio at its right neighbor, the difference to the ratio
            at its lower neighbor, and the deviation of the depth ratio from 1.
        planarity: Planarity prior of the image from :func:`estimate_planarity`.
        measured: Corrections of log depth by stereo.

    Returns:
        (h, w) correction of the log of input depth.
    """
    height, width = measured.change.shape
    east, south, mass = (each.astype(np.float64) for each in field)
    across = kron(eye_array(height), _differences(width))
    down = kron(_differences(height), eye_array(width))
    ratio = np.exp(-measured.change.astype(np.float64)).ravel()
    ratio_precision = measured.precision.ravel() / ratio**2
    matrix = (
        across.T @ diags_array(east[:, :-1].ravel()) @ across
        + down.T @ diags_array(south[:-1].ravel()) @ down
        + planarity.bends.T @ diags_array(planarity.weight) @ planarity.bends
        + diags_array(ratio_precision + mass.ravel())
    )
    factors = splu(
        matrix.tocsc(),
        permc_spec="MMD_AT_PLUS_A",
        diag_pivot_thresh=0.0,
        options={"SymmetricMode": True},
    )
    solved = factors.solve(ratio_precision * ratio + mass.ravel()).reshape(height, width)
    max_ratio = np.exp(_MAX_CORRECTION)
    correction: Float32 = -np.log(np.clip(solved, 1 / max_ratio, max_ratio)).astype(np.float32)
    return correction


def _differences(n: int) -> csr_array:
    """Build the matrix (n - 1, n) of forward differences of n values."""
    return csr_array(eye_array(n - 1, n, k=1) - eye_array(n - 1, n))


def _second_differences(height: int, width: int) -> csr_array:
    """Build the matrix (m, n) of all second differences of a map with n pixels.

    Mixed differences have the weight sqrt(2), so that the sum of squares is rotation invariant
    (Frobenius norm of the Hessian).
    """
    down, across = _differences(height), _differences(width)
    rows = kron(eye_array(height), _differences(width - 1) @ across)
    columns = kron(_differences(height - 1) @ down, eye_array(width))
    return csr_array(vstack([rows, columns, np.sqrt(2) * kron(down, across)]))
