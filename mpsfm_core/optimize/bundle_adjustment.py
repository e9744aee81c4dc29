"""Bundle adjustment with depth regularization (paper 3.3, ``C_BA + C_reg``).

Minimizes over camera poses, 3D points and, if variable, focal lengths and log scales ``s`` of depth
maps::

    1/2 sum rho_r(|project(R X + t) - xy|^2 / std_px^2)
    + 1/2 sum rho_d((log z - log d - s)^2 / std^2) + 1/2 sum (s - expected)^2 / std_s^2
    + 1/2 sum (log f - log f_prior)^2 / std_f^2

by Levenberg-Marquardt (Triggs et al., Bundle Adjustment: A Modern Synthesis, 2000). The Schur
complement eliminates the points, the reduced camera system is solved, and back-substitution gives
the points. Afterwards each point takes steps of its own with fixed cameras.
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
"""Smallest damping; it keeps unobserved parameters, as the depth of a single-view point. [ours]"""
MAX_DAMPING = 1e16
"""Damping above which the solver gives up. [ours]"""
MAX_FOCAL_STEP = 1.0
"""Largest change of a log focal length per step. [ours]"""
CG_TOLERANCE = 1e-3
"""Relative tolerance of conjugate gradients on the reduced camera system. [ours]"""
MAX_CG_ITERATIONS = 500
"""Maximum number of conjugate-gradient iterations per step. [ours]"""
MIN_GAIN = 1e-3
"""Smallest ratio of actual and predicted decrease of an accepted step.
[Ceres min_relative_decrease]"""


@dataclass(frozen=True, eq=False)
class BundleResult:
    """Adjusted parameters in the order of the problem, and the summary of the solver."""

    rotations: Float64
    translations: Float64
    log_scales: Float64
    intrinsics: Float64
    points: Float64
    std_log_focals: Float64
    """(k,) posterior standard deviation of each variable log focal length, from the inverse of the
    reduced camera system at the solution. NaN if constant, infinite if undetermined."""
    initial_cost: float
    final_cost: float
    iterations: int
    """Number of steps, accepted or rejected."""
    converged: bool
    """False if the iteration limit was reached or no step decreases the cost."""
    message: str
    """Reason of the termination."""


def adjust_bundle(problem: BundleProblem, options: BundleOptions | None = None) -> BundleResult:
    """Adjust poses, points, focal lengths and depth scales; the cost never increases.

    An observation whose point is behind its camera, or more than 89.9999 degrees off its axis, has
    residual 0, as in COLMAP. A step that makes an observation invisible is charged its former cost.
    The result does not depend on the number of threads, bit for bit.

    Args:
        problem: Parameters and observations; they are copied.
        options: Losses and solver options.

    Returns:
        The adjusted parameters.

    Raises:
        DataError: An array has a wrong shape, an index is out of range, a value is not finite, or a
            standard deviation is not positive.
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
    # nested BLAS threads are slow; the controller is cached because its creation takes milliseconds
    return ThreadpoolController()


def _minimize(p: PreparedBundle, options: BundleOptions, run: RangeExecutor) -> BundleResult:
    """Minimize by Levenberg-Marquardt with Nielsen's damping schedule, as Ceres."""
    state, trial = p.state, kernels.BundleParameters(*(np.empty_like(array) for array in p.state))
    normal = SchurComplementSolver(p, options, run)
    damping, growth = INITIAL_DAMPING, 2.0
    initial_cost = np.inf
    converged, message = False, "iteration limit reached"
    for iteration in range(1, options.max_iterations + 1):
        cost = normal.linearize(state, damping)
        initial_cost = cost if iteration == 1 else initial_cost
        trial_cost, decrease, predicted = normal.step(state, trial, damping, cost)
        min_decrease = max(options.function_tolerance, np.finfo(float).eps) * cost
        if np.isfinite(decrease) and decrease >= max(MIN_GAIN * predicted, 0.0):
            state, trial, cost = trial, state, trial_cost
            gain = min(decrease / predicted, 1.0) if predicted > 0 else 1.0
            damping = max(damping * max(1 / 3, 1 - (2 * gain - 1) ** 3), MIN_DAMPING)
            growth = 2.0
            converged = bool(decrease <= min_decrease)
        else:
            damping *= growth
            growth *= 2.0
            converged = bool(predicted <= min_decrease)
        if converged:
            message = "cost change below the tolerance"
            break
        if damping > MAX_DAMPING:
            message = "no step lowers the cost"
            break
    stds = normal.compute_focal_stds(state)
    return BundleResult(*state, stds, initial_cost, cost, iteration, converged, message)


