"""Bundle adjustment with depth regularization (paper 3.3, ``C_BA + C_reg``).

The variables are camera poses, 3D points and, optionally, intrinsic parameters ``q`` (log focal
length, principal point, distortion coefficients) and log scales ``s`` of depth maps. Bundle
adjustment minimizes::

    1/2 sum rho_r(|project(R X + t) - xy|^2 / std_px^2)
    + 1/2 sum rho_d((log z - log d - s)^2 / std^2) + 1/2 sum (s - expected)^2 / std_s^2
    + 1/2 sum (q - q_prior)^2 / std_q^2

The optimizer is Levenberg-Marquardt (Triggs et al., "Bundle Adjustment -- A Modern Synthesis",
2000). Each step eliminates the 3D points with the Schur complement, solves the reduced camera
system, and recovers the points by back-substitution. After each joint step, the points are
optimized individually with fixed cameras. Robust losses are replaced by their IRLS majorizers,
whose minimum is too near. With many poses, the steps of the cameras are lengthened
(over-relaxation). With few poses, longer steps lead to wrong local minima more often.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from typing import NamedTuple

import numpy as np
from scipy.linalg import lapack
from scipy.sparse import bsr_array, csc_array
from scipy.sparse.linalg import SuperLU, splu
from threadpoolctl import ThreadpoolController

from mpsfm_core.data import Float64, Int64
from mpsfm_core.data.camera_models import IntrinsicParameter
from mpsfm_core.geometry import camera_center
from mpsfm_core.optimize import bundle_kernels as kernels
from mpsfm_core.optimize.bundle_problem import (
    BundleProblem,
    PreparedBundle,
    RangeExecutor,
    prepare_bundle,
    range_executor,
)
from mpsfm_core.optimize.coarse_correction import Clusters, CoarseSpace
from mpsfm_core.optimize.options import BundleOptions
from mpsfm_core.optimize.rig_basis import RigBasis, RigConstraint

__all__ = ["BundleProblem", "BundleResult", "adjust_bundle"]

INITIAL_DAMPING = 1e-4
"""Levenberg-Marquardt damping of the first step. [Ceres 1 / initial_trust_region_radius]"""
INITIAL_DAMPING_MANY_POSES = 1e-6
"""Levenberg-Marquardt damping of the first step with more than ``BundleOptions.dense_poses`` poses,
where damping slows down the correction of drift. [tuned: benchmarks.scale]"""
MIN_DAMPING = 1e-10
"""Minimum Levenberg-Marquardt damping, which keeps unobserved parameters constant. [ours]"""
MAX_DAMPING = 1e16
"""Levenberg-Marquardt damping above which bundle adjustment stops. [ours]"""
MAX_FOCAL_STEP = 1.0
"""Largest change of a log focal length per Levenberg-Marquardt step. [ours]"""
MAX_DISTORTION_STEP = 0.1
"""Largest change of a distortion coefficient per Levenberg-Marquardt step. [ours]"""
CG_TOLERANCE = 1e-2
"""Relative tolerance of conjugate gradients on the reduced camera system. Inexact steps reach the
minimum earlier. [tuned: benchmarks.scale]"""
MAX_CG_ITERATIONS = 500
"""Maximum number of conjugate-gradient iterations per Levenberg-Marquardt step. [ours]"""
MAX_FACTORIZATION_ITERATIONS = 2000
"""Number of conjugate-gradient iterations whose time a sparse factorization may take at most.
[tuned: benchmarks.scale]"""
FACTORIZATION_COST = 0.4
"""Time of an arithmetic operation of a sparse factorization, relative to conjugate gradients.
[tuned: benchmarks.scale]"""
ENOUGH_FACTOR_ITERATIONS = 20
"""Number of conjugate-gradient iterations with a factorization of an earlier system as
preconditioner, after which the system is factorized again. [tuned: benchmarks.walks]"""
MAX_RIG_POSES = 500
"""Maximum number of variable poses for the standard deviation of the scale of a rig, which needs a
dense factorization. [ours]"""
MIN_GAIN = 1e-3
"""Smallest ratio of the actual and the predicted decrease of the cost for a step to be accepted.
[Ceres min_relative_decrease]"""
MAX_RELAXATION = 1.7
"""Largest factor on the camera step of the normal equations. Factors below 2 decrease the cost of a
quadratic majorizer. [tuned: benchmarks.walks, benchmarks.real_photos]"""


@dataclass(frozen=True, eq=False)
class BundleResult:
    """Adjusted poses, points, intrinsics and depth scales, with a summary of the solver."""

    rotations: Float64
    translations: Float64
    log_scales: Float64
    intrinsics: Float64
    distortion: Float64
    points: Float64
    std_intrinsics: Float64
    """(k, 8) posterior standard deviation of each variable intrinsic parameter, from the inverse of
    the reduced camera system at the solution. The standard deviation is NaN for a constant and
    infinite for an undetermined intrinsic parameter."""
    initial_cost: float
    final_cost: float
    iterations: int
    """Number of accepted and rejected Levenberg-Marquardt steps."""
    converged: bool
    """False if bundle adjustment reached the iteration limit or found no step that decreases the
    cost."""
    message: str
    """Reason why the Levenberg-Marquardt solver stopped."""
    rig: RigConstraint | None = None
    """Rig with the adjusted scale and the adjusted poses ``sensor_from_rig``, or None without a
    rig."""
    std_rig_scale: float = np.inf
    """Posterior standard deviation of the scale of the rig in world units per meter, infinite if
    the scale is constant or undetermined, or with more than ``MAX_RIG_POSES`` poses."""


def start_at(problem: BundleProblem, result: BundleResult) -> BundleProblem:
    """Return the bundle adjustment problem with the parameters of a result as initial values."""
    return replace(
        problem,
        rig=result.rig,
        rotations=result.rotations,
        translations=result.translations,
        log_scales=result.log_scales,
        intrinsics=result.intrinsics,
        distortion=result.distortion,
        points=result.points,
    )


def adjust_bundle(problem: BundleProblem, options: BundleOptions | None = None) -> BundleResult:
    """Adjust poses, points, intrinsics and depth scales; the cost never increases.

    As in COLMAP, an observation whose point is behind the camera, or more than 89.9999 degrees off
    the optical axis, has residual 0. An observation where distortion folds the image over also has
    residual 0. If a solver step makes an observation invisible, the observation keeps its previous
    cost. The adjusted parameters do not depend on the number of threads, bit for bit.

    Args:
        problem: Initial parameters and observations of bundle adjustment, which stay unchanged.
        options: Robust losses and solver options of bundle adjustment.

    Returns:
        The adjusted parameters.

    Raises:
        DataError: An array of ``problem`` has a wrong shape, an index out of range, a value that is
            not finite, or a standard deviation that is not positive.
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
    # BLAS threads within worker threads are slow. Creating the thread controller takes
    # milliseconds, so the controller is cached.
    return ThreadpoolController()


