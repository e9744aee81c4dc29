"""Tests of derivatives and Schur elimination against finite differences and dense algebra."""

from dataclasses import replace

import numpy as np
import pytest

from mpsfm_core.data import Float64
from mpsfm_core.optimize import bundle_kernels as kernels
from mpsfm_core.optimize.bundle_adjustment import (
    MAX_RELAXATION,
    BundleProblem,
    SchurComplementSolver,
    TrialStep,
)
from mpsfm_core.optimize.bundle_problem import PreparedBundle, prepare_bundle, range_executor
from mpsfm_core.optimize.options import Loss
from tests.optimize.bundle_reference import (
    distort_reference,
    make_problem,
    perturb,
    rotation,
    soft_l1,
)

STEP = 1e-6


def small_problem() -> BundleProblem:
    """Return a small problem with every kind of variable and observation.

    The problem has an OPENCV and a fisheye camera with variable intrinsics, a constant pose,
    variable depth scales, a track that observes an image twice, missing depth, and a point in a
    single view.
    """
    problem = perturb(make_problem(5, 12, 3), seed=3)
    # the longest track has two observations in its last image
    point = np.bincount(problem.obs_point).argmax()
    twice = np.flatnonzero(problem.obs_point == point)[-1]
    single = np.flatnonzero(problem.obs_point == 0)[1:]
    keep = np.setdiff1d(np.arange(len(problem.obs_image)), single)
    keep = np.random.default_rng(0).permutation(np.append(keep, twice))
    log_depth = problem.obs_log_depth[keep].copy()
    log_depth[::4] = np.nan
    rng = np.random.default_rng(1)
    return replace(
        problem,
        intrinsics=np.array([[1300.0, 1200.0, 800.0, 600.0], [900.0, 950.0, 810.0, 590.0]]),
        camera_of_image=np.array([0, 1, 0, 1, 1]),
        obs_image=problem.obs_image[keep],
        obs_point=problem.obs_point[keep],
        obs_xy=problem.obs_xy[keep] + rng.normal(0, 2, (len(keep), 2)),
        obs_std_px=rng.uniform(0.5, 2, len(keep)),
        obs_log_depth=log_depth,
        obs_std_log_depth=rng.uniform(0.02, 0.1, len(keep)),
        variable_point=np.arange(12) != 5,
        distortion=np.array([[-0.1, 0.02, 0.004, -0.003], [0.05, -0.03, 0.01, 0.002]]),
        fisheye=np.array([False, True]),
        variable_intrinsics=np.ones((2, 8), dtype=np.bool_),
        prior_std_intrinsics=np.tile([0.05, 0.01, 5, 5, 0.01, 0.01, 0.01, 0.01], (2, 1)),
        log_scales=rng.normal(0, 0.05, 5),
        expected_log_scales=rng.normal(0, 0.05, 5),
        std_log_scales=rng.uniform(0.05, 0.1, 5),
        variable_scale=np.array([True, True, False, True, True]),
        variable_pose=np.array([False, True, True, True, True]),
    )


def moved(p: PreparedBundle, delta: Float64, points: Float64) -> kernels.BundleParameters:
    """Add a step of the variable camera parameters and point displacements (p, 3) to the state."""
    delta = delta.copy()
    delta[: p.held.size][p.held.ravel()] = 0.0
    trial = kernels.BundleParameters(*(array.copy() for array in p.state))
    kernels.update_cameras(delta, p.bundle.layout, p.state, trial)
    trial.points[:] += points
    return trial


def sights(
    p: PreparedBundle, state: kernels.BundleParameters
) -> list[kernels.LinearizedObservation]:
    """Return all observations in the order of the kernels."""
    points = np.repeat(np.arange(len(state.points)), np.diff(p.bundle.obs.start))
    return [
        kernels.linearize_observation(k, point, p.bundle, state) for k, point in enumerate(points)
    ]


def residuals(p: PreparedBundle, state: kernels.BundleParameters) -> Float64:
    """(3 m + s,) whitened residuals in plain numpy, those of scales and intrinsics last."""
    obs, layout = p.bundle.obs, p.bundle.layout
    points = np.repeat(np.arange(len(state.points)), np.diff(obs.start))
    camera = np.einsum("mij,mj->mi", state.rotations[obs.image], state.points[points])
    camera += state.translations[obs.image]
    k = state.intrinsics[layout.camera_of_image[obs.image]]
    uv = camera[:, :2] / camera[:, 2:]
    coefficients = state.distortion[layout.camera_of_image[obs.image]]
    is_fisheye = layout.fisheye[layout.camera_of_image[obs.image], None]
    uv = np.where(
        is_fisheye,
        distort_reference(uv, coefficients, fisheye=True),
        distort_reference(uv, coefficients, fisheye=False),
    )
    xy = k[:, :2] * uv + k[:, 2:]
    pixel = (xy - obs.xy) * obs.weight[:, None]
    scaled = obs.log_depth + state.log_scales[obs.image]
    depth = (np.log(camera[:, 2]) - scaled) * obs.depth_weight
    prior = p.scale_prior
    scales = (state.log_scales[prior.image] - prior.log_scale) * np.sqrt(prior.weight)
    intrinsics = p.intrinsic_prior.residuals(state) * np.sqrt(p.intrinsic_prior.weight)
    return np.concatenate([np.column_stack([pixel, depth]).ravel(), scales, intrinsics])


