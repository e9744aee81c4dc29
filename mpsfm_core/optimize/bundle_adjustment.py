"""Depth-regularised bundle adjustment (paper: C_BA + C_reg with the refined depth maps fixed).

Minimises over camera poses, 3D points and, if wanted, focal lengths and the scales ``exp(s)`` of
depth maps

    1/2 sum rho_r(|project(R X + t) - xy|^2 / std_px^2)
    + 1/2 sum rho_d((log z - log d - s)^2 / std^2) + 1/2 sum (s - expected)^2 / std_s^2

with Levenberg-Marquardt: the points are eliminated (3 x 3 blocks), the cameras solved for, the
points follow by back-substitution and then settle one by one.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import numpy as np
from scipy.linalg import lapack
from threadpoolctl import ThreadpoolController

from mpsfm_core.data import Float64
from mpsfm_core.optimize import bundle_kernels as kernels
from mpsfm_core.optimize.bundle_problem import (
    BundleProblem,
    PreparedBundle,
    RangeExecutor,
    prepare_bundle,
    range_executor,
)
from mpsfm_core.optimize.options import BundleOptions

__all__ = ["BundleProblem", "BundleResult", "adjust_bundle"]

INITIAL_DAMPING = 1e-4
"""Inverse of Ceres' initial trust-region radius. [Ceres initial_trust_region_radius]"""
MIN_DAMPING = 1e-10
"""Holds what nothing observes, as the depth of a point that is seen once (our choice)."""
MAX_DAMPING = 1e16
MAX_FOCAL_STEP = 1.0
"""A focal length changes by at most a factor of e in a step (our choice)."""
CG_TOLERANCE = 1e-3
"""Of the reduced system beyond ``dense_poses`` (our choice)."""
MAX_CG_ITERATIONS = 500
MIN_GAIN = 1e-3
"""A step is taken if the cost falls by this part of the prediction (Ceres' default)."""


@dataclass(frozen=True, eq=False)
class BundleResult:
    """The adjusted parameters, in the order of the problem, and how it went.

    ``iterations`` counts the steps tried. ``converged`` is False when their limit was hit or
    no step lowered the cost; ``message`` says which.
    """

    rotations: Float64
    translations: Float64
    log_scales: Float64
    intrinsics: Float64
    points: Float64
    initial_cost: float
    final_cost: float
    iterations: int
    converged: bool
    message: str


def adjust_bundle(problem: BundleProblem, options: BundleOptions | None = None) -> BundleResult:
    """Adjust poses, points and focal lengths; the cost never increases.

    An observation whose point is behind its camera (z <= 1e-9) or at more than 89.9999 degrees
    from its axis has residual 0, for reprojection as in COLMAP and for depth as in the
    reference; but a step that makes it so is charged the cost it had before. The result is
    the same bit for bit whatever the number of threads.

    Raises:
        DataError: an array has a wrong shape, an index out of range, a value that is not finite,
            or a standard deviation that is not positive.
    """
    options = options or BundleOptions()
    prepared = prepare_bundle(problem, options)
    with (
        range_executor(prepared.ranges, options.threads) as run,
        _blas().limit(limits=1, user_api="blas"),
    ):
        return _minimize(prepared, options, run)


@cache
def _blas() -> ThreadpoolController:
    # BLAS threads beside ours are slow, and looking the libraries up costs milliseconds
    return ThreadpoolController()


