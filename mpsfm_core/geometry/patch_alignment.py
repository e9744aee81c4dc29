"""Subpixel patch alignment by inverse compositional Lucas-Kanade.

The algorithm is from Baker and Matthews, "Lucas-Kanade 20 Years On" (IJCV 2004). Image gradients
and the Hessian are computed once, from the template patch. A Gaussian window weights the pixels of
the patch. The residual is invariant to changes of brightness and contrast. The warp model is a
translation in the first iterations and an affine map afterwards.
"""

# mypy: allow-untyped-decorators

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from mpsfm_core.data import Float32, Float64
from mpsfm_core.support.jit import helper, kernel

WINDOW_STD_RATIO = 0.6
"""Std of the Gaussian window relative to the radius of the patch [ours]."""
_MAX_ITERATIONS = 12
"""Maximum number of Gauss-Newton iterations for each warp model."""
_CONVERGENCE_PX = 0.1, 0.01
"""Step sizes in pixels below which the translation and the affine warp have converged."""
_DAMPING = 0.01
"""Levenberg damping of the affine parameters, relative to the diagonal of the Hessian [ours]."""
_REGULARIZATION = 1e-9
"""Constant added to the diagonal of the Hessian, which makes the Hessian invertible."""
_NUM_TRANSLATION = 2
"""Number of parameters of a translation."""
_NUM_AFFINE = 6
"""Number of parameters of an affine warp."""
_DERIVATIVES = 2
"""Index of the first derivative among the 8 columns of a template patch's basis."""
_MIN_CONTRAST = 1e-3
"""Minimum std of gray values in a patch with enough texture."""


class PatchAlignment(NamedTuple):
    """Result of the alignment of n patches."""

    shift: Float64
    """(n, 2) shifts from initial to aligned positions in pixels of the searched image."""
    warp: Float64
    """(n, 2, 2) linear part of the affine warp from the template to the searched image."""
    correlation: Float64
    """(n,) normalized cross-correlation (NCC) of the aligned patches, -1 if alignment failed."""
    covariance: Float64
    """(n, 2, 2) covariance of each shift due to image noise, in pixels^2."""


def align_patches(
    template: Float32,
    searched: Float32,
    template_xy: Float64,
    searched_xy: Float64,
    warp: Float64,
    radius: int,
    correlation_length: float,
) -> PatchAlignment:
    """Align patches of a template image to a searched image.

    Args:
        template: (h, w) gray values of the image that contains the template patches.
        searched: (h, w) gray values of the searched image.
        template_xy: (n, 2) centers of the template patches, COLMAP pixels.
        searched_xy: (n, 2) initial positions in the searched image, COLMAP pixels.
        warp: (n, 2, 2) initial affine warps from the template to the searched image.
        radius: Radius of the round patch in pixels of the template.
        correlation_length: Correlation length of image noise in pixels of the template.
    """
    offsets, window = _sample_patch(radius)
    # Effective number of independent noise samples in a patch; each sample represents two pixels.
    num_independent = 1.0 / ((window**2).sum() / 2 * correlation_length**2)
    return PatchAlignment(
        *_align(
            template,
            searched,
            template_xy - 0.5,
            searched_xy - 0.5,
            np.ascontiguousarray(warp, dtype=np.float64),
            radius,
            offsets,
            window,
            max(1.0, num_independent),
        )
    )


def _sample_patch(radius: int) -> tuple[Float64, Float64]:
    """Return pixel offsets (q, 2) and Gaussian weights (q,) of the samples of a round patch.

    The samples are every second pixel of the patch in a checkerboard pattern, which suffices for
    smooth images.
    """
    line = np.arange(-radius, radius + 1, dtype=np.float64)
    x, y = (grid.ravel() for grid in np.meshgrid(line, line))
    sampled = ((x + y) % 2 == 0) & (np.hypot(x, y) <= radius)
    offsets = np.stack([x[sampled], y[sampled]], axis=1)
    window = np.exp(-0.5 * (offsets**2).sum(axis=1) / (WINDOW_STD_RATIO * radius) ** 2)
    return offsets, window / window.sum()


