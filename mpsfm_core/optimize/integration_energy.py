"""Energy of depth integration from normals, and the energy's quadratic majorizer.

The variable is the log depth z of all pixels (paper appendix B). The logarithm makes the
perspective normal residuals linear. The energy is::

    energy = sum over pixels and axes of   w_n / var_r * soft_min(r_+^2, r_-^2, limit)
           + sum over pixels of            w_d * charbonnier((z - log d)^2 / var_log_d)
           + sum over sparse points of     cauchy((z - log D)^2 / var_log_D)

The residuals r_+ and r_- compare a normal with the depth slope to the next and to the previous
pixel, as in bilateral normal integration (Cao et al., ECCV 2022)::

    r_+ = s (z[p + e] - z[p]) + n,    s = f (n . ray),    n = n_x or n_y

``var_r = var_n |e - ray n / (n . ray)|^2`` propagates an isotropic variance of the normal n to the
residual. With sharpness k::

    soft_min(a, b, limit) = -log((exp(-k a) + exp(-k b) + exp(-k limit)) / (2 + exp(-k limit))) / k

The soft minimum continues the surface to the next pixel, to the previous pixel, or to neither. The
derivatives of the soft minimum are the sigmoid weights of bilateral normal integration. The
Charbonnier loss ``2 c^2 (sqrt(1 + s / c^2) - 1)`` replaces the truncated loss of the paper, which
loses strips at depth discontinuities. All losses are concave in the squared residuals, so IRLS is a
majorize-minimize algorithm. Each step that decreases the quadratic majorizer also decreases the
energy.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mpsfm_core.data import Bool, Float32, Float64, Int64, NormalPrior, PinholeCamera
from mpsfm_core.support import jit

_kernel, _helper = jit.kernel(fastmath=True), jit.helper(fastmath=True)

_MISSING = 1e30
"""Squared normal residual of a pixel towards a missing neighbor."""
_SQRT_3 = 1.7320508075688772
_MIN_NORMAL_VARIANCE = 1e-4
"""Minimum variance of a normal, (0.6 deg)^2, because smaller variances make the linear system
ill-conditioned."""
MIN_LOG_VARIANCE = 1e-6
"""Minimum variance of log depth, (0.1 %)^2."""
MAX_LOG_VARIANCE = 1e2
"""Maximum variance of log depth, beyond which depth carries no information."""
_MIN_FACING = 2e-3
"""Minimum of ``-n . ray`` for unit normals n. Normals more than 89.9 deg from the viewing direction
carry no information about the slope of depth."""


class EnergyLosses(NamedTuple):
    """Parameters of the soft minimum and the robust losses in the depth integration energy."""

    sharpness: float
    normal_limit: float
    prior_scale: float
    point_scale: float


class NormalTerms(NamedTuple):
    """Normal residuals along x and y as arrays (2, h + 2, w + 2) with a border of one pixel."""

    slope: Float32
    """Factor s of the normal residual ``s (z[p + e] - z[p]) + n`` of each pixel."""
    normal: Float32
    """Component n_x or n_y of the normal of each pixel."""
    weight: Float32
    """Weight w_n / var_r of the normal residual of each pixel, 0 without a normal."""
    link: Bool
    """True if normal residuals may link a pixel with the next pixel along the axis."""


class PriorTerms(NamedTuple):
    """Depth prior as log depth (h, w), precision 1 / var_log_d (h, w), and weight w_d."""

    log_depth: Float64
    precision: Float32
    weight: float


class PointTerms(NamedTuple):
    """Pixels (n,), log depths (n,) and precisions 1 / var_log_D (n,) of sparse points."""

    rows: Int64
    columns: Int64
    log_depth: Float64
    precision: Float64


class EnergyTerms(NamedTuple):
    """Terms of the depth integration energy of one image."""

    normals: NormalTerms
    prior: PriorTerms
    points: PointTerms
    losses: EnergyLosses


class QuadraticMajorizer(NamedTuple):
    """Quadratic upper bound ``energy + 2 gradient . step + step' A step`` of the energy."""

    energy: float
    point_energy: float
    """Mean energy per sparse point."""
    gradient: Float64
    """(h, w) half of the gradient of the depth integration energy by log depth."""
    east: Float32
    south: Float32
    mass: Float32


def build_normal_terms(
    normals: NormalPrior, camera: PinholeCamera, active: Bool, weight: float
) -> NormalTerms:
    """Build the normal residuals between neighboring pixels of a mask (h, w)."""
    shape = (2, active.shape[0] + 2, active.shape[1] + 2)
    link = np.zeros(shape, np.bool_)
    link[0, 1:-1, 1:-2] = active[:, :-1] & active[:, 1:]
    link[1, 1:-2, 1:-1] = active[:-1] & active[1:]
    terms = NormalTerms._make([*np.zeros((3, *shape), np.float32), link])
    usable = normals.valid & active
    assert normals.variance is not None
    # A writable copy avoids a second compilation, because numba distinguishes read-only arrays.
    values, variance = (
        np.require(a, None, ("C", "W")) for a in (normals.normals, normals.variance)
    )
    _fill_normal_terms(values, variance, usable, camera.params, weight, terms)
    return terms