class SchurComplementSolver:
    """Normal equations of one adjustment, solved by the Schur complement; reuses its buffers."""

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
        """Linearize at ``state``, eliminate the points, and return the cost."""

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
            for array, summand in zip(self.total, part, strict=True):
                array += summand
        self._add_scale_prior(state)
        self._add_focal_prior(state)
        self.total.rhs[:] += self.total.gradient
        self._fix_constants()
        return cost + self.p.scale_prior.cost(state) + self.p.focal_prior.cost(state)

    def _add_scale_prior(self, state: kernels.BundleParameters) -> None:
        """Add the prior of the log scales to the reduced camera system."""
        prior, layout = self.p.scale_prior, self.p.bundle.layout
        rows = kernels.NUM_IMAGE_PARAMS * prior.slot + kernels.LOG_SCALE_IDX
        block = layout.pair[prior.slot, prior.slot]
        self.total.blocks[block, kernels.LOG_SCALE_IDX, kernels.LOG_SCALE_IDX] += prior.weight
        self.total.diagonal[rows] += prior.weight
        residuals = state.log_scales[prior.image] - prior.log_scale
        self.total.gradient[rows] += prior.weight * residuals

    def _add_focal_prior(self, state: kernels.BundleParameters) -> None:
        """Add the prior of the log focal lengths to the reduced camera system."""
        prior, num_poses = self.p.focal_prior, len(self.p.bundle.layout.pair)
        rows = kernels.NUM_IMAGE_PARAMS * num_poses + prior.slot
        self.total.corner[prior.slot, prior.slot] += prior.weight
        self.total.diagonal[rows] += prior.weight
        self.total.gradient[rows] += prior.weight * prior.residuals(state)

    def compute_focal_stds(self, state: kernels.BundleParameters) -> Float64:
        """Compute the posterior standard deviation of each log focal length.

        Its square is an entry of the diagonal of the inverse reduced camera system.

        Args:
            state: Parameters at which the problem is linearized.

        Returns:
            (k,) NaN for constant focal lengths, infinite for undetermined ones.
        """
        slots = self.p.bundle.layout.focal_slot
        stds = np.full(len(slots), np.nan)
        cameras = np.flatnonzero(slots >= 0)
        if not len(cameras):
            return stds
        self.linearize(state, MIN_DAMPING)
        diagonal = self.total.diagonal
        boost = np.where(diagonal > 0, MIN_DAMPING * diagonal, 1.0)
        rows = kernels.NUM_IMAGE_PARAMS * len(self.p.bundle.layout.pair) + slots[cameras]
        units = np.zeros((len(diagonal), len(rows)))
        units[rows, np.arange(len(rows))] = 1.0
        if self.dense:
            columns = self._solve_dense(boost, units)
        else:
            columns = np.stack([self._solve_sparse(boost, unit) for unit in units.T], axis=1)
        variances = columns[rows, np.arange(len(rows))]
        determined = (diagonal[rows] > 0) & (variances > 0)
        stds[cameras] = np.where(determined, np.sqrt(np.where(determined, variances, 1)), np.inf)
        return stds

    def _fix_constants(self) -> None:
        """Remove the constant parameters of images with a slot from the system."""
        held, pairs, blocks = self.p.held, self.p.pairs, self.total.blocks
        has_constant = np.asarray(held.any(axis=1))
        for side, axis in ((0, 2), (1, 1)):
            rows = np.flatnonzero(has_constant[pairs[:, side]])
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
        """Write the next parameters to ``trial``.

        Returns:
            Cost of the visible observations, decrease (observations that become invisible count as
            unchanged) and predicted decrease; infinite if the system has no finite solution.
        """
        diagonal = self.total.diagonal
        boost = np.where(diagonal > 0, damping * diagonal, 1.0)
        solve = self._solve_dense if self.dense else self._solve_sparse
        delta = solve(boost, -self.total.rhs)
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

        visible, lost, predicted = (float(x) for x in np.sum(self.run(move), axis=0))
        visible += self.p.scale_prior.cost(trial) + self.p.focal_prior.cost(trial)
        predicted += 0.5 * float(delta @ (boost * delta - self.total.gradient))
        return visible, cost - visible - lost, predicted

    def _solve_dense(self, boost: Float64, rhs: Float64) -> Float64:
        if not len(boost):
            return boost
        matrix = np.zeros((len(boost), len(boost)))
        kernels.assemble_reduced_matrix(self.total, boost, self.p.bundle.layout.pair, matrix)
        # the transpose is in Fortran's order, so that nothing is copied
        _, solution, info = lapack.dposv(matrix.T, rhs, lower=0, overwrite_a=1)
        return solution if info == 0 else np.full_like(boost, np.nan)

    def _solve_sparse(self, boost: Float64, rhs: Float64) -> Float64:
        """Solve by conjugate gradients with a block-Jacobi preconditioner."""
        total = self.total
        poses = total.border.shape[1]
        diagonal = np.triu(total.blocks[self.p.pairs[:, 0] == self.p.pairs[:, 1]])
        diagonal += np.triu(diagonal, 1).transpose(0, 2, 1)
        size = diagonal.shape[-1]
        diagonal[:, range(size), range(size)] += boost[:poses].reshape(-1, size)
        inverse = np.linalg.inv(diagonal)
        corner = np.diagonal(total.corner) + boost[poses:]

        def multiply(x: Float64) -> Float64:
            out = np.empty_like(x)
            kernels.multiply_reduced_matrix(total, boost, self.p.pairs, x, out)
            return out

        def precondition(x: Float64) -> Float64:
            first = np.einsum("nab,nb->na", inverse, x[:poses].reshape(-1, size))
            return np.concatenate([first.ravel(), x[poses:] / corner])

        return _conjugate_gradients(multiply, precondition, rhs)


def _conjugate_gradients(
    multiply: Callable[[Float64], Float64],
    precondition: Callable[[Float64], Float64],
    rhs: Float64,
) -> Float64:
    """Solve from 0 to a relative residual of ``CG_TOLERANCE`` in the norm of the preconditioner."""
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