@kernel()
def _align(
    template: Float32,
    searched: Float32,
    template_xy: Float64,
    searched_xy: Float64,
    warps: Float64,
    radius: int,
    offsets: Float64,
    window: Float64,
    num_independent: float,
) -> tuple[Float64, Float64, Float64, Float64]:
    """Align each patch and return the fields of :class:`PatchAlignment`."""
    count = len(template_xy)
    shifts = np.zeros((count, 2))
    refined_warps = np.zeros((count, 2, 2))
    correlations = np.full(count, -1.0)
    covariances = np.zeros((count, 2, 2))
    basis = np.empty((len(window), _DERIVATIVES + _NUM_AFFINE))
    hessian = np.empty((_NUM_AFFINE, _NUM_AFFINE))
    inverse = np.empty((_NUM_AFFINE, _NUM_AFFINE))
    gradient = np.empty(_NUM_AFFINE)
    step = np.empty(_NUM_AFFINE)
    for n in range(count):
        if not _derive(template, template_xy[n], radius, offsets, window, basis, hessian):
            continue
        warp, at = refined_warps[n], searched_xy[n].copy()
        for i in range(2):
            for j in range(2):
                warp[i, j] = warps[n, i, j]
        parameters, iteration, invert_hessian = _NUM_TRANSLATION, 0, True
        correlation = 1.0
        while correlation >= 0.0:
            correlation = _compare(searched, at, warp, radius, offsets, basis, gradient)
            if iteration == _MAX_ITERATIONS and parameters == _NUM_AFFINE:
                break
            if invert_hessian:
                _invert(hessian, parameters, inverse)
                invert_hessian = False
            _solve(inverse, gradient, parameters, radius, step)
            _compose(warp, at, step)
            iteration += 1
            if math.hypot(step[0], step[1]) < _CONVERGENCE_PX[int(parameters == _NUM_AFFINE)]:
                iteration = _MAX_ITERATIONS
            if iteration == _MAX_ITERATIONS and parameters == _NUM_TRANSLATION:
                parameters, iteration, invert_hessian = _NUM_AFFINE, 0, True
        if correlation < 0.0:
            continue
        correlations[n] = correlation
        # Marginal covariance of the translation in the template, transformed to the searched image
        # by the warp.
        noise = 2.0 * (1.0 - correlation) / num_independent
        for i in range(2):
            shifts[n, i] = at[i] - searched_xy[n, i]
            for j in range(2):
                for k in range(2):
                    for m in range(2):
                        moved = warp[i, k] * inverse[k, m] * warp[j, m]
                        covariances[n, i, j] += noise * moved
    return shifts, refined_warps, correlations, covariances


@helper()
def _bilinear(image: Float32, x: float, y: float) -> float:
    """Interpolate an image bilinearly at array coordinates (x, y)."""
    column, row = int(x), int(y)
    right, down = x - column, y - row
    above = image[row, column] * (1.0 - right) + image[row, column + 1] * right
    below = image[row + 1, column] * (1.0 - right) + image[row + 1, column + 1] * right
    value: float = above * (1.0 - down) + below * down
    return value


@helper()
def _inside(image: Float32, x: float, y: float, reach_x: float, reach_y: float) -> bool:
    """Return whether bilinear interpolation is possible in a box around (x, y), False for NaN."""
    fits_x = x - reach_x >= 0.0 and x + reach_x < image.shape[1] - 1
    return fits_x and y - reach_y >= 0.0 and y + reach_y < image.shape[0] - 1


@helper()
def _derive(
    image: Float32,
    at: Float64,
    radius: int,
    offsets: Float64,
    window: Float64,
    basis: Float64,
    hessian: Float64,
) -> bool:
    """Compute the basis and the Hessian of a template patch.

    The 8 columns of the basis are the window weights, the weighted normalized template, and the
    weighted derivatives by 2 translation and 4 affine parameters. Pixel offsets in the affine
    derivatives are divided by the radius of the patch. The weighted derivatives are orthogonal to
    changes of brightness and contrast of the patch.

    Args:
        image: (h, w) gray values of the template image.
        at: (2,) center of the patch in array coordinates (x, y).
        radius: Radius of the template patch in pixels.
        offsets: (q, 2) samples.
        window: (q,) weights.
        basis: (q, 8), written.
        hessian: (6, 6), written.

    Returns:
        False if the template patch exceeds the image or has no contrast.
    """
    if not _inside(image, at[0], at[1], radius + 1.0, radius + 1.0):
        return False
    mean, square = 0.0, 0.0
    for q in range(len(window)):
        x, y = at[0] + offsets[q, 0], at[1] + offsets[q, 1]
        value = _bilinear(image, x, y)
        mean += window[q] * value
        square += window[q] * value * value
        basis[q, 1] = value
        basis[q, 2] = 0.5 * (_bilinear(image, x + 1.0, y) - _bilinear(image, x - 1.0, y))
        basis[q, 3] = 0.5 * (_bilinear(image, x, y + 1.0) - _bilinear(image, x, y - 1.0))
    variance = square - mean * mean
    if not variance > _MIN_CONTRAST**2:
        return False
    scale = 1.0 / math.sqrt(variance)
    means, along = np.zeros(_NUM_AFFINE), np.zeros(_NUM_AFFINE)
    for q in range(len(window)):
        weight, value = window[q], (basis[q, 1] - mean) * scale
        dx, dy = offsets[q, 0] / radius, offsets[q, 1] / radius
        gx, gy = basis[q, 2] * scale, basis[q, 3] * scale
        basis[q, 0], basis[q, 1] = weight, weight * value
        gradient = basis[q, _DERIVATIVES:]
        gradient[0], gradient[1] = gx, gy
        gradient[2], gradient[3] = gx * dx, gx * dy
        gradient[4], gradient[5] = gy * dx, gy * dy
        for k in range(_NUM_AFFINE):
            means[k] += weight * gradient[k]
            along[k] += weight * value * gradient[k]
    hessian[:] = 0.0
    for q in range(len(window)):
        gradient, weight = basis[q, _DERIVATIVES:], window[q]
        for i in range(_NUM_AFFINE):
            gradient[i] -= means[i] + along[i] * basis[q, 1] / weight
            for j in range(i + 1):
                hessian[i, j] += weight * gradient[i] * gradient[j]
        for i in range(_NUM_AFFINE):
            gradient[i] *= weight
    for i in range(_NUM_AFFINE):
        for j in range(i):
            hessian[j, i] = hessian[i, j]
    return True


