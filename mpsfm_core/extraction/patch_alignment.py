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
from mpsfm_core.jit import helper, kernel

WINDOW = 0.6
"""Std of the Gaussian window in terms of the patch's radius (ours)."""
_ROUNDS = 12
"""Of each of the two warps, at most."""
_CONVERGED_PX = 0.005
_DAMPING = 0.01
"""Of the affine part, relative to its Hessian's diagonal (ours)."""
_REGULAR = 1e-9
"""Added to the diagonal of a Hessian, of intensities of unit contrast per pixel."""
_TRANSLATION = 2
_AFFINE = 6
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
        radius: of the square patch, pixels of the template.
        correlation_length: pixels of the template within which noise of the images hangs together.
    """
    offsets = np.arange(-radius, radius + 1, dtype=np.float64)
    window = np.exp(-0.5 * (offsets / (WINDOW * radius)) ** 2)
    window /= window.sum()
    independent = 1.0 / ((window**2).sum() * correlation_length) ** 2
    return Alignment(
        *_align(
            template,
            searched,
            in_template - 0.5,
            in_searched - 0.5,
            np.ascontiguousarray(warp, dtype=np.float64),
            np.outer(window, window),
            max(1.0, independent),
        )
    )


@kernel()
def _align(
    template: Float32,
    searched: Float32,
    in_template: Float64,
    in_searched: Float64,
    warps: Float64,
    window: Float64,
    independent: float,
) -> tuple[Float64, Float64, Float64, Float64]:
    count, size = len(in_template), len(window)
    radius = size // 2
    shifts = np.zeros((count, 2))
    found = np.zeros((count, 2, 2))
    correlations = np.full(count, -1.0)
    covariances = np.zeros((count, 2, 2))
    patch = np.empty((size + 2, size + 2))
    other = np.empty((size, size))
    jacobian = np.empty((size, size, _AFFINE))
    hessian = np.empty((_AFFINE, _AFFINE))
    inverse = np.empty((_AFFINE, _AFFINE))
    step = np.empty(_AFFINE)
    for n in range(count):
        x, y = in_template[n, 0], in_template[n, 1]
        left, top = math.floor(x) - radius - 1, math.floor(y) - radius - 1
        if left < 0 or top < 0:
            continue
        if left + size + 2 >= template.shape[1] or top + size + 2 >= template.shape[0]:
            continue
        for row in range(size + 2):
            for column in range(size + 2):
                patch[row, column] = _bilinear(
                    template, x + column - radius - 1, y + row - radius - 1
                )
        if not _prepare(patch, window, jacobian):
            continue
        _hessian(jacobian, window, hessian)
        warp, at = found[n], in_searched[n].copy()
        warp[:] = warps[n]
        parameters, rounds, fresh, correlation = _TRANSLATION, 0, True, 1.0
        while correlation >= 0.0:
            correlation = -1.0
            if _sample(searched, at, warp, other, window):
                correlation = _correlate(patch, other, window)
            if rounds == _ROUNDS and parameters == _AFFINE:
                break
            if fresh:
                _invert(hessian, parameters, inverse)
                fresh = False
            _solve(inverse, jacobian, patch, other, window, parameters, step)
            _compose(warp, at, step)
            rounds += 1
            if math.hypot(step[0], step[1]) < _CONVERGED_PX:
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
def _normalise(values: Float64, border: int, window: Float64) -> bool:
    """Take mean and contrast away, of all that is inside of a border; False where it is flat."""
    size = len(window)
    mean = 0.0
    for row in range(size):
        for column in range(size):
            mean += window[row, column] * values[row + border, column + border]
    variance = 0.0
    for row in range(size):
        for column in range(size):
            variance += window[row, column] * (values[row + border, column + border] - mean) ** 2
    if variance < _FLAT**2:
        return False
    scale = 1.0 / math.sqrt(variance)
    for row in range(len(values)):
        for column in range(len(values)):
            values[row, column] = (values[row, column] - mean) * scale
    return True


@helper()
def _prepare(patch: Float64, window: Float64, jacobian: Float64) -> bool:
    """Normalise the template, and derive it by the parameters of a warp: two of a translation, four
    of an affine map. What a change of mean and contrast explains is not the warp's."""
    if not _normalise(patch, 1, window):
        return False
    size = len(window)
    radius = size // 2
    mean = np.zeros(_AFFINE)
    along = np.zeros(_AFFINE)
    for row in range(size):
        for column in range(size):
            gx = 0.5 * (patch[row + 1, column + 2] - patch[row + 1, column])
            gy = 0.5 * (patch[row + 2, column + 1] - patch[row, column + 1])
            dx, dy = (column - radius) / radius, (row - radius) / radius
            of_pixel = jacobian[row, column]
            of_pixel[0], of_pixel[1] = gx, gy
            of_pixel[2], of_pixel[3] = gx * dx, gx * dy
            of_pixel[4], of_pixel[5] = gy * dx, gy * dy
            weight, value = window[row, column], patch[row + 1, column + 1]
            for k in range(_AFFINE):
                mean[k] += weight * of_pixel[k]
                along[k] += weight * of_pixel[k] * value
    for row in range(size):
        for column in range(size):
            value = patch[row + 1, column + 1]
            for k in range(_AFFINE):
                jacobian[row, column, k] -= mean[k] + along[k] * value
    return True


