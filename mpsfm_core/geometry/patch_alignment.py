"""Where patches of one image lie in another, to a fraction of a pixel.

Lucas and Kanade's alignment in its inverse compositional form (Baker and Matthews, Lucas-Kanade 20
Years On, IJCV 2004): gradients and Hessian are the template's and are made once. Patches are
weighed by a Gaussian and compared without their mean and contrast, so that brightness and gain do
not matter. The warp is a translation first, then affine.
"""

# mypy: allow-untyped-decorators

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from mpsfm_core.data import Float32, Float64
from mpsfm_core.support.jit import helper, kernel

WINDOW = 0.6
"""Std of the Gaussian window in terms of the patch's radius (ours)."""
_ROUNDS = 12
"""Of each of the two warps, at most."""
_CONVERGED_PX = 0.1, 0.01
"""Steps after which the two are near enough."""
_DAMPING = 0.01
"""Of the affine part, relative to its Hessian's diagonal (ours)."""
_REGULAR = 1e-9
"""Added to the diagonal of a Hessian, of intensities of unit contrast per pixel."""
_TRANSLATION = 2
_AFFINE = 6
_FIRST = 2
"""Place of the derivatives in a basis."""
_FLAT = 1e-3
"""Grey levels: a patch of smaller contrast shows nothing."""


class Alignment(NamedTuple):
    """Of n patches. ``shift``: (n, 2), from where the patch was looked for to where it lies.
    ``warp``: (n, 2, 2), offsets in the template to offsets in the other image. ``correlation``:
    (n,), -1 where a patch could not be compared. ``covariance``: (n, 2, 2) of the shift, pixels^2,
    for the noise that is left between the patches."""

    shift: Float64
    warp: Float64
    correlation: Float64
    covariance: Float64


def align_patches(
    template: Float32,
    searched: Float32,
    in_template: Float64,
    in_searched: Float64,
    warp: Float64,
    radius: int,
    correlation_length: float,
) -> Alignment:
    """Find patches of ``template`` (h, w) in ``searched`` (h, w), both grey.

    Args:
        in_template, in_searched: (n, 2) centres of the patches and where to look for them, COLMAP
            pixels (centres of pixels at .5).
        warp: (n, 2, 2) offsets in the template to offsets in the other image, to begin with.
        radius: of the round patch, pixels of the template.
        correlation_length: pixels of the template within which noise of the images hangs together.
    """
    offsets, window = _samples(radius)
    # Samples stand for two pixels each; weights of independent ones would sum up so.
    independent = 1.0 / ((window**2).sum() / 2 * correlation_length**2)
    return Alignment(
        *_align(
            template,
            searched,
            in_template - 0.5,
            in_searched - 0.5,
            np.ascontiguousarray(warp, dtype=np.float64),
            radius,
            offsets,
            window,
            max(1.0, independent),
        )
    )


def _samples(radius: int) -> tuple[Float64, Float64]:
    """Pixels of a round patch from its centre (q, 2), and their weights. Every other one, like the
    black fields of a chessboard: smooth images have nothing more to say in between."""
    line = np.arange(-radius, radius + 1, dtype=np.float64)
    x, y = (each.ravel() for each in np.meshgrid(line, line))
    chosen = ((x + y) % 2 == 0) & (np.hypot(x, y) <= radius)
    offsets = np.stack([x[chosen], y[chosen]], axis=1)
    window = np.exp(-0.5 * (offsets**2).sum(axis=1) / (WINDOW * radius) ** 2)
    return offsets, window / window.sum()


@kernel()
def _align(
    template: Float32,
    searched: Float32,
    in_template: Float64,
    in_searched: Float64,
    warps: Float64,
    radius: int,
    offsets: Float64,
    window: Float64,
    independent: float,
) -> tuple[Float64, Float64, Float64, Float64]:
    count = len(in_template)
    shifts = np.zeros((count, 2))
    found = np.zeros((count, 2, 2))
    correlations = np.full(count, -1.0)
    covariances = np.zeros((count, 2, 2))
    basis = np.empty((len(window), _FIRST + _AFFINE))
    hessian = np.empty((_AFFINE, _AFFINE))
    inverse = np.empty((_AFFINE, _AFFINE))
    slopes = np.empty(_AFFINE)
    step = np.empty(_AFFINE)
    for n in range(count):
        if not _derive(template, in_template[n], radius, offsets, window, basis, hessian):
            continue
        warp, at = found[n], in_searched[n].copy()
        warp[:] = warps[n]
        parameters, rounds, fresh = _TRANSLATION, 0, True
        correlation = 1.0
        while correlation >= 0.0:
            correlation = _compare(searched, at, warp, radius, offsets, basis, slopes)
            if rounds == _ROUNDS and parameters == _AFFINE:
                break
            if fresh:
                _invert(hessian, parameters, inverse)
                fresh = False
            _solve(inverse, slopes, parameters, radius, step)
            _compose(warp, at, step)
            rounds += 1
            if math.hypot(step[0], step[1]) < _CONVERGED_PX[int(parameters == _AFFINE)]:
                rounds = _ROUNDS
            if rounds == _ROUNDS and parameters == _TRANSLATION:
                parameters, rounds, fresh = _AFFINE, 0, True
        if correlation < 0.0:
            continue
        correlations[n] = correlation
        # Of the translation in the template, the affine part free; then in the other image.
        noise = 2.0 * (1.0 - correlation) / independent
        for i in range(2):
            shifts[n, i] = at[i] - in_searched[n, i]
            for j in range(2):
                for k in range(2):
                    for m in range(2):
                        moved = warp[i, k] * inverse[k, m] * warp[j, m]
                        covariances[n, i, j] += noise * moved
    return shifts, found, correlations, covariances