def _minimize(p: PreparedBundle, options: BundleOptions, run: RangeExecutor) -> BundleResult:
    """Levenberg-Marquardt with Nielsen's damping, as Ceres has it."""
    state, trial = p.state, kernels.BundleParameters(*(np.empty_like(array) for array in p.state))
    normal = SchurComplementSolver(p, options, run)
    damping, growth = INITIAL_DAMPING, 2.0
    initial_cost = np.inf
    converged, message = False, "iteration limit reached"
    for iteration in range(1, options.max_iterations + 1):
        cost = normal.linearize(state, damping)
        initial_cost = cost if iteration == 1 else initial_cost
        trial_cost, decrease, promised = normal.step(state, trial, damping, cost)
        tolerated = max(options.function_tolerance, np.finfo(float).eps) * cost
        if np.isfinite(decrease) and decrease >= max(MIN_GAIN * promised, 0.0):
            state, trial, cost = trial, state, trial_cost
            gain = min(decrease / promised, 1.0) if promised > 0 else 1.0
            damping = max(damping * max(1 / 3, 1 - (2 * gain - 1) ** 3), MIN_DAMPING)
            growth = 2.0
            converged = bool(decrease <= tolerated)
        else:
            damping *= growth
            growth *= 2.0
            converged = bool(promised <= tolerated)
        if converged:
            message = "cost change below the tolerance"
            break
        if damping > MAX_DAMPING:
            message = "no step lowers the cost"
            break
    return BundleResult(*state, initial_cost, cost, iteration, converged, message)


