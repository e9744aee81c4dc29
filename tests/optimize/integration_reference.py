"""Reference implementation of depth integration with sparse matrices, independent of the kernels.

Tests compare the kernels with this reference, and benchmarks compare the run times. Every pixel
must have either depth or no data at all.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.sparse.linalg import LinearOperator, cg
from scipy.special import logsumexp

from mpsfm_core.data import DepthPrior, NormalPrior, PinholeCamera
from mpsfm_core.optimize.depth_integration import (
    NO_ANCHORS,
    POINT_MAX_RATIO,
    Anchors,
)
from mpsfm_core.optimize.options import IntegrationOptions

Array = NDArray[np.float64]


def grid_operator(east: NDArray[Any], south: NDArray[Any], mass: NDArray[Any]) -> sp.csr_array:
    """Return the five-point operator of `mpsfm_core.optimize.multigrid` as a sparse matrix."""
    index = np.arange(mass.size).reshape(mass.shape)
    matrix = sp.diags_array(mass.ravel().astype(np.float64))
    for coupling, step in ((east[:, :-1], (0, 1)), (south[:-1], (1, 0))):
        a = index[: index.shape[0] - step[0], : index.shape[1] - step[1]].ravel()
        b = index[step[0] :, step[1] :].ravel()
        c = coupling.ravel().astype(np.float64)
        rows, columns = np.concatenate([a, b, a, b]), np.concatenate([a, b, b, a])
        entries = (np.concatenate([c, c, -c, -c]), (rows, columns))
        matrix = matrix + sp.coo_array(entries, shape=matrix.shape)
    return sp.csr_array(matrix)


class Axis(NamedTuple):
    """One-sided residuals ``slope * difference @ z + normal`` along an axis in both directions."""

    slope: Array
    normal: Array
    weight: Array
    ahead: sp.csr_array  # (n, n) one-sided differences; zero rows where `has_ahead` is false
    behind: sp.csr_array
    has_ahead: NDArray[np.bool_]
    has_behind: NDArray[np.bool_]


class System(NamedTuple):
    """Energy, half of the energy's gradient (n,), and the matrix (n, n) of the majorizer."""

    energy: float
    gradient: Array
    matrix: sp.csr_array


