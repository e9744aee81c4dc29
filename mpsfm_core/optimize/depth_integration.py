"""Refinement of a depth map with normals and triangulated points (paper appendix B).

IRLS minimizes the energy of depth integration (:mod:`mpsfm_core.optimize.integration_energy`). Each
IRLS re-weighting gives a linear system with a five-point stencil, solved approximately by a few
multigrid-preconditioned CG iterations. Large depth maps are first refined on every second pixel.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy import ndimage

from mpsfm_core.data import Bool, DepthPrior, Float32, Float64, NormalPrior, PinholeCamera
from mpsfm_core.data.errors import DataError
from mpsfm_core.optimize.depth_variance import compute_inverse_diagonal
from mpsfm_core.optimize.integration_energy import (
    MAX_LOG_VARIANCE,
    MIN_LOG_VARIANCE,
    EnergyLosses,
    EnergyTerms,
    PointTerms,
    PriorTerms,
    QuadraticMajorizer,
    build_normal_terms,
    compute_mean_point_energy,
    majorize,
)
from mpsfm_core.optimize.multigrid import LinearSolution, Multigrid
from mpsfm_core.optimize.options import IntegrationOptions
from mpsfm_core.optimize.subsampling import (
    subsample_camera,
    subsample_pixels,
    subsample_prior,
    upsample,
)

_FILLED_LOG_VARIANCE = 1.0
"""Variance of the log depth of pixels with a normal but no depth prior, which makes the linear
system non-singular."""
_COARSE_COLUMNS = 300
"""Minimum width in pixels of half-resolution depth maps for a coarse start. Depth integration with
a coarse start at half resolution is faster and reaches a lower energy. [tuned:
benchmarks.depth_integration]"""
_FINE_ITERATIONS = 3
"""Maximum number of IRLS re-weightings at full resolution after the coarse refinement. [ours]"""
_MAX_EXTRAPOLATION = 100.0
"""Maximum ratio of depth integrated from normals to known depth, a limit at grazing normals.
[ours]"""
POINT_MAX_RATIO = 1.5
"""Maximum ratio between the depth of a triangulated point and the scaled prior for which the point
is used. [reference]"""
_FIXED_WEIGHT = 1e15
"""Weight in the linear system that fixes pixels of known depth, far above other coefficients
(1e12)."""


class Anchors(NamedTuple):
    """Triangulated points that constrain single pixels of a depth map.

    Points outside of the map, on invalid pixels, or with non-positive depth or variance are
    ignored.
    """

    xy: Float64
    """(n, 2) positions of the points in pixels of the depth map. Each point constrains the nearest
    pixel."""
    depth: Float64
    """(n,) depth z of the points in the unit of the scaled prior."""
    variance: Float64
    """(n,) variance of the depth of the points, in squared units of the scaled prior."""


NO_ANCHORS = Anchors(np.zeros((0, 2)), np.zeros(0), np.zeros(0))


@dataclass(frozen=True, eq=False)
class RefinedDepth:
    """Refined depth map with a summary of its refinement."""

    log_depth: Float64
    """(h, w) float64 natural logarithm of depth in the unit of the scaled prior."""
    valid: Bool
    """(h, w) bool, False for pixels with neither a depth prior nor normals that connect them to
    depth. The log depth of invalid pixels is set to the median."""
    scale: float
    """Scale of the depth prior during the refinement."""
    initial_energy: float
    """Energy of the depth map before refinement, with the anchors (sparse points) of the
    refinement."""
    energy: float
    """Energy of the refined depth map, at most ``initial_energy``."""
    point_energy: float
    """Mean energy per anchor (sparse point) in the refined depth map."""
    iterations: int
    """Number of IRLS re-weightings at full resolution."""
    cg_iterations: int
    """Number of conjugate-gradient iterations at full resolution."""
    converged: bool
    """True if the relative decrease of the energy fell below the tolerance."""
    skipped: bool
    """True if the depth map was not refined again, because the anchors fit about as well as before.
    The energies of a skipped map are those of its last refinement."""

    @classmethod
    def from_log_depth(cls, log_depth: Float64, valid: Bool, scale: float) -> RefinedDepth:
        """Build a refined depth map of unknown energy, whose next refinement is never skipped."""
        return cls(log_depth, valid, scale, 0.0, 0.0, 0.0, 0, 0, converged=False, skipped=False)

    @property
    def depth(self) -> Float32:
        """(h, w) float32 depth in the unit of the scaled prior."""
        return np.exp(self.log_depth).astype(np.float32)


class _Solver:
    """Majorize-minimize solver for the depth integration energy of one image."""

    def __init__(self, terms: EnergyTerms) -> None:
        self._terms = terms
        self._multigrid = Multigrid(*terms.prior.log_depth.shape)

    def majorize(self, z: Float64) -> QuadraticMajorizer:
        return majorize(z, self._terms)

    def step(
        self, here: QuadraticMajorizer, iterations: int, tolerance: float = 0.0
    ) -> LinearSolution:
        self._multigrid.update(here.east, here.south, here.mass)
        return self._multigrid.solve(-here.gradient, iterations, tolerance)


class DepthIntegrator:
    """Depth integration of one image, for changing anchors and depth scales.

    Pixels with a normal but without depth are integrated from neighboring pixels. Several threads
    may use one integrator, because integrators are immutable.

    Args:
        depth: Depth prior with variance, at the resolution of ``camera``.
        normals: Normal prior with variance, at the resolution of ``camera``.
        camera: Intrinsics in pixels of the depth and normal priors.
        options: Options of depth integration.

    Raises:
        DataError: The depth prior, normal prior and camera differ in size, or a prior has no
            variance.
    """

    def __init__(
        self,
        depth: DepthPrior,
        normals: NormalPrior,
        camera: PinholeCamera,
        options: IntegrationOptions | None = None,
    ) -> None:
        if depth.variance is None or normals.variance is None:
            raise DataError(
                "variance", "depth prior or normal prior has no variance; calibrate the prior"
            )
        if not depth.shape == normals.shape == (camera.height, camera.width):
            raise DataError(
                "camera", "depth prior, normal prior and camera must have equal width and height"
            )
        self.options = options = options or IntegrationOptions()
        self._normals = normals
        self.camera = camera
        self._active = _reachable(depth.valid, normals.valid)
        values = depth.depth.astype(np.float64)
        spread = depth.variance / np.where(depth.valid, values, 1.0) ** 2
        variance = np.where(depth.valid, spread, _FILLED_LOG_VARIANCE)
        precision = self._active / np.clip(variance, MIN_LOG_VARIANCE, MAX_LOG_VARIANCE)
        self._precision = precision.astype(np.float32)
        known = np.log(values[depth.valid])
        self._log_depth = np.full(depth.shape, np.median(known) if known.size else 0.0)
        self._log_depth[depth.valid] = known
        holes = self._active & ~depth.valid
        if holes.any():
            self._log_depth[holes] = self._integrate_from(depth.valid)[holes]
        self._coarse: DepthIntegrator | None = None
        if camera.width >= 2 * _COARSE_COLUMNS:
            parts = (
                subsample_prior(depth, 2),
                subsample_prior(normals, 2),
                subsample_camera(camera, 2),
            )
            self._coarse = DepthIntegrator(*parts, options)

    @property
    def nbytes(self) -> int:
        """Size of the arrays of the integrator in bytes, without those of the priors."""
        own: int = self._active.nbytes + self._precision.nbytes + self._log_depth.nbytes
        return own + (self._coarse.nbytes if self._coarse else 0)

    def refine(
        self,
        anchors: Anchors = NO_ANCHORS,
        *,
        scale: float = 1.0,
        start: RefinedDepth | None = None,
    ) -> RefinedDepth:
        """Refine the depth map for new anchors or a new scale of the prior.

        Args:
            anchors: Triangulated points.
            scale: Scale factor on the depth prior.
            start: Earlier refined depth of this integrator, which is rescaled and used as initial
                depth map. The earlier depth map is returned unrefined if the anchors fit about as
                well as before. Without an earlier depth map, the refinement starts from the scaled
                prior.
        """
        if start is None:
            solver = _Solver(self._terms(anchors, scale))
            z = self._log_depth + np.log(scale)
            return self._descend_from_prior(z, solver.majorize(z), solver, anchors, scale)
        z = start.log_depth + np.log(scale / start.scale)
        points = self._point_terms(anchors, self._log_depth + np.log(scale))
        energy = compute_mean_point_energy(z, points, self.options.point_scale)
        if energy <= self.options.max_point_growth * start.point_energy:
            return replace(start, log_depth=z, scale=scale, skipped=True)
        solver = _Solver(self._terms(anchors, scale))
        return self._descend(z, solver.majorize(z), solver, scale)

    def variance(self, refined: RefinedDepth, anchors: Anchors = NO_ANCHORS) -> Float32:
        """Compute the marginal variance of the refined log depth.

        The variance is the exact diagonal of the inverse Gauss-Newton Hessian with the present IRLS
        weights. The variance of depth is the variance of log depth times depth^2.

        Returns:
            (h, w) float32 variance of log depth, infinite at pixels without valid depth.
        """
        terms = self._terms(anchors, refined.scale)
        here = majorize(refined.log_depth, terms)
        return compute_inverse_diagonal(here.east, here.south, here.mass).astype(np.float32)

    def _descend_from_prior(
        self,
        prior: Float64,
        here: QuadraticMajorizer,
        solver: _Solver,
        anchors: Anchors,
        scale: float,
    ) -> RefinedDepth:
        """Refine the scaled depth prior, first at half resolution for large depth maps."""
        if self._coarse is None:
            return self._descend(prior, here, solver, scale)
        coarse = self._coarse.refine(
            anchors._replace(xy=subsample_pixels(np.asarray(anchors.xy), 2)), scale=scale
        )
        change = coarse.log_depth - self._coarse._log_depth - np.log(scale)
        z = prior + upsample(change, coarse.valid, prior.shape)
        there = solver.majorize(z)
        if not there.energy < here.energy:
            return self._descend(prior, here, solver, scale)
        limit = min(_FINE_ITERATIONS, self.options.max_iterations)
        fine = self._descend(z, there, solver, scale, limit)
        return replace(fine, initial_energy=here.energy)

    def _descend(
        self,
        z: Float64,
        here: QuadraticMajorizer,
        solver: _Solver,
        scale: float,
        max_iterations: int | None = None,
    ) -> RefinedDepth:
        """Minimize the depth integration energy by IRLS from an initial log depth z (h, w)."""
        options = self.options
        limit = options.max_iterations if max_iterations is None else max_iterations
        initial_energy = here.energy
        iterations = cg_iterations = 0
        converged = False
        while iterations < limit and not converged:
            step = solver.step(here, options.cg_iterations)
            further = z + (options.over_relaxation if iterations else 1.0) * step.x
            there = solver.majorize(further)
            if not there.energy < here.energy:
                further = z + step.x
                there = solver.majorize(further)
            iterations, cg_iterations = iterations + 1, cg_iterations + step.iterations
            converged = not here.energy - there.energy > options.tolerance * here.energy
            if there.energy < here.energy:
                z, here = further, there
        return RefinedDepth(
            log_depth=z,
            valid=self._active,
            scale=scale,
            initial_energy=initial_energy,
            energy=here.energy,
            point_energy=here.point_energy,
            iterations=iterations,
            cg_iterations=cg_iterations,
            converged=converged,
            skipped=False,
        )

    def _terms(self, anchors: Anchors, scale: float) -> EnergyTerms:
        options, pixels = self.options, self._active.size
        prior = PriorTerms(
            self._log_depth + np.log(scale),
            self._precision,
            min(1.0, options.independent_depths / pixels),
        )
        weight = min(1.0, options.independent_normals / pixels)
        return EnergyTerms(
            build_normal_terms(self._normals, self.camera, self._active, weight),
            prior,
            self._point_terms(anchors, prior.log_depth),
            EnergyLosses(
                options.sharpness, options.normal_limit, options.prior_scale, options.point_scale
            ),
        )

    def _point_terms(self, anchors: Anchors, prior: Float64) -> PointTerms:
        """Convert anchors to log depths of pixels, and remove invalid anchors and outliers."""
        height, width = prior.shape
        columns, rows = np.asarray(anchors.xy, np.float64).reshape(-1, 2).T
        depth, variance = np.asarray(anchors.depth), np.asarray(anchors.variance)
        usable = (columns >= 0) & (columns < width) & (rows >= 0) & (rows < height)
        usable &= (depth > 0) & (variance > 0) & np.isfinite(depth) & np.isfinite(variance)
        rows, columns = rows[usable].astype(np.int64), columns[usable].astype(np.int64)
        log_depth, log_variance = np.log(depth[usable]), variance[usable] / depth[usable] ** 2
        near = np.abs(log_depth - prior[rows, columns]) < np.log(POINT_MAX_RATIO)
        near &= self._active[rows, columns]
        precision = 1.0 / np.clip(log_variance[near], MIN_LOG_VARIANCE, MAX_LOG_VARIANCE)
        return PointTerms(rows[near], columns[near], log_depth[near], precision)

    def _integrate_from(self, known: Bool) -> Float64:
        """Integrate normals from pixels of known log depth, with quadratic losses."""
        losses = EnergyLosses(sharpness=1e-9, normal_limit=1e12, prior_scale=1e6, point_scale=1.0)
        terms = EnergyTerms(
            build_normal_terms(self._normals, self.camera, self._active, 1.0),
            PriorTerms(self._log_depth, known.astype(np.float32), _FIXED_WEIGHT),
            self._point_terms(NO_ANCHORS, self._log_depth),
            losses,
        )
        solver = _Solver(terms)
        step = solver.step(solver.majorize(self._log_depth), iterations=50, tolerance=1e-3)
        low, high = self._log_depth[known].min(), self._log_depth[known].max()
        margin = np.log(_MAX_EXTRAPOLATION)
        filled: Float64 = np.nan_to_num(self._log_depth + step.x, nan=0.5 * (low + high))
        return np.clip(filled, low - margin, high + margin)


def _reachable(depth_valid: Bool, normals_valid: Bool) -> Bool:
    """Return masks of pixels with depth, and of pixels that normals connect to depth."""
    active: Bool = depth_valid | normals_valid
    if depth_valid.all():
        return active
    labels, count = ndimage.label(active)
    known = np.zeros(count + 1, np.bool_)
    known[labels[depth_valid]] = True
    reachable: Bool = active & known[labels]
    return reachable