@helper()
def _compare(
    image: Float32,
    at: Float64,
    warp: Float64,
    radius: int,
    offsets: Float64,
    basis: Float64,
    gradient: Float64,
) -> float:
    """Compute the NCC of the template with a warped patch of another image.

    Args:
        image: (h, w) gray values of the searched image.
        at: (2,) center of the patch in array coordinates (x, y).
        warp: (2, 2) linear part of the affine warp from the template to the searched image.
        radius: Radius of the template patch in pixels.
        offsets: (q, 2) samples.
        basis: (q, 8) basis of the template patch from :func:`_derive`.
        gradient: (6,) output, products of the template's derivatives with the searched patch.

    Returns:
        The NCC, or -1 if the warped patch exceeds the image or has no contrast.
    """
    reach_x = radius * math.hypot(warp[0, 0], warp[0, 1])
    reach_y = radius * math.hypot(warp[1, 0], warp[1, 1])
    if not _inside(image, at[0], at[1], reach_x, reach_y):
        return -1.0
    mean, square, product = 0.0, 0.0, 0.0
    s0, s1, s2, s3, s4, s5 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0  # registers, not memory
    for q in range(len(basis)):
        dx, dy = offsets[q, 0], offsets[q, 1]
        x = at[0] + warp[0, 0] * dx + warp[0, 1] * dy
        y = at[1] + warp[1, 0] * dx + warp[1, 1] * dy
        value = _bilinear(image, x, y)
        mean += value * basis[q, 0]
        square += value * value * basis[q, 0]
        product += value * basis[q, 1]
        s0 += value * basis[q, 2]
        s1 += value * basis[q, 3]
        s2 += value * basis[q, 4]
        s3 += value * basis[q, 5]
        s4 += value * basis[q, 6]
        s5 += value * basis[q, 7]
    variance = square - mean * mean
    if not variance > _MIN_CONTRAST**2:
        return -1.0
    scale = 1.0 / math.sqrt(variance)
    gradient[0], gradient[1], gradient[2] = s0 * scale, s1 * scale, s2 * scale
    gradient[3], gradient[4], gradient[5] = s3 * scale, s4 * scale, s5 * scale
    return product * scale


@helper()
def _invert(matrix: Float64, size: int, inverse: Float64) -> None:
    """Invert the leading block of a damped Hessian by Gauss-Jordan elimination."""
    for i in range(size):
        for j in range(size):
            inverse[i, j] = matrix[i, j]
        inverse[i, i] += _REGULARIZATION
        if i >= _NUM_TRANSLATION:
            inverse[i, i] *= 1.0 + _DAMPING
    for k in range(size):
        pivot = 1.0 / inverse[k, k]
        inverse[k, k] = 1.0
        for j in range(size):
            inverse[k, j] *= pivot
        for i in range(size):
            if i != k:
                factor = inverse[i, k]
                inverse[i, k] = 0.0
                for j in range(size):
                    inverse[i, j] -= factor * inverse[k, j]


@helper()
def _solve(
    inverse: Float64, gradient: Float64, parameters: int, radius: int, step: Float64
) -> None:
    """Solve for the Gauss-Newton step of the warp parameters."""
    step[:] = 0.0
    for i in range(parameters):
        for j in range(parameters):
            step[i] += inverse[i, j] * gradient[j]
        if i >= _NUM_TRANSLATION:
            step[i] /= radius


@helper()
def _compose(warp: Float64, at: Float64, step: Float64) -> None:
    """Update a warp by composition with the inverse of a Gauss-Newton step."""
    a, b, c, d = 1.0 + step[2], step[3], step[4], 1.0 + step[5]
    determinant = a * d - b * c
    w00 = (warp[0, 0] * d - warp[0, 1] * c) / determinant
    w01 = (warp[0, 1] * a - warp[0, 0] * b) / determinant
    w10 = (warp[1, 0] * d - warp[1, 1] * c) / determinant
    w11 = (warp[1, 1] * a - warp[1, 0] * b) / determinant
    warp[0, 0], warp[0, 1], warp[1, 0], warp[1, 1] = w00, w01, w10, w11
    at[0] -= w00 * step[0] + w01 * step[1]
    at[1] -= w10 * step[0] + w11 * step[1]