@helper()
def _hessian(jacobian: Float64, window: Float64, hessian: Float64) -> None:
    hessian[:] = 0.0
    size = len(window)
    for row in range(size):
        for column in range(size):
            of_pixel, weight = jacobian[row, column], window[row, column]
            for i in range(_AFFINE):
                for j in range(i + 1):
                    hessian[i, j] += weight * of_pixel[i] * of_pixel[j]
    for i in range(_AFFINE):
        for j in range(i):
            hessian[j, i] = hessian[i, j]


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
def _sample(image: Float32, at: Float64, warp: Float64, values: Float64, window: Float64) -> bool:
    """The patch at a place under a warp, normalised; False where it leaves the image or is flat."""
    size = len(values)
    radius = size // 2
    reach_x = radius * (abs(warp[0, 0]) + abs(warp[0, 1]))
    reach_y = radius * (abs(warp[1, 0]) + abs(warp[1, 1]))
    if not (at[0] >= reach_x and at[0] + reach_x < image.shape[1] - 1):
        return False
    if not (at[1] >= reach_y and at[1] + reach_y < image.shape[0] - 1):
        return False
    for row in range(size):
        for column in range(size):
            dx, dy = column - radius, row - radius
            x = at[0] + warp[0, 0] * dx + warp[0, 1] * dy
            y = at[1] + warp[1, 0] * dx + warp[1, 1] * dy
            values[row, column] = _bilinear(image, x, y)
    return _normalise(values, 0, window)


@helper()
def _correlate(patch: Float64, other: Float64, window: Float64) -> float:
    product = 0.0
    for row in range(len(window)):
        for column in range(len(window)):
            product += window[row, column] * patch[row + 1, column + 1] * other[row, column]
    return product


@helper()
def _solve(
    inverse: Float64,
    jacobian: Float64,
    patch: Float64,
    other: Float64,
    window: Float64,
    parameters: int,
    step: Float64,
) -> None:
    """The warp of the template that explains the difference best, into ``step``."""
    slope = np.zeros(_AFFINE)
    for row in range(len(window)):
        for column in range(len(window)):
            difference = other[row, column] - patch[row + 1, column + 1]
            difference *= window[row, column]
            for k in range(parameters):
                slope[k] += difference * jacobian[row, column, k]
    step[:] = 0.0
    for i in range(parameters):
        for j in range(parameters):
            step[i] += inverse[i, j] * slope[j]
        if i >= _TRANSLATION:
            step[i] /= len(window) // 2  # offsets were in terms of the radius


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