def compute_mean_point_energy(z: Float64, points: PointTerms, scale: float) -> float:
    """Compute the mean robust cost of log depth (h, w) at sparse points, or 0 without points."""
    offset = z[points.rows, points.columns] - points.log_depth
    energies = scale**2 * np.log1p(points.precision * offset**2 / scale**2)
    return float(energies.mean()) if len(energies) else 0.0


def majorize(z: Float64, terms: EnergyTerms) -> QuadraticMajorizer:
    """Compute the energy of a log depth map (h, w), and the quadratic majorizer at this map."""
    framed = np.zeros((z.shape[0] + 2, z.shape[1] + 2))
    framed[1:-1, 1:-1] = z
    gradient = np.zeros_like(framed)
    east, south = np.zeros((2, *framed.shape), np.float32)
    inner = (slice(1, -1), slice(1, -1))
    losses = terms.losses
    energy = _add_normals(framed, terms.normals, 0, losses, east, gradient)
    energy += _add_normals(framed, terms.normals, 1, losses, south, gradient)
    mass = np.empty(z.shape, np.float32)
    energy += _add_prior(z, terms.prior, losses.prior_scale, mass, gradient)
    of_points = _add_points(z, terms.points, losses.point_scale, mass, gradient)
    energy += of_points
    mean = of_points / max(len(terms.points.rows), 1)
    return QuadraticMajorizer(energy, mean, gradient[inner], east[inner], south[inner], mass)


@_kernel
def _fill_normal_terms(
    normals: Float32,
    variance: Float32,
    usable: Bool,
    camera: Float64,
    weight: float,
    terms: NormalTerms,
) -> None:
    fx, fy, cx, cy = camera
    for i in range(usable.shape[0]):
        y = (i + 0.5 - cy) / fy
        for j in range(usable.shape[1]):
            x = (j + 0.5 - cx) / fx
            nx, ny = normals[i, j, 0], normals[i, j, 1]
            facing = nx * x + ny * y + normals[i, j, 2]
            if not usable[i, j] or facing > -_MIN_FACING:
                continue
            r, c = i + 1, j + 1
            scaled = weight / max(variance[i, j], _MIN_NORMAL_VARIANCE)
            a, b = nx / facing, ny / facing
            ray = x * x + y * y + 1.0
            terms.slope[0, r, c], terms.slope[1, r, c] = fx * facing, fy * facing
            terms.normal[0, r, c], terms.normal[1, r, c] = nx, ny
            if terms.link[0, r, c] or terms.link[0, r, c - 1]:
                terms.weight[0, r, c] = scaled / (1.0 - 2.0 * a * x + a * a * ray)
            if terms.link[1, r, c] or terms.link[1, r - 1, c]:
                terms.weight[1, r, c] = scaled / (1.0 - 2.0 * b * y + b * b * ray)


@_kernel
def _add_normals(
    z: Float64,
    terms: NormalTerms,
    axis: int,
    losses: EnergyLosses,
    coupling: Float32,
    gradient: Float64,
) -> float:
    """Compute the energy of normal residuals along an axis; add couplings and half gradient.

    All input and output arrays are contiguous and have a border of one pixel.
    """
    height, width = z.shape
    stride = 1 if axis == 0 else width
    z, coupling, gradient = z.ravel(), coupling.ravel(), gradient.ravel()
    slope, normal = terms.slope[axis].ravel(), terms.normal[axis].ravel()
    weight, link = terms.weight[axis].ravel(), terms.link[axis].ravel()
    coupling_ahead, coupling_behind = np.empty(width), np.empty(width)
    force_ahead, force_behind = np.empty(width), np.empty(width)
    energy = 0.0
    for i in range(1, height - 1):
        first = i * width + 1
        energy += _link_row(
            z[first - stride :],
            z[first:],
            z[first + stride :],
            link[first - stride :],
            link[first:],
            slope[first:],
            normal[first:],
            weight[first : first + width - 2],
            losses,
            coupling_ahead,
            coupling_behind,
            force_ahead,
            force_behind,
        )
        for j in range(width - 2):
            coupling[first + j] += coupling_ahead[j]
            gradient[first + j] += force_behind[j] - force_ahead[j]
        for j in range(width - 2):
            coupling[first - stride + j] += coupling_behind[j]
            gradient[first - stride + j] -= force_behind[j]
        for j in range(width - 2):
            gradient[first + stride + j] += force_ahead[j]
    return energy