def _minimize(p: PreparedBundle, options: BundleOptions, run: RangeExecutor) -> BundleResult:
    """Minimize the cost by Levenberg-Marquardt with Nielsen's damping schedule, as Ceres does."""
    state, trial = p.state, kernels.BundleParameters(*(np.empty_like(array) for array in p.state))
    normal = SchurComplementSolver(p, options, run)
    damping = INITIAL_DAMPING if normal.dense else INITIAL_DAMPING_MANY_POSES
    growth, relaxation = 2.0, 1.0
    initial_cost = np.inf
    converged, message = False, "iteration limit reached"
    for iteration in range(1, options.max_iterations + 1):
        cost = normal.linearize(state, damping)
        initial_cost = cost if iteration == 1 else initial_cost
        step = normal.step(state, trial, damping, relaxation, cost)
        min_decrease = max(options.function_tolerance, np.finfo(float).eps) * cost
        if np.isfinite(step.decrease) and step.decrease >= max(MIN_GAIN * step.predicted, 0.0):
            state, trial, cost = trial, state, step.cost
            normal.accept_step(state)
            gain = min(step.decrease / step.predicted, 1.0) if step.predicted > 0 else 1.0
            damping = max(damping * max(1 / 3, 1 - (2 * gain - 1) ** 3), MIN_DAMPING)
            growth = 2.0
            if not normal.dense:
                relaxation = step.choose_relaxation(relaxation)
            converged = bool(step.decrease <= min_decrease)
        else:
            damping *= growth
            growth *= 2.0
            relaxation = 1.0
            converged = bool(step.predicted <= min_decrease)
        if converged:
            message = "cost change below the tolerance"
            break
        if damping > MAX_DAMPING:
            message = "no step lowers the cost"
            break
    stds, std_rig_scale = normal.compute_intrinsic_stds(state), normal.compute_rig_scale_std(state)
    return BundleResult(
        *state, stds, initial_cost, cost, iteration, converged, message, normal.rig, std_rig_scale
    )