@helper()
def _bilinear(image: Float32, x: float, y: float) -> float:
    column, row = int(x), int(y)
    right, down = x - column, y - row
    above = image[row, column] * (1.0 - right) + image[row, column + 1] * right
    below = image[row + 1, column] * (1.0 - right) + image[row + 1, column + 1] * right
    value: float = above * (1.0 - down) + below * down
    return value


@helper()
def _inside(image: Float32, x: float, y: float, reach_x: float, reach_y: float) -> bool:
    """Whether all can be interpolated that is so near to a place; not if that is no number."""
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
    """What another patch is multiplied with, sample by sample: the window, the window times the
    template without its mean and of unit contrast, and the window times the template's derivatives
    by the parameters of a warp, two of a translation and four of an affine map with offsets in
    terms of the radius. What a change of mean and contrast explains is taken out of them. False
    where the template leaves the image or is flat."""
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
    if not variance > _FLAT**2:
        return False
    scale = 1.0 / math.sqrt(variance)
    means, along = np.zeros(_AFFINE), np.zeros(_AFFINE)
    for q in range(len(window)):
        weight, value = window[q], (basis[q, 1] - mean) * scale
        dx, dy = offsets[q, 0] / radius, offsets[q, 1] / radius
        gx, gy = basis[q, 2] * scale, basis[q, 3] * scale
        basis[q, 0], basis[q, 1] = weight, weight * value
        slopes = basis[q, _FIRST:]
        slopes[0], slopes[1] = gx, gy
        slopes[2], slopes[3] = gx * dx, gx * dy
        slopes[4], slopes[5] = gy * dx, gy * dy
        for k in range(_AFFINE):
            means[k] += weight * slopes[k]
            along[k] += weight * value * slopes[k]
    hessian[:] = 0.0
    for q in range(len(window)):
        slopes, weight = basis[q, _FIRST:], window[q]
        for i in range(_AFFINE):
            slopes[i] -= means[i] + along[i] * basis[q, 1] / weight
            for j in range(i + 1):
                hessian[i, j] += weight * slopes[i] * slopes[j]
        for i in range(_AFFINE):
            slopes[i] *= weight
    for i in range(_AFFINE):
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
    slopes: Float64,
) -> float:
    """Correlation of the template with the patch at a place under a warp, -1 where that leaves the
    image or is flat; ``slopes``: products of the template's derivatives and that patch."""
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
    if not variance > _FLAT**2:
        return -1.0
    scale = 1.0 / math.sqrt(variance)
    slopes[0], slopes[1], slopes[2] = s0 * scale, s1 * scale, s2 * scale
    slopes[3], slopes[4], slopes[5] = s3 * scale, s4 * scale, s5 * scale
    return product * scale


@helper()
def _invert(matrix: Float64, size: int, inverse: Float64) -> None:
    """Inverse of the leading block of a Hessian, its affine part damped, into that block of
    ``inverse``; Gauss and Jordan's way, in place."""
    for i in range(size):
        for j in range(size):
            inverse[i, j] = matrix[i, j]
        inverse[i, i] += _REGULAR
        if i >= _TRANSLATION:
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
def _solve(inverse: Float64, slopes: Float64, parameters: int, radius: int, step: Float64) -> None:
    """The warp of the template that explains the difference of the patches best."""
    step[:] = 0.0
    for i in range(parameters):
        for j in range(parameters):
            step[i] += inverse[i, j] * slopes[j]
        if i >= _TRANSLATION:
            step[i] /= radius


@helper()
def _compose(warp: Float64, at: Float64, step: Float64) -> None:
    """The warp after the inverse of a step."""
    a, b, c, d = 1.0 + step[2], step[3], step[4], 1.0 + step[5]
    determinant = a * d - b * c
    w00 = (warp[0, 0] * d - warp[0, 1] * c) / determinant
    w01 = (warp[0, 1] * a - warp[0, 0] * b) / determinant
    w10 = (warp[1, 0] * d - warp[1, 1] * c) / determinant
    w11 = (warp[1, 1] * a - warp[1, 0] * b) / determinant
    warp[0, 0], warp[0, 1], warp[1, 0], warp[1, 1] = w00, w01, w10, w11
    at[0] -= w00 * step[0] + w01 * step[1]
    at[1] -= w10 * step[0] + w11 * step[1]