class ReferenceIntegration:
    """Energy of depth integration of one image as a function of log depth z (n,), row-major."""

    def __init__(
        self,
        depth: DepthPrior,
        normals: NormalPrior,
        camera: PinholeCamera,
        anchors: Anchors = NO_ANCHORS,
        options: IntegrationOptions | None = None,
    ) -> None:
        assert depth.variance is not None
        assert normals.variance is not None
        assert (depth.valid | ~normals.valid).all()
        self.options = options = options or IntegrationOptions()
        self.active = depth.valid.ravel()
        pixels = depth.valid.size
        self.prior = np.log(np.where(depth.valid, depth.depth, 1).astype(np.float64)).ravel()
        relative = depth.variance.astype(np.float64) / np.where(depth.valid, depth.depth, 1) ** 2
        self.prior_precision = np.where(depth.valid, 1 / np.clip(relative, 1e-6, 1e2), 0.0).ravel()
        self.prior_weight = min(1.0, options.independent_depths / pixels)
        self.axes = self._axes(normals, camera, min(1.0, options.independent_normals / pixels))

        height, width = depth.shape
        rows, columns = (
            np.floor(anchors.xy[:, 1]).astype(int),
            np.floor(anchors.xy[:, 0]).astype(int),
        )
        inside = (rows >= 0) & (rows < height) & (columns >= 0) & (columns < width)
        pixel = np.where(inside, rows * width + columns, 0)
        near = np.abs(np.log(anchors.depth) - self.prior[pixel]) < np.log(POINT_MAX_RATIO)
        kept = inside & near & self.active[pixel]
        self.pixel, self.target = pixel[kept], np.log(anchors.depth[kept])
        self.precision = anchors.depth[kept] ** 2 / anchors.variance[kept]

    def _axes(self, normals: NormalPrior, camera: PinholeCamera, weight: float) -> list[Axis]:
        height, width = normals.shape
        x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
        ray = np.dstack([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, np.ones_like(x)])
        n = normals.normals.astype(np.float64)
        facing = (n * ray).sum(-1)
        usable = normals.valid & self.active.reshape(normals.shape) & (facing <= -2e-3)
        facing = np.where(usable, facing, -1.0)
        axes = []
        for axis, (focal, step) in enumerate(((camera.fx, 1), (camera.fy, width))):
            # Exact propagation of an isotropic normal covariance (paper, appendix B).
            jacobian = np.eye(3)[axis] - ray * (n[..., axis] / facing)[..., None]
            covariance = np.eye(3) - n[..., :, None] * n[..., None, :]
            spread = np.einsum("...i,...ij,...j->...", jacobian, covariance, jacobian)
            variance = np.maximum(normals.variance, 1e-4) * spread
            last = (x > width - 1) if axis == 0 else (y > height - 1)
            ahead, has_ahead = self._differences(~last.ravel(), step)
            has_behind = np.zeros_like(has_ahead)
            has_behind[step:] = has_ahead[:-step] if step < len(has_ahead) else False
            axes.append(
                Axis(
                    np.where(usable, focal * facing, 0.0).ravel(),
                    np.where(usable, n[..., axis], 0.0).ravel(),
                    np.where(usable, weight / variance, 0.0).ravel() * (has_ahead | has_behind),
                    ahead,
                    sp.csr_array(sp.eye_array(len(has_ahead), k=-step) @ ahead),
                    has_ahead,
                    has_behind,
                )
            )
        return axes

    def _differences(
        self, has_next: NDArray[np.bool_], step: int
    ) -> tuple[sp.csr_array, NDArray[np.bool_]]:
        """Return the matrix of differences z[p + step] - z[p], and the mask of pixels that have
        one."""
        count = len(has_next)
        linked = np.zeros(count, bool)
        linked[: count - step] = (has_next & self.active)[: count - step] & self.active[step:]
        p = np.flatnonzero(linked)
        ones = np.ones(len(p))
        entries = (np.r_[ones, -ones], (np.r_[p, p], np.r_[p + step, p]))
        return sp.csr_array(sp.coo_array(entries, shape=(count, count))), linked

    def linearise(self, z: Array) -> System:
        """Compute energy and majorizer at the log depth z."""
        matrix, gradient, energy = self._prior(z)
        for axis in self.axes:
            ahead = axis.slope * (axis.ahead @ z) + axis.normal
            behind = axis.slope * (axis.behind @ z) + axis.normal
            value, w_ahead, w_behind = self._soft_min(ahead, behind, axis)
            energy += float(axis.weight @ value)
            for difference, residual, share in (
                (axis.ahead, ahead, w_ahead),
                (axis.behind, behind, w_behind),
            ):
                weight = axis.weight * share * axis.slope
                matrix = matrix + difference.T @ sp.diags_array(weight * axis.slope) @ difference
                gradient += difference.T @ (weight * residual)
        return System(energy, gradient, sp.csr_array(matrix))

    def _soft_min(self, ahead: Array, behind: Array, axis: Axis) -> tuple[Array, Array, Array]:
        k = self.options.sharpness
        exponents = -k * np.stack(
            [
                np.where(axis.has_ahead, ahead**2, np.inf),
                np.where(axis.has_behind, behind**2, np.inf),
                np.full_like(ahead, self.options.normal_limit),
            ]
        )
        sides = axis.has_ahead.astype(float) + axis.has_behind
        total = logsumexp(exponents, axis=0)
        shares = np.exp(exponents - total)
        full = np.log(sides + np.exp(-k * self.options.normal_limit))
        return (full - total) / k, shares[0], shares[1]

    def _prior(self, z: Array) -> tuple[Any, Array, float]:
        """Add the terms of the depth prior and of sparse points."""
        offset = z - self.prior
        square = self.prior_precision * offset**2
        scale = self.options.prior_scale**2
        root = np.sqrt(1 + square / scale)
        energy = self.prior_weight * 2 * scale * float((root - 1).sum())
        mass = self.prior_weight * self.prior_precision / root
        gradient = mass * offset
        offset = z[self.pixel] - self.target
        scale = self.options.point_scale**2
        square = self.precision * offset**2
        energy += scale * float(np.log1p(square / scale).sum())
        weight = self.precision / (1 + square / scale)
        np.add.at(mass, self.pixel, weight)
        np.add.at(gradient, self.pixel, weight * offset)
        return sp.diags_array(mass), gradient, energy

    def solve(
        self,
        *,
        cg_tolerance: float = 1e-3,
        tolerance: float = 5e-2,
        max_iterations: int = 10,
        target: float = 0.0,
    ) -> tuple[Array, list[float]]:
        """Minimize by the published schedule, with a full Jacobi-CG solve before each re-weighting.

        Returns the map and the energies before each re-weighting and at the end; stops early when
        the energy reaches `target`.
        """
        z = self.prior.copy()
        here = self.linearise(z)
        energies = [here.energy]
        for _ in range(max_iterations):
            diagonal = here.matrix.diagonal()
            inverse = 1 / np.where(diagonal > 0, diagonal, 1.0)
            jacobi = LinearOperator(here.matrix.shape, matvec=lambda r, d=inverse: d * r)
            step, _ = cg(here.matrix, -here.gradient, rtol=cg_tolerance, maxiter=5000, M=jacobi)
            z = z + step
            here = self.linearise(z)
            energies.append(here.energy)
            if energies[-2] - here.energy < tolerance * energies[-2] or here.energy <= target:
                break
        return z, energies