class TrialStep(NamedTuple):
    """Costs of a trial step of all parameters."""

    cost: float
    """Cost after the step; infinite if the reduced camera system has no finite solution."""
    decrease: float
    """Decrease of the cost, where observations that became invisible are unchanged."""
    predicted: float
    """Decrease of the cost that the quadratic model predicts."""
    slope: float
    """First-order decrease of the cost along the unrelaxed camera step, if the points stay optimal.
    The curvature of the quadratic model along this step has the same value."""

    def choose_relaxation(self, relaxation: float) -> float:
        """Return the relaxation with which this step would have minimized the cost.

        The next step uses this relaxation. The curvature of the cost along the camera step follows
        from the difference of the actual and the predicted decrease.

        Args:
            relaxation: Relaxation of this step.
        """
        curvature = self.slope - 2 * (self.decrease - self.predicted) / relaxation**2
        if MAX_RELAXATION * curvature <= self.slope:
            return MAX_RELAXATION
        return max(self.slope / curvature, 1.0)


class SchurComplementSolver:
    """Normal equations of a bundle adjustment, which the Schur complement solves."""

    def __init__(self, p: PreparedBundle, options: BundleOptions, run: RangeExecutor) -> None:
        layout = p.bundle.layout
        poses, intrinsics = layout.num_poses, int(layout.intrinsic_slot.max(initial=-1)) + 1
        size = kernels.NUM_IMAGE_PARAMS * poses + intrinsics
        view = int(kernels.NUM_IMAGE_PARAMS)
        block, border = (len(p.pairs), view, view), (intrinsics, view * poses)
        shapes = block, border, (intrinsics, intrinsics), size, size, size
        self.parts = [
            kernels.ReducedCameraSystem(*(np.empty(shape) for shape in shapes)) for _ in p.ranges
        ]
        self.scratch = [kernels.allocate_buffers(p.longest) for _ in p.ranges]
        self.total = self.parts[0]
        self.eliminated = np.empty((len(p.state.points), 10))
        self.p = p
        self.run = run
        self.dense = poses <= options.dense_poses
        self._factor: Callable[[Float64], Float64] | None = None
        self._clusters: Clusters | None = None
        self._enough_iterations, self._can_factorize = MAX_CG_ITERATIONS, False
        if not self.dense and p.rig is None:
            self._clusters = Clusters.of_cameras(camera_center(*self._variable_poses(p.state)))
            enough = count_enough_iterations(p.pairs, poses)
            self._enough_iterations = min(enough, MAX_CG_ITERATIONS)
            self._can_factorize = enough <= MAX_FACTORIZATION_ITERATIONS
        self.tolerance = options.function_tolerance
        self.rig, self.basis = p.rig, self._build_basis(p.rig, p.state)
        self._trial_rig = p.rig

    def _build_basis(
        self, rig: RigConstraint | None, state: kernels.BundleParameters
    ) -> RigBasis | None:
        """Return the map from steps of the rig to steps of images, or None without a rig."""
        if rig is None:
            return None
        return RigBasis.build(rig, self.p.bundle.layout, self.p.rig_gauge, state.translations)

    def _variable_poses(self, state: kernels.BundleParameters) -> tuple[Float64, Float64]:
        """Return rotations (s, 3, 3) and translations (s, 3) of the variable poses."""
        is_variable = self.p.bundle.layout.pose_slot >= 0
        return state.rotations[is_variable], state.translations[is_variable]

    def accept_step(self, state: kernels.BundleParameters) -> None:
        """Update the rig to the accepted parameters ``state`` of the last step."""
        self.rig = self._trial_rig
        if self.rig is not None and self.rig.num_variable_sensors:
            self.basis = self._build_basis(self.rig, state)

    def linearize(self, state: kernels.BundleParameters, damping: float) -> float:
        """Linearize the residuals at ``state``, eliminate the 3D points, and return the cost."""

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
        if self._clusters is not None:
            self._poses = self._variable_poses(state)
        self.total = self.parts[0]
        for part in self.parts[1:]:
            for array, summand in zip(self.total, part, strict=True):
                array += summand
        self._add_scale_prior(state)
        self._add_intrinsic_prior(state)
        self.total.rhs[:] += self.total.gradient
        self._fix_constants()
        return cost + self._prior_cost(state)

    def _prior_cost(self, state: kernels.BundleParameters) -> float:
        """Return the cost of the priors on depth scales and intrinsic parameters."""
        return self.p.scale_prior.cost(state) + self.p.intrinsic_prior.cost(state)

    def _add_scale_prior(self, state: kernels.BundleParameters) -> None:
        """Add the prior of the depth maps' log scales to the reduced camera system."""
        prior, layout = self.p.scale_prior, self.p.bundle.layout
        rows = kernels.NUM_IMAGE_PARAMS * prior.slot + kernels.LOG_SCALE_IDX
        block = layout.first_block[prior.slot]
        self.total.blocks[block, kernels.LOG_SCALE_IDX, kernels.LOG_SCALE_IDX] += prior.weight
        self.total.diagonal[rows] += prior.weight
        residuals = state.log_scales[prior.image] - prior.log_scale
        self.total.gradient[rows] += prior.weight * residuals

    def _add_intrinsic_prior(self, state: kernels.BundleParameters) -> None:
        """Add the prior of intrinsic parameters to the reduced camera system."""
        prior = self.p.intrinsic_prior
        rows = kernels.NUM_IMAGE_PARAMS * self.p.bundle.layout.num_poses + prior.slot
        self.total.corner[prior.slot, prior.slot] += prior.weight
        self.total.diagonal[rows] += prior.weight
        self.total.gradient[rows] += prior.weight * prior.residuals(state)

    def compute_intrinsic_stds(self, state: kernels.BundleParameters) -> Float64:
        """Compute the posterior standard deviation of intrinsic parameters.

        The posterior variance of an intrinsic parameter is a diagonal entry of the inverse reduced
        camera system.

        Args:
            state: Poses, points, intrinsics and depth scales at which the residuals are linearized.

        Returns:
            (k, 8) posterior standard deviations, NaN for constant and infinite for undetermined
            parameters.
        """
        slots = self.p.bundle.layout.intrinsic_slot
        stds, variable = np.full(slots.shape, np.nan), slots >= 0
        if not variable.any():
            return stds
        self.linearize(state, MIN_DAMPING)
        diagonal = self.total.diagonal
        boost = np.where(diagonal > 0, MIN_DAMPING * diagonal, 1.0)
        rows = kernels.NUM_IMAGE_PARAMS * self.p.bundle.layout.num_poses + slots[variable]
        units = np.zeros((len(diagonal), len(rows)))
        units[rows, np.arange(len(rows))] = 1.0
        solve = self._solve_dense if self.dense else self._solve_sparse
        columns = self._expand(solve(boost, units))
        variances = columns[rows, np.arange(len(rows))]
        determined = (diagonal[rows] > 0) & (variances > 0)
        stds[variable] = np.where(determined, np.sqrt(np.where(determined, variances, 1)), np.inf)
        return stds

    def compute_rig_scale_std(self, state: kernels.BundleParameters) -> float:
        """Compute the posterior standard deviation of the scale of the rig, or infinity."""
        basis, num_poses = self.basis, self.p.bundle.layout.num_poses
        if basis is None or basis.scale_column is None or num_poses > MAX_RIG_POSES:
            return np.inf
        self.linearize(state, MIN_DAMPING)
        diagonal = self.total.diagonal
        boost = np.where(diagonal > 0, MIN_DAMPING * diagonal, 1.0)
        matrix = np.zeros((len(boost), len(boost)))
        kernels.assemble_reduced_matrix(self.total, boost, self.p.pairs, matrix)
        return float(np.sqrt(basis.compute_scale_variance(matrix)))

    def _fix_constants(self) -> None:
        """Remove constant parameters of images from the reduced camera system."""
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
        relaxation: float,
        cost: float,
    ) -> TrialStep:
        """Compute a Levenberg-Marquardt step from ``state`` and write the result to ``trial``.

        Args:
            state: Parameters at which the residuals are linearized.
            trial: Receives the parameters after the step.
            damping: Levenberg-Marquardt damping.
            relaxation: Factor on the camera step.
            cost: Cost at ``state``.
        """
        diagonal = self.total.diagonal
        boost = np.where(diagonal > 0, damping * diagonal, 1.0)
        solve = self._solve_dense if self.dense else self._solve_sparse
        steps = solve(boost, -self.total.rhs)
        if not np.isfinite(steps).all():
            return TrialStep(np.inf, -np.inf, np.inf, 0.0)
        steps *= relaxation
        delta = self._expand(steps)
        self._limit_intrinsic_steps(delta)
        for old, new in zip(state[:-1], trial[:-1], strict=True):
            np.copyto(new, old)
        kernels.update_cameras(delta, self.p.bundle.layout, state, trial)
        self._retract_rig(state, trial, steps)

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
        visible += self._prior_cost(trial)
        slope = -float(delta @ self.total.rhs) / relaxation
        predicted += 0.5 * float(delta @ (boost * delta - self.total.gradient))
        predicted -= 0.5 * (relaxation - 1) * relaxation * slope
        return TrialStep(visible, cost - visible - lost, predicted, slope)

    def _expand(self, steps: Float64) -> Float64:
        """Return the steps of the reduced camera system for steps of the rig's parameters."""
        if self.basis is None:
            return steps
        expanded: Float64 = self.basis.matrix @ steps
        return expanded

    def _retract_rig(
        self, state: kernels.BundleParameters, trial: kernels.BundleParameters, steps: Float64
    ) -> None:
        """Compute the rig of a trial step; with variable sensors, the poses of images, too."""
        rig, basis = self.rig, self.basis
        if rig is None or basis is None:
            return
        if rig.num_variable_sensors:
            self._trial_rig, rotations, translations = rig.retract(
                state.rotations, state.translations, basis, steps
            )
            np.copyto(trial.rotations, rotations)
            np.copyto(trial.translations, translations)
        elif basis.scale_column is not None:
            self._trial_rig = replace(rig, scale=rig.scale + float(steps[basis.scale_column]))

    def _limit_intrinsic_steps(self, delta: Float64) -> None:
        """Limit the changes of focal lengths and distortion in a step ``delta`` (d,)."""
        slots, first = self.p.bundle.layout.intrinsic_slot, self.total.border.shape[1]
        focals = slots[:, IntrinsicParameter.FOCAL_LENGTH : IntrinsicParameter.ASPECT_RATIO + 1]
        coefficients = slots[:, IntrinsicParameter.RADIAL_DISTORTION :]
        for limited, limit in ((focals, MAX_FOCAL_STEP), (coefficients, MAX_DISTORTION_STEP)):
            rows = first + limited[limited >= 0]
            delta[rows] = np.clip(delta[rows], -limit, limit)

    def _solve_dense(self, boost: Float64, rhs: Float64) -> Float64:
        if not len(boost):
            return boost
        matrix = np.zeros((len(boost), len(boost)))
        kernels.assemble_reduced_matrix(self.total, boost, self.p.pairs, matrix)
        if self.basis is not None:
            return self.basis.solve_dense(matrix, rhs)
        # LAPACK does not copy the transposed matrix, because the transpose has Fortran's memory
        # order.
        _, solution, info = lapack.dposv(matrix.T, rhs, lower=0, overwrite_a=1)
        return solution if info == 0 else np.full_like(boost, np.nan)

    def _solve_sparse(self, boost: Float64, rhs: Float64) -> Float64:
        """Solve the reduced camera system by preconditioned conjugate gradients.

        Conjugate gradients with block-Jacobi preconditioner converge slowly for long chains of
        images, as in a video or along streets. If conjugate gradients do not converge in as many
        iterations as take the time of a factorization (:func:`count_enough_iterations`), this
        system is factorized, unless that takes longer than ``MAX_FACTORIZATION_ITERATIONS``. The
        factorization is the preconditioner of later systems, which differ less and less.

        Args:
            boost: (d,) Levenberg-Marquardt damping, which is added to the diagonal.
            rhs: (d,) or (d, k) right-hand sides.

        Returns:
            (e,) or (e, k) solutions, whose length is that of the parameters of the rig if any.
        """
        solutions = []
        for column in rhs.reshape(len(rhs), -1).T:
            solution, converged = self._iterate(boost, column)
            if self._can_factorize and not converged:
                self._factor = None  # frees the memory before the next factorization
                self._factor = self._factorize(boost)
                solution = self._factor(column)
            solutions.append(solution)
        stacked: Float64 = np.stack(solutions, axis=1)
        return stacked.reshape(-1, *rhs.shape[1:])

    def _damped_diagonal(self, boost: Float64) -> Float64:
        """Return the damped diagonal blocks (s, 7, 7) of the poses."""
        total = self.total
        diagonal: Float64 = np.triu(total.blocks[self.p.pairs[:, 0] == self.p.pairs[:, 1]])
        diagonal += np.triu(diagonal, 1).transpose(0, 2, 1)
        size = diagonal.shape[-1]
        damping = boost[: total.border.shape[1]].reshape(-1, size)
        diagonal[:, range(size), range(size)] += damping
        return diagonal

    def _factorize(self, boost: Float64) -> Callable[[Float64], Float64]:
        """Factorize the reduced camera system, and return a function that solves it.

        The intrinsic parameters are eliminated last, because they have dense rows. The solutions of
        a singular system are NaN.
        """
        total = self.total
        num_poses, border = total.border.shape[1], total.border.copy()
        try:
            factor = _factorize_symmetric(self._assemble_poses(boost))
        except RuntimeError:  # the matrix is singular
            return lambda rhs: np.full_like(rhs, np.nan)
        by_border = factor.solve(np.ascontiguousarray(border.T))
        corner = total.corner + np.diag(boost[num_poses:]) - border @ by_border

        def solve(rhs: Float64) -> Float64:
            of_poses = factor.solve(rhs[:num_poses])
            of_intrinsics = np.linalg.solve(corner, rhs[num_poses:] - border @ of_poses)
            return np.concatenate([of_poses - by_border @ of_intrinsics, of_intrinsics])

        return solve

    def _assemble_poses(self, boost: Float64) -> csc_array:
        """Return the part of the damped reduced camera system that contains only poses."""
        total, pairs = self.total, self.p.pairs
        num_poses, is_diagonal = total.border.shape[1], pairs[:, 0] == pairs[:, 1]
        off_diagonal = total.blocks[~is_diagonal]
        rows, columns = np.concatenate(
            [pairs[is_diagonal], pairs[~is_diagonal], pairs[~is_diagonal, ::-1]], dtype=np.intc
        ).T  # SuperLU copies indices of another type
        blocks = np.concatenate(
            [self._damped_diagonal(boost), off_diagonal, off_diagonal.transpose(0, 2, 1)]
        )
        order = np.lexsort((columns, rows))
        starts = np.searchsorted(rows[order], np.arange(self.p.bundle.layout.num_poses + 1))
        starts = starts.astype(np.intc)
        matrix = bsr_array((blocks[order], columns[order], starts), shape=(num_poses, num_poses))
        return matrix.tocsr().T  # the matrix is symmetric, and transposing copies nothing

    def _iterate(self, boost: Float64, rhs: Float64) -> tuple[Float64, bool]:
        """Solve the reduced camera system by preconditioned conjugate gradients.

        The preconditioner is the last factorization, or else block Jacobi, with a coarse correction
        for images without rigs.

        Args:
            boost: (d,) Levenberg-Marquardt damping, which is added to the diagonal.
            rhs: (d,) right-hand side.

        Returns:
            The solution (d,), and whether conjugate gradients converged.
        """
        total = self.total
        poses = total.border.shape[1]
        diagonal = self._damped_diagonal(boost)
        size = diagonal.shape[-1]
        corner = np.diagonal(total.corner) + boost[poses:]

        bounds = np.linspace(0, len(self.p.pairs), len(self.p.ranges) + 1).astype(np.int64)

        def multiply(x: Float64) -> Float64:
            of_poses, of_intrinsics = x[:poses], x[poses:]

            def multiply_pairs(n: int, *_: int) -> Float64:
                out = np.zeros(poses)
                kernels.multiply_pose_pairs(
                    bounds[n], bounds[n + 1], total.blocks, self.p.pairs, of_poses, out
                )
                return out

            products = np.einsum("nab,nb->na", diagonal, of_poses.reshape(-1, size)).ravel()
            products += of_intrinsics @ total.border
            for product in self.run(multiply_pairs):
                products += product
            others = total.border @ of_poses + total.corner @ of_intrinsics
            return np.concatenate([products, others + boost[poses:] * of_intrinsics])

        if self._factor is not None:
            return _conjugate_gradients(multiply, self._factor, rhs, ENOUGH_FACTOR_ITERATIONS)
        basis = self.basis
        if basis is not None:
            blocks = total.blocks.copy()
            blocks[self.p.pairs[:, 0] == self.p.pairs[:, 1]] = diagonal
            entries = np.concatenate([np.einsum("nii->ni", diagonal).ravel(), corner])
            return _conjugate_gradients(
                lambda x: basis.matrix.T @ multiply(basis.matrix @ x),
                basis.create_preconditioner(blocks, self.p.pairs, entries),
                basis.matrix.T @ rhs,
                self._enough_iterations,
            )
        inverse = np.linalg.inv(diagonal)
        assert self._clusters is not None  # images without rigs
        space = CoarseSpace.build(self._clusters, *self._poses, self.p.held)
        correct = space.project(total.blocks, self.p.pairs, diagonal)

        def precondition(x: Float64) -> Float64:
            of_poses = np.einsum("nab,nb->na", inverse, x[:poses].reshape(-1, size)).ravel()
            of_poses += correct(x[:poses])
            return np.concatenate([of_poses, x[poses:] / corner])

        return _conjugate_gradients(multiply, precondition, rhs, self._enough_iterations)


