"""Tests that kernels of depth integration equal the reference energy, reduce it and repair
depth."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import gaussian_filter

from mpsfm_core.data import DepthPrior, NormalPrior, PinholeCamera
from mpsfm_core.data.errors import DataError
from mpsfm_core.optimize import depth_integration
from mpsfm_core.optimize.depth_integration import (
    NO_ANCHORS,
    Anchors,
    DepthIntegrator,
)
from mpsfm_core.optimize.integration_energy import majorize
from mpsfm_core.optimize.options import IntegrationOptions
from mpsfm_core.testing.synthetic.scenes import AnalyticScene, Plane, arc_poses, look_at, room_scene
from tests.optimize.integration_problems import (
    CAMERA,
    camera_of,
    depth_prior,
    exact_anchors,
    normal_prior,
    random_problem,
    rendered,
)
from tests.optimize.integration_reference import ReferenceIntegration, grid_operator


def rms(values) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


@pytest.mark.parametrize("shape", [(6, 7), (1, 8), (9, 1), (2, 2)])
@pytest.mark.parametrize("masked", [0.0, 0.3])
def test_energy_gradient_and_matrix_equal_the_reference(shape, masked):
    depth, normals, anchors = random_problem(shape, 1, masked=masked)
    reference = ReferenceIntegration(depth, normals, camera_of(shape), anchors)
    terms = DepthIntegrator(depth, normals, camera_of(shape))._terms(anchors, 1.0)
    z = terms.prior.log_depth + np.random.default_rng(2).normal(0, 0.1, shape)
    ours, expected = majorize(z, terms), reference.linearise(z.ravel())
    assert ours.energy == pytest.approx(expected.energy, rel=1e-5)
    scale = np.abs(expected.gradient).max()
    np.testing.assert_allclose(ours.gradient.ravel(), expected.gradient, atol=1e-5 * scale)
    matrix = grid_operator(ours.east, ours.south, ours.mass)
    difference = abs(matrix - expected.matrix).max()
    assert difference < 1e-5 * abs(expected.matrix).max()


def only(part: str, terms):
    """Return the energy terms with only one kind of residual."""
    empty = replace_points(terms, 0)
    silent = terms.prior._replace(weight=0.0)
    weight = terms.normals.weight.copy()
    if part in ("x", "y"):
        weight[1 if part == "x" else 0] = 0
        return empty._replace(normals=terms.normals._replace(weight=weight), prior=silent)
    muted = terms.normals._replace(weight=0 * weight)
    if part == "prior":
        return empty._replace(normals=muted)
    return terms._replace(normals=muted, prior=silent)


def replace_points(terms, count):
    return terms._replace(points=type(terms.points)(*(values[:count] for values in terms.points)))


@pytest.mark.parametrize("part", ["x", "y", "prior", "points"])
@pytest.mark.parametrize("seed", range(3))
def test_gradient_of_every_residual_by_finite_differences(part, seed):
    shape = (6, 7)
    depth, normals, anchors = random_problem(shape, seed, masked=0.1)
    terms = only(part, DepthIntegrator(depth, normals, camera_of(shape))._terms(anchors, 1.0))
    rng = np.random.default_rng(seed + 10)
    z = terms.prior.log_depth + rng.normal(0, 0.05, shape)
    gradient = 2 * majorize(z, terms).gradient
    assert np.abs(gradient).max() > 0
    numeric = np.zeros(shape)
    h = 1e-5
    for i, j in np.ndindex(shape):
        unit = np.zeros(shape)
        unit[i, j] = h
        # Fourth-order differences, because the soft minimum is strongly curved.
        near = majorize(z + unit, terms).energy - majorize(z - unit, terms).energy
        far = majorize(z + 2 * unit, terms).energy - majorize(z - 2 * unit, terms).energy
        numeric[i, j] = (8 * near - far) / (12 * h)
    np.testing.assert_allclose(gradient, numeric, atol=1e-6 * np.abs(gradient).max())


@pytest.mark.parametrize("seed", range(5))
def test_quadratic_model_majorizes_the_energy(seed):
    shape = (8, 9)
    depth, normals, anchors = random_problem(shape, seed, masked=0.1)
    terms = DepthIntegrator(depth, normals, camera_of(shape))._terms(anchors, 1.0)
    rng = np.random.default_rng(seed)
    here = majorize(terms.prior.log_depth, terms)
    matrix = grid_operator(here.east, here.south, here.mass)
    for size in (1e-3, 1e-2, 1e-1, 1.0):
        step = rng.normal(0, size, shape)
        quadratic = here.energy + 2 * (here.gradient * step).sum()
        quadratic += step.ravel() @ (matrix @ step.ravel())
        energy = majorize(terms.prior.log_depth + step, terms).energy
        assert energy <= quadratic * (1 + 1e-5)


def test_gradient_of_prior_increases_with_distance():
    depth, normals, _ = random_problem((3, 4), 0)
    terms = only("prior", DepthIntegrator(depth, normals, camera_of((3, 4)))._terms(NO_ANCHORS, 1))
    pulls = [
        majorize(terms.prior.log_depth + offset, terms).gradient for offset in (0.05, 0.5, 5.0)
    ]
    assert (pulls[0] > 0).all()
    assert (pulls[1] > pulls[0]).all()
    assert (pulls[2] > pulls[1]).all()


def test_refine_reaches_the_energy_of_the_reference():
    camera = PinholeCamera(64, 43, 58.0, 58.0, 32.0, 21.5)
    scene, pose = room_scene(), arc_poses(1, 0)[0]
    depth, normals = rendered(scene, pose, camera)
    rng = np.random.default_rng(0)
    prior = depth_prior(depth * np.exp(rng.normal(0, 0.03, depth.shape)))
    field = normal_prior(normals + rng.normal(0, 0.05, normals.shape), 0.08)
    anchors = exact_anchors(depth, 40)
    _, energies = ReferenceIntegration(prior, field, camera, anchors).solve(tolerance=1e-3)
    options = IntegrationOptions(tolerance=1e-4, max_iterations=50)
    refined = DepthIntegrator(prior, field, camera, options).refine(anchors)
    assert refined.initial_energy == pytest.approx(energies[0], rel=1e-5)
    assert refined.energy < 1.01 * energies[-1]
    assert refined.converged


def test_plane_is_recovered_from_normals_and_three_points():
    scene = AnalyticScene((Plane((0, 4, 0), (0.3, -1.0, 0.2)),))
    depth, normals = rendered(scene, look_at((0, 0, 0), (0, 1, 0)))
    tilt = np.linspace(-0.2, 0.2, CAMERA.width)
    prior = depth_prior(depth * np.exp(tilt - 0.1), std=0.3)
    corners = Anchors(
        np.array([[0.5, 0.5], [32.5, 1.5], [15.5, 25.5]]),
        depth[[0, 1, 25], [0, 32, 15]],
        np.full(3, 1e-6),
    )
    options = IntegrationOptions(tolerance=1e-5, max_iterations=50, cg_iterations=5)
    refined = DepthIntegrator(prior, normal_prior(normals, 0.01), CAMERA, options).refine(corners)
    assert refined.valid.all()
    assert rms(refined.log_depth - np.log(depth)) < 1e-3
    assert refined.depth.dtype == np.float32
    np.testing.assert_allclose(refined.depth, depth, rtol=5e-3)


def test_refine_keeps_depth_edges_and_removes_noise():
    camera = PinholeCamera(96, 64, 88.0, 88.0, 48.0, 32.0)
    depth, normals = rendered(room_scene(), arc_poses(1, 0)[0], camera)
    rng = np.random.default_rng(0)
    noise = gaussian_filter(rng.normal(size=depth.shape), 6)
    noise *= 0.05 / noise.std()
    prior = depth_prior(depth * np.exp(noise))
    field = normal_prior(normals + rng.normal(0, 0.03, normals.shape))
    refined = DepthIntegrator(prior, field, camera).refine(exact_anchors(depth, 60))
    error = refined.log_depth - np.log(depth)
    assert rms(error) < 0.5 * rms(noise)
    edge = np.abs(np.diff(np.log(depth), axis=1)) > 0.2
    jump = np.abs(np.diff(refined.log_depth, axis=1))[edge]
    assert edge.sum() > 50
    assert np.median(jump / np.abs(np.diff(np.log(depth), axis=1))[edge]) > 0.9


def test_wrong_points_hardly_change_depth():
    depth, normals = rendered(room_scene(), arc_poses(1, 0)[0])
    integrator = DepthIntegrator(depth_prior(depth), normal_prior(normals), CAMERA)
    good = exact_anchors(depth, 40)
    factors = np.ones(40)
    factors[::5] = [1.3, 0.75, 4.0, 0.2, 1.3, 0.75, 1.4, 30.0]
    bad = good._replace(depth=good.depth * factors)
    clean, dirty = integrator.refine(good), integrator.refine(bad)
    assert rms(dirty.log_depth - clean.log_depth) < 0.02


def test_useless_points_are_ignored():
    depth, normals = rendered(room_scene(), arc_poses(1, 0)[0])
    valid = np.ones(depth.shape, bool)
    valid[:, :3] = False
    integrator = DepthIntegrator(
        depth_prior(depth, valid=valid), normal_prior(normals, valid=valid), CAMERA
    )
    nan, inf = np.nan, np.inf
    xy = np.array([[-1, 5], [33.1, 5], [5, -0.1], [5, 26], [nan, 5], [1, 1], *[[9, 9]] * 5])
    values = np.array([1, 1, 1, 1, 1, 1, nan, inf, 0, -1, 1])
    variance = np.array([1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 0.0])
    refined = integrator.refine(Anchors(xy, values, variance))
    np.testing.assert_array_equal(refined.log_depth, integrator.refine().log_depth)
    assert not refined.valid[:, :3].any()
    assert refined.valid[:, 3:].all()


def test_holes_are_integrated_and_unreachable_pixels_are_marked():
    scene = AnalyticScene((Plane((0, 4, 0), (0.3, -1.0, 0.2)),))
    depth, normals = rendered(scene, look_at((0, 0, 0), (0, 1, 0)))
    known = np.ones(depth.shape, bool)
    known[5:20, 10:30] = False
    seen = known.copy()
    seen[5:20, 10:25] = True
    seen[8:14, 12:18] = False  # a ring without data around an island with normals only
    seen[10:12, 14:16] = True
    broken = np.where(known, depth, 0)
    integrator = DepthIntegrator(depth_prior(broken), normal_prior(normals, 0.02, seen), CAMERA)
    refined = integrator.refine()
    hole = ~known & refined.valid
    expected = known | seen
    expected[10:12, 14:16] = False
    np.testing.assert_array_equal(refined.valid, expected)
    assert rms((refined.log_depth - np.log(depth))[hole]) < 0.01
    assert np.isfinite(refined.log_depth).all()
    variance = integrator.variance(refined)
    assert np.isinf(variance[~refined.valid]).all()
    assert np.isfinite(variance[refined.valid]).all()
    whole = DepthIntegrator(depth_prior(depth), normal_prior(normals, 0.02, seen), CAMERA)
    assert (variance > whole.variance(whole.refine()))[hole].all()


def test_scale_of_prior_shifts_the_log_depth():
    depth, normals, anchors = random_problem((12, 15), 3)
    integrator = DepthIntegrator(depth, normals, camera_of((12, 15)))
    one = integrator.refine(anchors)
    scaled = Anchors(anchors.xy, 2.5 * anchors.depth, 2.5**2 * anchors.variance)
    two = integrator.refine(scaled, scale=2.5)
    np.testing.assert_allclose(two.log_depth, one.log_depth + np.log(2.5), atol=1e-6)
    again = integrator.refine(scaled, scale=2.5, start=one)
    assert again.skipped
    np.testing.assert_allclose(again.log_depth, two.log_depth, atol=1e-6)
    assert again.scale == 2.5


def test_refine_of_nearly_unchanged_points_is_skipped():
    depth, normals = rendered(room_scene(), arc_poses(1, 0)[0])
    rough = depth * np.exp(np.random.default_rng(0).normal(0, 0.03, depth.shape))
    integrator = DepthIntegrator(depth_prior(rough), normal_prior(normals), CAMERA)
    anchors = exact_anchors(depth, 40)
    first = integrator.refine(anchors)
    assert not first.skipped
    assert first.iterations > 0
    again = integrator.refine(anchors, start=first)
    assert again.skipped
    np.testing.assert_array_equal(again.log_depth, first.log_depth)
    moved = anchors._replace(depth=anchors.depth * 1.05)
    third = integrator.refine(moved, start=again)
    assert not third.skipped
    assert third.energy < third.initial_energy
    # Changes are relative to the last solve, so that small changes accumulate.
    drifting = first
    for step in range(1, 40):
        drifting = integrator.refine(
            anchors._replace(depth=anchors.depth * (1 + 0.001 * step)), start=drifting
        )
        if not drifting.skipped:
            break
    assert not drifting.skipped


def test_warm_start_is_faster_and_equally_accurate():
    depth, normals = rendered(room_scene(), arc_poses(1, 0)[0])
    rough = depth * np.exp(np.random.default_rng(0).normal(0, 0.03, depth.shape))
    integrator = DepthIntegrator(depth_prior(rough), normal_prior(normals), CAMERA)
    before = integrator.refine(exact_anchors(depth, 40))
    anchors = exact_anchors(depth, 80, seed=1)
    options = integrator.options.model_copy(update={"max_point_growth": 0.0})
    eager = DepthIntegrator(depth_prior(rough), normal_prior(normals), CAMERA, options)
    cold, warm = eager.refine(anchors), eager.refine(anchors, start=before)
    assert warm.iterations < cold.iterations
    assert warm.energy < 1.05 * cold.energy


def test_coarse_start_accelerates_large_maps(monkeypatch):
    camera = PinholeCamera(640, 480, 560.0, 560.0, 320.0, 240.0)
    depth, normals = rendered(room_scene(), arc_poses(1, 0.0)[0], camera)
    rng = np.random.default_rng(0)
    field = cv2.resize(rng.normal(0, 0.05, (8, 10)), camera.size, interpolation=cv2.INTER_CUBIC)
    tilt = cv2.resize(rng.normal(0, 0.1, (48, 64, 3)), camera.size, interpolation=cv2.INTER_CUBIC)
    normals = normals + tilt
    options = IntegrationOptions(tolerance=1e-2)
    parts = depth_prior(depth * np.exp(field)), normal_prior(normals, 0.1), camera, options
    anchors = exact_anchors(depth, 200)
    started = DepthIntegrator(*parts).refine(anchors)
    monkeypatch.setattr(depth_integration, "_COARSE_COLUMNS", 10_000)
    alone = DepthIntegrator(*parts).refine(anchors)

    errors = [rms(refined.log_depth - np.log(depth)) for refined in (started, alone)]
    assert started.iterations <= 3 < alone.iterations
    assert errors[0] < 1.1 * errors[1]
    assert started.energy < 1.2 * alone.energy
    assert started.initial_energy == alone.initial_energy > started.energy


def test_variance_is_the_diagonal_of_the_inverse_hessian():
    shape = (13, 17)
    depth, normals, anchors = random_problem(shape, 4)
    integrator = DepthIntegrator(depth, normals, camera_of(shape))
    refined = integrator.refine(anchors)
    reference = ReferenceIntegration(depth, normals, camera_of(shape), anchors)
    dense = np.linalg.inv(reference.linearise(refined.log_depth.ravel()).matrix.toarray())
    expected = np.diag(dense).reshape(shape)
    np.testing.assert_allclose(integrator.variance(refined, anchors), expected, rtol=1e-2)
    assert (integrator.variance(refined) >= 0.999 * expected).all()


def test_result_does_not_depend_on_threads():
    depth, normals, anchors = random_problem((40, 50), 5)
    integrator = DepthIntegrator(depth, normals, camera_of((40, 50)))
    alone = integrator.refine(anchors).log_depth
    with ThreadPoolExecutor(4) as pool:
        for refined in pool.map(integrator.refine, [anchors] * 8):
            np.testing.assert_array_equal(refined.log_depth, alone)


def test_wrong_grids_and_variances_raise():
    depth, normals, _ = random_problem((6, 7), 0)
    with pytest.raises(DataError, match="equal width and height"):
        DepthIntegrator(depth, normals, camera_of((7, 6)))
    with pytest.raises(DataError, match="variance"):
        DepthIntegrator(replace(depth, variance=None), normals, camera_of((6, 7)))


@pytest.mark.parametrize("seed", range(40))
def test_random_normals_give_bounded_depth(seed):
    """Normals that face away or are perpendicular to the ray could change depth by any factor."""
    shape = (1, 6)
    known = np.arange(6).reshape(shape) == 0
    wild = np.random.default_rng(seed).normal(size=(*shape, 3))
    depth = DepthPrior.from_arrays(np.full(shape, 2.0), np.full(shape, 1e-4), known)
    normals = NormalPrior.from_arrays(wild, np.full(shape, 1e-2), np.ones(shape))
    refined = DepthIntegrator(depth, normals, camera_of(shape)).refine()
    assert refined.valid.all()
    assert refined.depth[0, 0] == pytest.approx(2.0, rel=0.1)
    assert np.abs(refined.log_depth - np.log(2.0)).max() < np.log(200)


@st.composite
def degenerate_problems(draw):
    """Draw problems of any size with masks, extreme values, constant regions and wrong anchors."""
    shape = draw(st.tuples(st.integers(1, 9), st.integers(1, 9)))
    rng = np.random.default_rng(draw(st.integers(0, 10**6)))
    spread = draw(st.sampled_from([0.0, 0.01, 1.0, 5.0]))
    depth = np.exp(rng.normal(0, spread, shape)) * draw(st.sampled_from([1e-3, 1.0, 1e4]))
    tilt = draw(st.sampled_from([0.0, 0.3, 30.0]))
    normals = rng.normal(0, 1, (*shape, 3)) * tilt - (0, 0, 1)
    confidence = st.sampled_from([1e-8, 1e-2, 1.0, 1e5])
    depth_variance = np.full(shape, draw(confidence)) * depth**2
    normal_variance = np.full(shape, draw(confidence))
    share = st.sampled_from([0.0, 0.2, 0.6, 1.0])
    valid, seen = rng.random((2, *shape)) >= np.array([draw(share), draw(share)])[:, None, None]
    count = draw(st.integers(0, 12))
    anchors = Anchors(
        rng.uniform(-2, 11, (count, 2)),
        np.exp(rng.normal(0, 1, count)) * np.median(depth),
        10 ** rng.uniform(-12, 6, count),
    )
    return (
        DepthPrior.from_arrays(depth, depth_variance, valid),
        NormalPrior.from_arrays(normals, normal_variance, seen),
        anchors,
    )


@settings(max_examples=150)
@given(problem=degenerate_problems(), scale=st.sampled_from([1.0, 1e-3, 40.0]))
def test_degenerate_input_never_increases_the_energy(problem, scale):
    depth, normals, anchors = problem
    integrator = DepthIntegrator(depth, normals, camera_of(depth.shape))
    first = integrator.refine(NO_ANCHORS, scale=scale)
    for refined in (first, integrator.refine(anchors, scale=2 * scale, start=first)):
        assert np.isfinite(refined.log_depth).all()
        assert np.isfinite(refined.energy)
        assert refined.energy <= refined.initial_energy
        assert refined.valid[depth.valid].all()
        assert not refined.valid[~depth.valid & ~normals.valid].any()
        variance = integrator.variance(refined, anchors)
        assert (variance > 0).all()
        assert (np.isfinite(variance) == refined.valid).all()