def numeric_jacobian(p: PreparedBundle) -> Float64:
    """Jacobian (3 m + s, d + 3 v) of the residuals: camera side, then variable points."""
    poses, focals = p.bundle.layout.num_poses, int(p.bundle.layout.intrinsic_slot.max()) + 1
    size = kernels.NUM_IMAGE_PARAMS * poses + focals
    variable = np.flatnonzero(p.bundle.layout.variable_point)
    columns = []
    for n in range(size + 3 * len(variable)):
        delta, points = np.zeros(size), np.zeros_like(p.state.points)
        if n < size:
            delta[n] = STEP
        else:
            points[variable[(n - size) // 3], (n - size) % 3] = STEP
        ahead, behind = (residuals(p, moved(p, s * delta, s * points)) for s in (1, -1))
        columns.append((ahead - behind) / (2 * STEP))
    return np.column_stack(columns)


@pytest.mark.parametrize("depth_loss", Loss)
@pytest.mark.parametrize("reprojection_loss", Loss)
def test_gradient_of_every_loss_equals_finite_differences(
    reprojection_loss: Loss, depth_loss: Loss
) -> None:
    options = soft_l1(reprojection_loss=reprojection_loss, depth_loss=depth_loss)
    p = prepare_bundle(small_problem(), options)
    layout = p.bundle.layout
    with range_executor(p.ranges, 1) as run:
        normal = SchurComplementSolver(p, options, run)
        normal.linearize(p.state, 0.0)
    variable = layout.variable_point
    by_point = np.zeros_like(p.state.points)
    rows = np.repeat(np.arange(len(by_point)), np.diff(p.bundle.obs.start))
    for row, image, s in zip(rows, p.bundle.obs.image, sights(p, p.state), strict=True):
        by_point[row] += p.state.rotations[image].T @ [s.gx, s.gy, s.gz]
    gradient = np.concatenate([normal.total.gradient, by_point[variable].ravel()])

    def cost(delta: Float64, points: Float64) -> float:
        state = moved(p, delta, points)
        priors = p.scale_prior.cost(state) + p.intrinsic_prior.cost(state)
        return priors + sum(sight.cost for sight in sights(p, state))

    size = len(normal.total.gradient)
    numeric = np.empty_like(gradient)
    for n in range(len(gradient)):
        delta, points = np.zeros(size), np.zeros_like(p.state.points)
        if n < size:
            delta[n] = STEP
        else:
            points[np.flatnonzero(variable)[(n - size) // 3], (n - size) % 3] = STEP
        numeric[n] = (cost(delta, points) - cost(-delta, -points)) / (2 * STEP)
    np.testing.assert_allclose(gradient, numeric, rtol=1e-6, atol=1e-6 * np.abs(numeric).max())


@pytest.mark.parametrize("kind", ["reprojection", "depth"])
def test_derivatives_of_one_residual_equal_finite_differences(kind: str) -> None:
    """Gradient and Gauss-Newton matrix of the camera point, to 1e-6."""
    rng = np.random.default_rng(0)
    for _ in range(50):
        problem = BundleProblem(
            rotations=rotation(rng.normal(size=3))[None],
            translations=rng.normal(size=(1, 3)),
            intrinsics=np.array([[*rng.uniform(300, 2000, 2), *rng.uniform(100, 900, 2)]]),
            camera_of_image=np.array([0]),
            points=np.zeros((1, 3)),
            obs_image=np.array([0]),
            obs_point=np.array([0]),
            obs_xy=rng.uniform(0, 1000, (1, 2)),
            obs_std_px=1.0 if kind == "reprojection" else 1e9,
            obs_log_depth=rng.normal(size=1) if kind == "depth" else None,
            obs_std_log_depth=0.05,
        )
        camera_point = rng.uniform([-1, -1, 0.5], [1, 1, 5])
        world = problem.rotations[0].T @ (camera_point - problem.translations[0])
        problem = replace(problem, points=world[None])
        trivial = soft_l1(reprojection_loss=Loss.TRIVIAL, depth_loss=Loss.TRIVIAL)
        p = prepare_bundle(problem, trivial)
        jacobian = np.empty((3, 3))
        for a in range(3):
            step = np.zeros(3)
            step[a] = STEP
            states = [
                p.state._replace(translations=p.state.translations + s) for s in (step, -step)
            ]
            jacobian[:, a] = np.subtract(*(residuals(p, s) for s in states)) / (2 * STEP)
        (s,) = sights(p, p.state)
        expected = jacobian.T @ jacobian
        actual = np.array([[s.hxx, 0, s.hxz], [0, s.hyy, s.hyz], [s.hxz, s.hyz, s.hzz]])
        np.testing.assert_allclose(actual, expected, rtol=1e-6, atol=1e-6 * expected.max())
        force = jacobian.T @ residuals(p, p.state)
        np.testing.assert_allclose([s.gx, s.gy, s.gz], force, atol=1e-6 * np.abs(force).max())


@pytest.mark.parametrize("relaxation", [1.0, 1.5])
@pytest.mark.parametrize("sparse", [False, True])
def test_step_solves_the_damped_normal_equations(
    sparse: bool, relaxation: float, monkeypatch
) -> None:
    """The Schur complement step and its predicted cost decrease equal dense linear algebra.

    A relaxed step lengthens the step of the cameras, and moves the points to their optimum.
    """
    options = soft_l1(
        reprojection_loss=Loss.TRIVIAL,
        depth_loss=Loss.TRIVIAL,
        dense_poses=0 if sparse else 500,
    )
    monkeypatch.setattr("mpsfm_core.optimize.bundle_adjustment.CG_TOLERANCE", 1e-12)
    damping = 1e-2
    p = prepare_bundle(small_problem(), options)
    jacobian = numeric_jacobian(p)
    gradient = jacobian.T @ residuals(p, p.state)
    matrix = jacobian.T @ jacobian
    # a point is damped by the mean of its three diagonal entries, other parameters by their own
    size = len(gradient) - 3 * p.bundle.layout.variable_point.sum()
    diagonal = np.diagonal(matrix).copy()
    diagonal[size:] = np.repeat(diagonal[size:].reshape(-1, 3).mean(axis=1), 3)
    held = diagonal == 0  # scales that are constant
    damped = matrix + np.diag(damping * diagonal + held)
    expected = relaxation * np.linalg.solve(damped, -gradient)
    of_points = -gradient[size:] - damped[size:, :size] @ expected[:size]
    expected[size:] = np.linalg.solve(damped[size:, size:], of_points)
    with range_executor(p.ranges, 1) as run:
        normal = SchurComplementSolver(p, options, run)
        cost = normal.linearize(p.state, damping)
        trial = kernels.BundleParameters(*(np.empty_like(array) for array in p.state))
        # an infinite tolerance disables the separate refinement of points after the joint step
        normal.tolerance = np.inf
        step = normal.step(p.state, trial, damping, relaxation, cost)
    assert cost == pytest.approx(0.5 * np.sum(residuals(p, p.state) ** 2), rel=1e-12)
    points = np.zeros_like(p.state.points)
    points[p.bundle.layout.variable_point] = expected[size:].reshape(-1, 3)
    reference = moved(p, expected[:size], points)
    for actual, wanted, start in zip(trial, reference, p.state, strict=True):
        np.testing.assert_allclose(actual - start, wanted - start, rtol=1e-4, atol=1e-7)
    linear = residuals(p, p.state) + jacobian @ expected
    decrease = cost - 0.5 * linear @ linear
    assert step.predicted == pytest.approx(decrease, rel=1e-4)


@pytest.mark.parametrize(
    ("curvature_ratio", "expected"), [(1.2, 1.0), (1.0, 1.0), (0.8, 1.25), (0.3, MAX_RELAXATION)]
)
def test_relaxation_minimizes_a_quadratic_cost(curvature_ratio: float, expected: float) -> None:
    """If the cost is less curved than its model, the next camera step is longer."""
    slope, relaxation = 3.0, 1.5
    predicted = relaxation * slope - relaxation**2 / 2 * slope
    decrease = relaxation * slope - relaxation**2 / 2 * curvature_ratio * slope
    step = TrialStep(1.0, decrease, predicted, slope)
    assert step.choose_relaxation(relaxation) == pytest.approx(expected)


def test_rotation_near_zero_and_beyond_half_a_turn() -> None:
    for vector in ([0, 0, 0], [1e-9, -1e-7, 1e-8], [9e-5, 0, 0], [1e-3, 2e-3, 0], [3, -2, 1]):
        turn = np.array(kernels.rotation_from_vector(*map(float, vector)))
        np.testing.assert_allclose(turn, rotation(np.array(vector)), atol=1e-15)


def test_sorting_is_stable_and_by_point_then_image() -> None:
    problem = small_problem()
    obs = prepare_bundle(problem, soft_l1()).bundle.obs
    order = np.lexsort((np.arange(len(obs.image)), problem.obs_image, problem.obs_point))
    np.testing.assert_array_equal(obs.image, problem.obs_image[order])
    np.testing.assert_array_equal(obs.xy, problem.obs_xy[order])
    np.testing.assert_array_equal(np.diff(obs.start), np.bincount(problem.obs_point))