def count_enough_iterations(pairs: Int64, num_poses: int) -> int:
    """Count the iterations of conjugate gradients that take as long as a sparse factorization.

    The factorization of a matrix with one entry for each block of the reduced camera system has the
    same fill, and gives the number of arithmetic operations. The number of operations of an
    iteration is proportional to the number of blocks.

    Args:
        pairs: (s, 2) indices of two poses of each block, among them those on the diagonal.
        num_poses: Number of poses.

    Returns:
        Number of iterations.
    """
    a, b = pairs[pairs[:, 0] != pairs[:, 1]].T
    nodes = np.arange(num_poses)
    rows, columns = np.concatenate([a, b, nodes]), np.concatenate([b, a, nodes])
    entries = np.where(rows == columns, num_poses, -1.0)  # diagonally dominant, thus regular
    factor = _factorize_symmetric(csc_array((entries, (rows, columns)), shape=(num_poses,) * 2))
    lengths = np.diff(factor.L.indptr).astype(np.float64)
    num_operations = int(kernels.NUM_IMAGE_PARAMS) * float(lengths @ lengths) / len(rows)
    return round(FACTORIZATION_COST * num_operations)


def _factorize_symmetric(matrix: csc_array) -> SuperLU:
    """Factorize a symmetric positive definite matrix by SuperLU with minimum-degree ordering."""
    return splu(
        matrix,
        permc_spec="MMD_AT_PLUS_A",
        diag_pivot_thresh=0.0,
        options={"SymmetricMode": True},
    )


def _conjugate_gradients(
    multiply: Callable[[Float64], Float64],
    precondition: Callable[[Float64], Float64],
    rhs: Float64,
    max_iterations: int,
) -> tuple[Float64, bool]:
    """Solve a linear system by conjugate gradients to the relative residual ``CG_TOLERANCE``.

    Returns:
        The solution, and whether its residual is small enough.
    """
    solution, residual = np.zeros_like(rhs), rhs.copy()
    direction = precondition(residual)
    energy = float(residual @ direction)
    enough = CG_TOLERANCE**2 * energy
    for _ in range(max_iterations):
        if energy <= enough:
            break
        image = multiply(direction)
        length = energy / (direction @ image)
        solution += length * direction
        residual -= length * image
        corrected = precondition(residual)
        energy, last = float(residual @ corrected), energy
        direction = corrected + (energy / last) * direction
    return solution, energy <= enough