@_helper
def _link_row(
    z_behind: Float64,
    z: Float64,
    z_ahead: Float64,
    link_behind: Bool,
    link_ahead: Bool,
    slope: Float32,
    normal: Float32,
    weight: Float32,
    losses: EnergyLosses,
    coupling_ahead: Float64,
    coupling_behind: Float64,
    force_ahead: Float64,
    force_behind: Float64,
) -> float:
    """Compute the energy of normal residuals of a pixel row, with couplings and half gradients.

    If a pixel has only one neighbor, the soft minimum takes the residual of that neighbor and the
    residual limit.
    """
    k, limit = losses.sharpness, losses.normal_limit
    two_sides, one_side = np.log(2.0 + np.exp(-k * limit)), np.log(1.0 + np.exp(-k * limit))
    energy = 0.0
    for j in range(weight.size):
        s, n, w = slope[j], normal[j], weight[j]
        ahead, behind = s * (z_ahead[j] - z[j]) + n, s * (z[j] - z_behind[j]) + n
        a = ahead * ahead if link_ahead[j] else _MISSING
        b = behind * behind if link_behind[j] else _MISSING

        # Subtracting the smallest of a, b and the limit prevents underflow of all exponentials.
        low, high = min(a, b), max(a, b)
        of_gap = _exp(-k * abs(limit - low))
        of_low, of_limit = (1.0, of_gap) if low < limit else (of_gap, 1.0)
        of_high = of_low * _exp(-k * (high - low))
        total = of_low + of_high + of_limit
        full = two_sides if link_ahead[j] and link_behind[j] else one_side
        energy += w * (min(low, limit) + (full - _log(total)) / k)

        of_ahead, of_behind = (of_low, of_high) if a < b else (of_high, of_low)
        share_ahead = w * s * of_ahead / total if link_ahead[j] else 0.0
        share_behind = w * s * of_behind / total if link_behind[j] else 0.0
        coupling_ahead[j], coupling_behind[j] = share_ahead * s, share_behind * s
        force_ahead[j], force_behind[j] = share_ahead * ahead, share_behind * behind
    return energy


@_helper
def _exp(x: float) -> float:
    """Compute exp(max(x, -60)) for x <= 0 with error 1e-14, in code that compilers vectorize."""
    scaled = max(x, -60.0) * 1.4426950408889634
    whole = np.floor(scaled + 0.5)
    f = (scaled - whole) * 0.6931471805599453
    p = 1 / 39916800 * f + 1 / 3628800
    p = p * f + 1 / 362880
    p = p * f + 1 / 40320
    p = p * f + 1 / 5040
    p = p * f + 1 / 720
    p = p * f + 1 / 120
    p = p * f + 1 / 24
    p = p * f + 1 / 6
    p = p * f + 1 / 2
    p = p * f + 1.0
    p = p * f + 1.0
    value: float = p * np.int64((np.int64(whole) + 1023) << 52).view(np.float64)
    return value


@_helper
def _log(x: float) -> float:
    """Compute log(x) for x in [1, 3] with error 1e-11 by the artanh series at sqrt(3)."""
    u = (x - _SQRT_3) / (x + _SQRT_3)
    q = u * u
    p = 1 / 13 + q * (1 / 15)
    p = 1 / 11 + q * p
    p = 1 / 9 + q * p
    p = 1 / 7 + q * p
    p = 1 / 5 + q * p
    p = 1 / 3 + q * p
    return 0.5493061443340548 + 2.0 * u * (1.0 + q * p)


@_kernel
def _add_prior(
    z: Float64, prior: PriorTerms, scale: float, mass: Float32, gradient: Float64
) -> float:
    """Compute the Charbonnier energy of the depth prior, its curvature and half gradient."""
    energy, square = 0.0, scale * scale
    for i in range(z.shape[0]):
        for j in range(z.shape[1]):
            offset, precision = z[i, j] - prior.log_depth[i, j], prior.precision[i, j]
            ratio = precision * offset * offset / square
            root = np.sqrt(1.0 + ratio)
            energy += prior.weight * 2.0 * square * ratio / (root + 1.0)
            slope = prior.weight * precision / root
            mass[i, j] = slope
            gradient[i + 1, j + 1] += slope * offset
    return energy


@_kernel
def _add_points(
    z: Float64, points: PointTerms, scale: float, mass: Float32, gradient: Float64
) -> float:
    """Compute the Cauchy energy of the sparse points, and add curvature and half gradient."""
    energy = 0.0
    for k in range(points.rows.size):
        i, j = points.rows[k], points.columns[k]
        offset = z[i, j] - points.log_depth[k]
        ratio = points.precision[k] * offset * offset / (scale * scale)
        energy += scale * scale * np.log1p(ratio)
        slope = points.precision[k] / (1.0 + ratio)
        mass[i, j] += slope
        gradient[i + 1, j + 1] += slope * offset
    return energy