class SchurComplementSolver:
    """The linear system of one adjustment; its buffers are kept from step to step."""

    def __init__(self, p: PreparedBundle, options: BundleOptions, run: RangeExecutor) -> None:
        layout = p.bundle.layout
        poses, focals = len(layout.pair), int(layout.focal_slot.max(initial=-1)) + 1
        size = kernels.NUM_IMAGE_PARAMS * poses + focals
        view = int(kernels.NUM_IMAGE_PARAMS)
        block, border = (len(p.pairs), view, view), (focals, view * poses)
        shapes = block, border, (focals, focals), size, size, size
        self.parts = [
            kernels.ReducedCameraSystem(*(np.empty(shape) for shape in shapes)) for _ in p.ranges
        ]
        self.scratch = [kernels.allocate_buffers(p.longest) for _ in p.ranges]
        self.total = self.parts[0]
        self.eliminated = np.empty((len(p.state.points), 10))
        self.p = p
        self.run = run
        self.dense = poses <= options.dense_poses
        self.tolerance = options.function_tolerance

    def linearize(self, state: kernels.BundleParameters, damping: float) -> float:
        """Fill the system at ``state``, eliminate its points, and return its cost."""

        def reduce(n: int, first: int, last: int) -> float:
            for array in self.parts[n]:
                array.fill(0.0)
            cost: float = kernels.eliminate_points(
                first,
                last,
                damping,
                self.p.bundle,
                state,
                self.parts[n],
                self.eliminated,
                self.scratch[n],
            )
            return cost

        cost = sum(self.run(reduce))
        self.total = self.parts[0]
        for part in self.parts[1:]:
            for array, more in zip(self.total, part, strict=True):
                array += more
        self._expect_scales(state)
        self.total.rhs[:] += self.total.gradient
        self._hold()
        return cost + self.p.scale_prior.cost(state)

    def _expect_scales(self, state: kernels.BundleParameters) -> None:
        """Add what is expected of the scales of depth maps."""
        prior, layout = self.p.scale_prior, self.p.bundle.layout
        rows = kernels.NUM_IMAGE_PARAMS * prior.slot + kernels.LOG_SCALE_IDX
        own = layout.pair[prior.slot, prior.slot]
        self.total.blocks[own, kernels.LOG_SCALE_IDX, kernels.LOG_SCALE_IDX] += prior.weight
        self.total.diagonal[rows] += prior.weight
        off = state.log_scales[prior.image] - prior.log_scale
        self.total.gradient[rows] += prior.weight * off

    def _hold(self) -> None:
        """Take what does not move of images with a slot out of the system."""
        held, pairs, blocks = self.p.held, self.p.pairs, self.total.blocks
        some = np.asarray(held.any(axis=1))
        for side, axis in ((0, 2), (1, 1)):
            rows = np.flatnonzero(some[pairs[:, side]])
            blocks[rows] *= np.expand_dims(~held[pairs[rows, side]], axis)
        entries = np.flatnonzero(held)
        self.total.border[:, entries] = 0.0
        for vector in (self.total.gradient, self.total.diagonal, self.total.rhs):
            vector[entries] = 0.0

    def step(
        self,
        state: kernels.BundleParameters,
        trial: kernels.BundleParameters,
        damping: float,
        cost: float,
    ) -> tuple[float, float, float]:
        """Write the next state to ``trial``.

        Returns its cost, the decrease (what has left the view counts as unchanged) and the
        decrease that the linear model promises. All infinite when there is no step.
        """
        diagonal = self.total.diagonal
        boost = np.where(diagonal > 0, damping * diagonal, 1.0)
        delta = self._solve_dense(boost) if self.dense else self._solve_sparse(boost)
        if not np.isfinite(delta).all():
            return np.inf, -np.inf, np.inf
        focals = delta[self.total.border.shape[1] :]
        np.clip(focals, -MAX_FOCAL_STEP, MAX_FOCAL_STEP, out=focals)
        for old, new in zip(state[:-1], trial[:-1], strict=True):
            np.copyto(new, old)
        kernels.update_cameras(delta, self.p.bundle.layout, state, trial)

        def move(n: int, first: int, last: int) -> tuple[float, float, float]:
            costs: tuple[float, float, float] = kernels.update_points(
                first,
                last,
                damping,
                self.tolerance,
                delta,
                self.p.bundle,
                state,
                trial,
                self.eliminated,
                self.scratch[n],
            )
            return costs

        visible, lost, promised = (float(x) for x in np.sum(self.run(move), axis=0))
        visible += self.p.scale_prior.cost(trial)
        promised += 0.5 * float(delta @ (boost * delta - self.total.gradient))
        return visible, cost - visible - lost, promised

    def _solve_dense(self, boost: Float64) -> Float64:
        if not len(boost):
            return boost
        matrix = np.zeros((len(boost), len(boost)))
        kernels.assemble_reduced_matrix(self.total, boost, self.p.bundle.layout.pair, matrix)
        # the transpose is in Fortran's order, so that nothing is copied
        _, solution, info = lapack.dposv(matrix.T, -self.total.rhs, lower=0, overwrite_a=1)
        return solution if info == 0 else np.full_like(boost, np.nan)

    def _solve_sparse(self, boost: Float64) -> Float64:
        """Conjugate gradients, preconditioned by the inverse of each pose's own block."""
        total = self.total
        poses = total.border.shape[1]
        own = np.triu(total.blocks[self.p.pairs[:, 0] == self.p.pairs[:, 1]])
        own += np.triu(own, 1).transpose(0, 2, 1)
        size = own.shape[-1]
        own[:, range(size), range(size)] += boost[:poses].reshape(-1, size)
        inverse = np.linalg.inv(own)
        corner = np.diagonal(total.corner) + boost[poses:]

        def multiply(x: Float64) -> Float64:
            out = np.empty_like(x)
            kernels.multiply_reduced_matrix(total, boost, self.p.pairs, x, out)
            return out

        def precondition(x: Float64) -> Float64:
            first = np.einsum("nab,nb->na", inverse, x[:poses].reshape(-1, size))
            return np.concatenate([first.ravel(), x[poses:] / corner])

        return _conjugate_gradients(multiply, precondition, -total.rhs)


def _conjugate_gradients(
    multiply: Callable[[Float64], Float64],
    precondition: Callable[[Float64], Float64],
    rhs: Float64,
) -> Float64:
    """Solve from 0 to :data:`CG_TOLERANCE` in the preconditioner's norm."""
    solution, residual = np.zeros_like(rhs), rhs.copy()
    direction = precondition(residual)
    energy = float(residual @ direction)
    enough = CG_TOLERANCE**2 * energy
    for _ in range(MAX_CG_ITERATIONS):
        if energy <= enough:
            break
        image = multiply(direction)
        length = energy / (direction @ image)
        solution += length * direction
        residual -= length * image
        corrected = precondition(residual)
        energy, last = float(residual @ corrected), energy
        direction = corrected + (energy / last) * direction
    return solution
