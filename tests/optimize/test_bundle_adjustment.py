"""Bundle adjustment: Tests of bundle adjustment against Ceres, with single views, gross errors,
degenerate input."""

from dataclasses import fields, replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mpsfm_core.data import Float64
from mpsfm_core.data.camera_models import CameraModel
from mpsfm_core.data.errors import DataError
from mpsfm_core.optimize.bundle_adjustment import (
    FACTORIZATION_COST,
    MAX_CG_ITERATIONS,
    MAX_FACTORIZATION_ITERATIONS,
    BundleProblem,
    BundleResult,
    adjust_bundle,
    count_enough_iterations,
    start_at,
)
from mpsfm_core.optimize.options import Loss
from tests.optimize.bundle_reference import (
    FOCAL,
    calibrated,
    colmap_model,
    dense_information,
    distorted,
    make_problem,
    perturb,
    rotation,
    soft_l1,
    solve_with_ceres,
    whitened_residuals,
    without_depth,
)

TIGHT = soft_l1(function_tolerance=1e-13, max_iterations=1000)
PARAMETERS = ("rotations", "translations", "log_scales", "intrinsics", "distortion", "points")


def assert_same_optimum(start: BundleProblem) -> None:
    initial, final, rec, log_scales = solve_with_ceres(start)
    result = adjust_bundle(start, TIGHT)
    assert result.converged
    assert result.initial_cost == pytest.approx(initial, rel=1e-12)
    assert result.final_cost == pytest.approx(final, rel=1e-6)
    poses = [rec.images[i + 1].cam_from_world() for i in range(len(start.rotations))]
    turns = np.stack([pose.rotation.matrix() for pose in poses])
    shifts = np.stack([pose.translation for pose in poses])
    np.testing.assert_allclose(result.rotations, turns, atol=1e-5)
    centers = [
        -np.einsum("nji,nj->ni", r, t)
        for r, t in ((result.rotations, result.translations), (turns, shifts))
    ]
    np.testing.assert_allclose(result.log_scales, log_scales, atol=1e-6)
    if start.obs_log_depth is None:
        # the scale is a convention: Ceres may hold another coordinate of the second camera
        centers = [(c - c[0]) / np.linalg.norm(c[1] - c[0]) for c in centers]
    np.testing.assert_allclose(*centers, atol=1e-5)
    model = colmap_model(start)
    for k, (intrinsics, distortion) in enumerate(
        zip(result.intrinsics, result.distortion, strict=True)
    ):
        theirs = model.from_params(np.array(rec.cameras[k + 1].params))
        np.testing.assert_allclose(intrinsics, theirs[0], rtol=1e-5)
        np.testing.assert_allclose(distortion, theirs[1], atol=1e-5)


@pytest.mark.parametrize("seed", range(3))
def test_same_optimum_as_ceres_with_depth(seed: int) -> None:
    assert_same_optimum(perturb(make_problem(6, 60, 3.5), seed, amount=2.0))


@pytest.mark.parametrize("std", [0.02, np.inf])
@pytest.mark.parametrize("expected", [None, 0.05])
def test_same_optimum_as_ceres_with_scales_of_depth(std: float, expected: float | None) -> None:
    """Depth maps have scale errors of 10 %, with and without a prior on the scales."""
    assert_same_optimum(with_scales(perturb(make_problem(6, 60, 3.5), 0), std, expected))


def with_scales(problem: BundleProblem, std: float, expected: float | None) -> BundleProblem:
    """Return the problem with 10 % depth error per image, and variable scales except the third."""
    count = len(problem.rotations)
    rng = np.random.default_rng(0)
    off = rng.normal(0, 0.1, count)
    return replace(
        problem,
        obs_log_depth=problem.obs_log_depth + off[problem.obs_image],
        log_scales=rng.normal(0, 0.01, count),
        expected_log_scales=None if expected is None else np.full(count, expected),
        std_log_scales=std,
        variable_scale=np.arange(count) != 2,
    )


def test_exact_depth_recovers_scales() -> None:
    """All depth scales except that of the first image are variable."""
    truth = exact(make_problem(6, 200, 4))
    off = np.array([0.0, 0.1, -0.2, 0.3, 0.0, -0.1])
    wrong = replace(truth, obs_log_depth=truth.obs_log_depth + off[truth.obs_image])
    free = replace(wrong, variable_scale=np.arange(6) > 0)
    for options in (TIGHT, TIGHT.model_copy(update={"dense_poses": 0})):
        result = adjust_bundle(perturb(free, 0, 0.5), options)
        np.testing.assert_allclose(result.log_scales, -off, atol=1e-6)
        np.testing.assert_allclose(result.points, truth.points, atol=1e-5)


def test_scales_are_refined_with_constant_poses() -> None:
    truth = exact(make_problem(5, 300, 3))
    off = np.array([0.1, 0.2, -0.2, 0.3, -0.1])
    start = replace(
        truth,
        points=perturb(truth, 0, 3.0).points,
        obs_log_depth=truth.obs_log_depth + off[truth.obs_image],
        variable_pose=np.zeros(5, dtype=np.bool_),
        variable_scale=np.ones(5, dtype=np.bool_),
    )
    result = adjust_bundle(start, TIGHT)
    assert_fixed(start, result, ("rotations", "translations", "intrinsics"))
    np.testing.assert_allclose(result.log_scales, -off, atol=1e-6)
    np.testing.assert_allclose(result.points, truth.points, atol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(20))
def test_same_optimum_as_ceres_from_twenty_starts(seed: int) -> None:
    assert_same_optimum(perturb(make_problem(8, 150, 4), seed, amount=2.0))


@pytest.mark.parametrize("seed", range(3))
def test_same_optimum_as_ceres_without_depth(seed: int) -> None:
    assert_same_optimum(without_depth(perturb(make_problem(6, 200, 3.5), seed)))


@pytest.mark.parametrize("depth", [True, False])
def test_same_optimum_as_ceres_with_focal_length(depth: bool) -> None:
    start = perturb(make_problem(8, 80, 5), 0)
    start = calibrated(start, CameraModel.SIMPLE_PINHOLE)
    start = replace(start, intrinsics=start.intrinsics * [1.05, 1.05, 1, 1])
    assert_same_optimum(start if depth else without_depth(start))


@pytest.mark.parametrize("depth", [True, False])
@pytest.mark.parametrize("aspect", [1.0, 1.25])
def test_same_optimum_as_ceres_with_two_cameras(depth: bool, aspect: float) -> None:
    """The second camera is another SIMPLE_PINHOLE whose focal length is refined, or a PINHOLE."""
    one = perturb(make_problem(8, 120, 5), 0)
    fx, fy, cx, cy = one.intrinsics[0]
    other = np.array([0.8 * fx, 0.8 * fy * aspect, cx + 30, cy - 20])
    camera_of_image = np.arange(8) % 2
    scaled = (one.obs_xy - (cx, cy)) / (fx, fy) * other[:2] + other[2:]
    seen_by_other = (camera_of_image[one.obs_image] == 1)[:, None]
    start = replace(
        one,
        intrinsics=np.stack([one.intrinsics[0], other]),
        camera_of_image=camera_of_image,
        obs_xy=np.where(seen_by_other, scaled, one.obs_xy),
    )
    start = calibrated(start, CameraModel.SIMPLE_PINHOLE) if aspect == 1 else start
    assert_same_optimum(start if depth else without_depth(start))


def test_exact_measurements_recover_focal_length_per_camera() -> None:
    """Each image has another wrong focal length; exact measurements recover all focal lengths."""
    truth = exact(make_problem(6, 200, 5))
    truth = replace(
        truth,
        intrinsics=np.repeat(truth.intrinsics, 6, axis=0),
        camera_of_image=np.arange(6),
    )
    truth = calibrated(truth, CameraModel.SIMPLE_PINHOLE)
    wrong = truth.intrinsics * np.linspace(0.9, 1.1, 6)[:, None] ** [1, 1, 0, 0]
    result = adjust_bundle(replace(perturb(truth, 0, 0.5), intrinsics=wrong), TIGHT)
    np.testing.assert_allclose(result.intrinsics, truth.intrinsics, rtol=1e-6)
    np.testing.assert_allclose(result.points, truth.points, atol=1e-5)


@pytest.mark.parametrize("depth", [True, False])
def test_adjust_bundle_with_focal_prior_reaches_ceres_optimum(depth: bool) -> None:
    start = perturb(make_problem(8, 80, 5), 0)
    start = calibrated(start, CameraModel.SIMPLE_PINHOLE, prior_std=0.004)
    start.prior_intrinsics[:, 0] = np.log(1.05 * FOCAL)
    assert_same_optimum(start if depth else without_depth(start))


LENSES = {
    CameraModel.SIMPLE_RADIAL: [-0.25],
    CameraModel.RADIAL: [-0.2, 0.05],
    CameraModel.OPENCV: [-0.1, 0.03, 0.004, -0.006],
    CameraModel.OPENCV_FISHEYE: [0.03, -0.02, 0.01, -0.003],
}
"""Distortion coefficients of a camera of each model."""


@pytest.mark.parametrize("depth", [True, False])
@pytest.mark.parametrize("prior_std", [0.5, 0.02])
@pytest.mark.parametrize("model", LENSES)
def test_adjust_bundle_with_distortion_reaches_ceres_optimum(
    depth: bool, prior_std: float, model: CameraModel
) -> None:
    """Start from no distortion and a wrong focal length, with priors on focal and distortion."""
    start = distorted(make_problem(8, 120, 5), LENSES[model], fisheye=model.is_fisheye)
    start = calibrated(perturb(start, 0), model)
    start = replace(start, prior_std_intrinsics=only_distortion(prior_std))
    start = replace(start, intrinsics=start.intrinsics * [1.03, 1.03, 1, 1])
    assert_same_optimum(start if depth else without_depth(start))


@pytest.mark.parametrize("model", LENSES)
def test_adjust_bundle_with_principal_point_reaches_ceres_optimum(model: CameraModel) -> None:
    start = distorted(make_problem(8, 120, 5), LENSES[model], fisheye=model.is_fisheye)
    start = calibrated(perturb(start, 0), model, principal_point=True)
    start = replace(start, prior_std_intrinsics=only_distortion(0.1))
    assert_same_optimum(replace(start, intrinsics=start.intrinsics + np.array([20, 20, 15, -10])))


@pytest.mark.parametrize("model", LENSES)
@pytest.mark.parametrize("dense_poses", [500, 0])
def test_adjust_bundle_with_exact_distorted_observations_recovers_two_cameras(
    model: CameraModel, dense_poses: int
) -> None:
    truth = with_two_cameras(make_problem(6, 200, 5), model)
    truth = exact(calibrated(truth, model, principal_point=True, distortion=truth.distortion))
    start = replace(
        perturb(truth, 0, 0.5),
        intrinsics=truth.intrinsics * [[1.05, 1.05, 1.01, 1], [0.97, 0.97, 1, 0.99]],
        distortion=np.zeros((2, 4)),
    )
    options = TIGHT.model_copy(update={"dense_poses": dense_poses})
    result = adjust_bundle(start, options)
    np.testing.assert_allclose(result.intrinsics, truth.intrinsics, rtol=1e-5)
    np.testing.assert_allclose(result.distortion, truth.distortion, atol=1e-5)
    free = truth.variable_intrinsics
    assert (result.std_intrinsics[free] > 0).all() and np.isnan(result.std_intrinsics[~free]).all()


def test_adjust_bundle_with_constant_distortion_keeps_it() -> None:
    truth = exact(replace(make_problem(6, 100, 5), distortion=np.array([[-0.1, 0.0, 0.0, 0.0]])))
    result = adjust_bundle(perturb(truth, 0), TIGHT)
    assert result.distortion.tolist() == truth.distortion.tolist()
    assert np.isnan(result.std_intrinsics).all()
    np.testing.assert_allclose(result.points, truth.points, atol=1e-5)


def only_distortion(std: float) -> Float64:
    """Return standard deviations (1, 8) of a prior on the distortion coefficients only."""
    return np.where(np.arange(8) < 4, np.inf, std)[None]


def with_two_cameras(
    problem: BundleProblem, model: CameraModel = CameraModel.SIMPLE_RADIAL
) -> BundleProblem:
    """Return the problem with two alternating cameras of opposite distortion."""
    two = replace(
        problem,
        intrinsics=np.repeat(problem.intrinsics, 2, axis=0),
        camera_of_image=np.arange(len(problem.rotations)) % 2,
    )
    coefficients = np.zeros((2, 4))
    coefficients[:, : model.num_distortion] = LENSES[model]
    coefficients[1] /= -2
    return calibrated(two, model, distortion=coefficients)


@pytest.mark.parametrize("dense_poses", [500, 0])
@pytest.mark.parametrize("model", LENSES)
def test_adjust_bundle_intrinsic_stds_match_the_dense_hessian(
    dense_poses: int, model: CameraModel
) -> None:
    """The inverse of J^T J by finite differences over poses, points and two cameras."""
    problem = with_two_cameras(make_problem(4, 40, 4), model)
    problem = replace(
        calibrated(problem, model, principal_point=True, distortion=problem.distortion),
        prior_std_intrinsics=np.tile([0.1, 0.05, 10, 10, 0.1, 0.1, 0.1, 0.1], (2, 1)),
    )
    options = TIGHT.model_copy(update={"dense_poses": dense_poses})
    result = adjust_bundle(problem, options)
    information = dense_information(start_at(problem, result))
    free = problem.variable_intrinsics.T
    weights = 1 / problem.prior_std_intrinsics.T[free] ** 2
    rows = np.arange(-len(weights), 0)
    information[rows, rows] += weights
    expected = np.sqrt(np.diagonal(np.linalg.inv(information))[rows])
    np.testing.assert_allclose(result.std_intrinsics.T[free], expected, rtol=0.01)


def test_adjust_bundle_focal_std_is_nan_if_constant_and_infinite_if_unobserved() -> None:
    problem = make_problem(4, 40, 4)
    problem = replace(
        problem,
        intrinsics=np.repeat(problem.intrinsics, 3, axis=0),
        camera_of_image=np.zeros(4, dtype=np.int64),
        variable_intrinsics=np.outer([True, True, False], np.arange(8) == 0),
    )
    stds = adjust_bundle(problem).std_intrinsics[:, 0]
    assert 0 < stds[0] < 0.1 and np.isinf(stds[1]) and np.isnan(stds[2])


def exact(problem: BundleProblem) -> BundleProblem:
    """Return the problem with noise-free measurements."""
    residual = whitened_residuals(problem, robust=False)
    return replace(
        problem,
        obs_xy=problem.obs_xy + residual[:, :2],
        obs_log_depth=problem.obs_log_depth + residual[:, 2] * problem.obs_std_log_depth,
    )


def assert_fixed(problem: BundleProblem, result: BundleResult, names: tuple[str, ...]) -> None:
    given = replace(
        problem,
        log_scales=np.zeros(len(problem.rotations)),
        distortion=np.zeros((len(problem.intrinsics), 4)),
    )
    for name in names:
        np.testing.assert_array_equal(getattr(result, name), getattr(given, name))


def test_adjust_bundle_of_points_only_recovers_points() -> None:
    truth = exact(make_problem(5, 300, 3))
    start = replace(truth, points=perturb(truth, 0, 3.0).points, variable_pose=np.zeros(5, bool))
    result = adjust_bundle(start, TIGHT)
    assert_fixed(start, result, ("rotations", "translations", "intrinsics"))
    np.testing.assert_allclose(result.points, truth.points, atol=1e-6)


def test_adjust_bundle_of_poses_only_recovers_poses() -> None:
    truth = exact(make_problem(5, 300, 3))
    start = replace(perturb(truth, 0), points=truth.points, variable_point=np.zeros(300, bool))
    result = adjust_bundle(start, TIGHT)
    assert_fixed(start, result, ("points", "intrinsics"))
    np.testing.assert_allclose(result.rotations, truth.rotations, atol=1e-7)
    np.testing.assert_allclose(result.translations, truth.translations, atol=1e-6)


def test_adjust_bundle_of_local_problem_recovers_variable_poses() -> None:
    """Two poses and most points are variable; all other poses and points are constant."""
    truth = exact(make_problem(6, 300, 4))
    variable_pose = np.isin(np.arange(6), [2, 3])
    variable_point = np.random.default_rng(0).random(300) < 0.7
    start = perturb(truth, 0)
    pose = variable_pose[:, None]
    start = replace(
        start,
        rotations=np.where(pose[..., None], start.rotations, truth.rotations),
        translations=np.where(pose, start.translations, truth.translations),
        points=np.where(variable_point[:, None], start.points, truth.points),
        variable_pose=variable_pose,
        variable_point=variable_point,
    )
    result = adjust_bundle(start, TIGHT)
    np.testing.assert_array_equal(result.rotations[~variable_pose], start.rotations[~variable_pose])
    np.testing.assert_array_equal(result.points[~variable_point], start.points[~variable_point])
    np.testing.assert_allclose(result.translations, truth.translations, atol=1e-6)
    np.testing.assert_allclose(result.points, truth.points, atol=1e-5)


def test_depth_fixes_the_scale() -> None:
    truth = exact(make_problem(6, 200, 4))
    small = replace(truth, translations=truth.translations * 0.8, points=truth.points * 0.8)
    first = small.rotations[0].T @ small.translations[0]
    result = adjust_bundle(small, TIGHT)
    assert_fixed(small, result, ("intrinsics",))
    np.testing.assert_array_equal(result.translations[0], small.translations[0])
    expected = truth.points + truth.rotations[0].T @ truth.translations[0] - first
    np.testing.assert_allclose(result.points, expected, atol=1e-5)


def test_scale_anchor_keeps_one_coordinate_without_cost() -> None:
    start = without_depth(perturb(make_problem(6, 200, 4), 0))
    anchored = adjust_bundle(start, TIGHT)
    free = adjust_bundle(replace(start, scale_anchor=None), TIGHT)
    centers = -np.einsum("nji,nj->ni", start.rotations, start.translations)
    baseline = np.abs(start.rotations[1] @ (centers[1] - centers[0]))
    same = anchored.translations[1] == start.translations[1]
    np.testing.assert_array_equal(same, np.arange(3) == baseline.argmax())
    assert anchored.final_cost == pytest.approx(free.final_cost, rel=1e-9)


def adjust_dense_and_sparse(problem, plain: bool):
    """Adjust a perturbed problem with a dense and with a sparse solver, which must agree."""
    start = calibrated(perturb(problem, 0), CameraModel.SIMPLE_PINHOLE)
    start = without_depth(start) if plain else start
    dense = adjust_bundle(start, TIGHT)
    sparse = adjust_bundle(start, TIGHT.model_copy(update={"dense_poses": 0}))
    assert sparse.final_cost == pytest.approx(dense.final_cost, rel=1e-9)
    return dense, sparse


@pytest.mark.parametrize("plain", [False, True])
def test_conjugate_gradients_reach_the_dense_optimum(plain: bool) -> None:
    dense, sparse = adjust_dense_and_sparse(make_problem(30, 800, 5), plain)
    np.testing.assert_allclose(sparse.translations, dense.translations, atol=1e-5)


@pytest.mark.parametrize("plain", [False, True])
def test_long_chain_reaches_the_dense_optimum(plain: bool) -> None:
    """Conjugate gradients do not converge soon in a long chain, whose system is factorized."""
    dense, sparse = adjust_dense_and_sparse(make_problem(120, 2400, 4), plain)
    assert sparse.iterations == pytest.approx(dense.iterations, abs=3)
    np.testing.assert_allclose(sparse.translations, dense.translations, atol=1e-4)
    np.testing.assert_allclose(sparse.std_intrinsics, dense.std_intrinsics, rtol=1e-4)


@pytest.mark.parametrize("count", [2, 50, 1500])
def test_count_of_operations_of_a_chain_is_exact(count: int) -> None:
    """If only successive poses share points, a column of the factor has at most two blocks."""
    chain = np.array([(i, j) for i in range(count) for j in (i, i + 1) if j < count])
    operations = 7 * (4 * (count - 1) + 1) / (3 * count - 2)
    assert count_enough_iterations(chain, count) == round(FACTORIZATION_COST * operations)


def test_factorization_of_a_large_dense_system_takes_too_long() -> None:
    limits = (0, MAX_CG_ITERATIONS, MAX_FACTORIZATION_ITERATIONS, np.inf)
    for row, count in enumerate((400, 800, 2400)):
        dense = np.stack(np.triu_indices(count), axis=1)
        assert limits[row] < count_enough_iterations(dense, count) <= limits[row + 1]


def test_result_does_not_depend_on_threads() -> None:
    """Results are bitwise identical; the problem is large enough for several observation ranges."""
    start = perturb(make_problem(12, 6000, 4.5), 0)
    assert len(start.obs_image) > 24_000
    results = [adjust_bundle(start, soft_l1(threads=n)) for n in (1, 2, 3, 2)]
    for other in results[1:]:
        for name in (*PARAMETERS, "final_cost", "iterations"):
            np.testing.assert_array_equal(getattr(results[0], name), getattr(other, name))


def test_order_of_observations_does_not_matter() -> None:
    start = perturb(make_problem(6, 300, 4), 0)
    order = np.random.default_rng(0).permutation(len(start.obs_image))
    shuffled = replace(
        start,
        **{n: getattr(start, n)[order] for n in ("obs_image", "obs_point", "obs_xy")},
        obs_log_depth=start.obs_log_depth[order],
    )
    first, second = adjust_bundle(start, soft_l1()), adjust_bundle(shuffled, soft_l1())
    for name in PARAMETERS:
        np.testing.assert_array_equal(getattr(first, name), getattr(second, name))


def test_input_is_neither_changed_nor_kept() -> None:
    start = perturb(make_problem(5, 100, 3), 0)
    arrays = {f.name: getattr(start, f.name) for f in fields(start)}
    arrays = {name: a for name, a in arrays.items() if isinstance(a, np.ndarray)}
    copies = {name: a.copy() for name, a in arrays.items()}
    for array in arrays.values():
        array.flags.writeable = False
    result = adjust_bundle(start, soft_l1())
    for name, array in arrays.items():
        np.testing.assert_array_equal(array, copies[name])
    for name in PARAMETERS:
        given = getattr(start, name)
        assert given is None or not np.shares_memory(getattr(result, name), given)


def test_integer_types_and_strides_of_the_input_do_not_matter() -> None:
    start = perturb(make_problem(5, 100, 3), 0)
    strange = replace(
        start,
        obs_image=start.obs_image.astype(np.uint16),
        obs_point=np.asfortranarray(start.obs_point.astype(np.int32)),
        points=np.asfortranarray(start.points),
        obs_xy=np.repeat(start.obs_xy, 2, axis=0)[::2],
        camera_of_image=start.camera_of_image.astype(np.int8),
    )
    np.testing.assert_array_equal(
        adjust_bundle(start, soft_l1()).points, adjust_bundle(strange, soft_l1()).points
    )


def one_camera(points: Float64, **changes: object) -> BundleProblem:
    """Return a constant camera at the origin that observes each point at the image center."""
    count = len(points)
    problem = BundleProblem(
        rotations=np.eye(3)[None],
        translations=np.zeros((1, 3)),
        intrinsics=np.array([[1000.0, 1000.0, 500.0, 500.0]]),
        camera_of_image=np.array([0]),
        points=points,
        obs_image=np.zeros(count, dtype=np.int64),
        obs_point=np.arange(count),
        obs_xy=np.full((count, 2), 500.0),
        variable_pose=np.array([False]),
    )
    return replace(problem, **changes)


def test_single_view_points_move_to_their_depth() -> None:
    start = one_camera(
        np.array([[0.1, 0.2, 3.0], [-0.3, 0.1, 2.5]]),
        obs_log_depth=np.log([2.0, 4.0]),
        obs_std_log_depth=0.05,
    )
    result = adjust_bundle(start, soft_l1(depth_loss=Loss.TRIVIAL, function_tolerance=1e-15))
    np.testing.assert_allclose(result.points, [[0, 0, 2], [0, 0, 4]], atol=1e-6)


def test_single_view_points_without_depth_keep_their_depth() -> None:
    start = one_camera(np.array([[0.1, 0.2, 3.0], [-0.3, 0.1, 2.5]]))
    result = adjust_bundle(start, TIGHT)
    assert result.final_cost < 1e-12
    np.testing.assert_allclose(result.points[:, :2], 0, atol=1e-6)
    np.testing.assert_allclose(result.points[:, 2], start.points[:, 2], rtol=0.02)


@pytest.mark.parametrize("factor", [1e-3, 0.2, 5.0, 1e3])
def test_wrong_initial_depth_keeps_points_before_the_camera(factor: float) -> None:
    start = one_camera(
        np.array([[0.0, 0.0, 2.0 * factor]]),
        obs_log_depth=np.log([2.0]),
        obs_std_log_depth=0.05,
    )
    options = soft_l1(depth_loss=Loss.TRIVIAL, function_tolerance=1e-15)
    result = adjust_bundle(start, options)
    np.testing.assert_allclose(result.points, [[0, 0, 2]], atol=1e-6)


def test_points_behind_the_camera_are_ignored() -> None:
    start = one_camera(
        np.array([[0.1, 0.0, -2.0], [0.1, 0.0, 2.0], [0.0, 0.0, 0.0]]),
        obs_log_depth=np.log([2.0, 2.0, 2.0]),
    )
    result = adjust_bundle(start, TIGHT)
    np.testing.assert_array_equal(result.points[[0, 2]], start.points[[0, 2]])
    assert result.initial_cost == adjust_bundle(one_camera(start.points[1:2]), TIGHT).initial_cost
    np.testing.assert_allclose(result.points[1], [0, 0, 2], atol=1e-6)


def test_points_do_not_move_behind_the_camera() -> None:
    """No point in front of both cameras fits the measurements; the best point is behind a
    camera."""
    start = BundleProblem(
        rotations=np.stack([np.eye(3), np.eye(3)]),
        translations=np.array([[0.0, 0.0, 0.0], [-1.0, 0.0, 0.0]]),
        intrinsics=np.array([[1000.0, 1000.0, 500.0, 500.0]]),
        camera_of_image=np.array([0, 0]),
        points=np.array([[0.5, 0.0, 2.0]]),
        obs_image=np.array([0, 1]),
        obs_point=np.array([0, 0]),
        obs_xy=np.array([[300.0, 500.0], [700.0, 500.0]]),  # the rays meet behind the cameras
        variable_pose=np.zeros(2, dtype=np.bool_),
    )
    result = adjust_bundle(start, soft_l1())
    assert result.points[0, 2] > 0
    assert 0 < result.final_cost < result.initial_cost


def test_large_perturbation_reaches_the_same_cost() -> None:
    truth = make_problem(8, 400, 4)
    start = perturb(truth, 0, amount=10.0)
    result = adjust_bundle(start, soft_l1(max_iterations=200))
    good = adjust_bundle(perturb(truth, 0), soft_l1(max_iterations=200))
    assert result.final_cost < 1.05 * good.final_cost


@pytest.mark.parametrize("points", [0, 3])
def test_problem_without_observations_is_unchanged(points: int) -> None:
    start = one_camera(np.ones((points, 3)))
    none = np.zeros(0, dtype=np.int64)
    start = replace(
        start,
        obs_image=none,
        obs_point=none,
        obs_xy=np.zeros((0, 2)),
        variable_pose=np.array([True]),
        variable_intrinsics=np.ones((1, 8), dtype=np.bool_),
    )
    result = adjust_bundle(start, soft_l1())
    assert_fixed(start, result, PARAMETERS)
    assert (result.initial_cost, result.final_cost, result.converged) == (0, 0, True)


def test_iteration_limit_is_reported() -> None:
    start = perturb(make_problem(5, 100, 3), 0)
    result = adjust_bundle(start, soft_l1(max_iterations=1, function_tolerance=0))
    assert (result.iterations, result.converged) == (1, False)
    assert "limit" in result.message


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("rotations", np.zeros((5, 3))),
        ("translations", np.zeros((4, 3))),
        ("points", np.full((40, 3), np.nan)),
        ("intrinsics", np.zeros((1, 3))),
        ("camera_of_image", np.full(5, 1)),
        ("camera_of_image", np.zeros(5)),
        ("obs_xy", np.zeros((3, 2))),
        ("obs_std_px", 0.0),
        ("obs_std_px", np.ones(3)),
        ("obs_log_depth", np.zeros(3)),
        ("obs_std_log_depth", -1.0),
        ("variable_pose", np.ones(5)),
        ("variable_point", np.ones(3, dtype=np.bool_)),
        ("distortion", np.zeros((1, 3))),
        ("fisheye", np.ones(2, dtype=np.bool_)),
        ("variable_intrinsics", np.ones((1, 7), dtype=np.bool_)),
        ("prior_intrinsics", np.zeros((2, 8))),
        ("prior_std_intrinsics", 0.0),
        ("prior_std_intrinsics", np.ones(8)),
        ("log_scales", np.zeros(4)),
        ("expected_log_scales", np.full(5, np.nan)),
        ("std_log_scales", 0.0),
        ("variable_scale", np.ones(4, dtype=np.bool_)),
        ("scale_anchor", 0),
        ("scale_anchor", 7),
    ],
)
def test_wrong_input_raises_with_its_name(field: str, value: object) -> None:
    problem = make_problem(5, 40, 3)
    with pytest.raises(DataError) as caught:
        adjust_bundle(replace(problem, **{field: value}))
    assert caught.value.field == field


@pytest.mark.parametrize("field", ["obs_image", "obs_point"])
@pytest.mark.parametrize("value", [-1, 1000])
def test_indices_out_of_range_are_named(field: str, value: int) -> None:
    problem = make_problem(5, 40, 3)
    rows = getattr(problem, field).copy()
    rows[3] = value
    with pytest.raises(DataError, match=field):
        adjust_bundle(replace(problem, **{field: rows}))


@st.composite
def degenerate_problems(draw: st.DrawFn) -> BundleProblem:
    """Draw few random images and points, many coinciding, collinear, behind cameras or far away."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    images, points = draw(st.integers(1, 5)), draw(st.integers(1, 12))
    count = draw(st.integers(0, 40))
    scale = 10.0 ** draw(st.integers(-6, 6))
    shape = draw(st.sampled_from(["any", "same centre", "line", "plane", "on the cameras"]))
    turns = rng.normal(0, draw(st.sampled_from([0.0, 0.1, 3.0])), (images, 3))
    rotations = np.stack([rotation(turn) for turn in turns])
    centers = rng.normal(size=(images, 3)) * (0.0 if shape == "same centre" else 1.0)
    xyz = rng.normal(size=(points, 3))
    xyz[:, 2] += draw(st.sampled_from([-3.0, 0.0, 3.0, 1e5]))
    if shape == "line":
        xyz = np.outer(rng.normal(size=points), [0, 0, 1])
        centers *= [0, 0, 1]
    elif shape == "plane":
        xyz[:, 2] = 3.0
    elif shape == "on the cameras":
        xyz = centers[rng.integers(0, images, points)]
    far = 10.0 ** draw(st.integers(0, 8))
    model = draw(st.sampled_from(CameraModel))
    free = model.free_parameters(principal_point=draw(st.booleans()))
    return BundleProblem(
        rotations=rotations,
        translations=-np.einsum("nij,nj->ni", rotations, centers) * scale,
        intrinsics=rng.uniform(100, 2000, (images, 4)),
        camera_of_image=rng.integers(0, images, images),
        points=xyz * scale,
        obs_image=rng.integers(0, images, count),
        obs_point=rng.integers(0, points, count),
        obs_xy=rng.uniform(-far, far, (count, 2)),
        obs_std_px=10.0 ** rng.uniform(-3, 3, count),
        obs_log_depth=np.where(rng.random(count) < 0.5, rng.normal(0, 5, count), np.nan),
        obs_std_log_depth=10.0 ** rng.uniform(-6, 2, count),
        variable_pose=rng.random(images) < draw(st.sampled_from([0.0, 0.5, 1.0])),
        variable_point=rng.random(points) < draw(st.sampled_from([0.0, 0.5, 1.0])),
        distortion=rng.normal(0, 0.1, (images, 4)) * (np.arange(4) < model.num_distortion),
        fisheye=np.full(images, model.is_fisheye),
        variable_intrinsics=np.outer(rng.random(images) < draw(st.sampled_from([0.0, 0.5])), free),
    )


@settings(max_examples=300)
@given(
    problem=degenerate_problems(),
    reprojection_loss=st.sampled_from(Loss),
    depth_loss=st.sampled_from(Loss),
    dense=st.booleans(),
)
def test_degenerate_geometry_gives_finite_result(
    problem: BundleProblem, reprojection_loss: Loss, depth_loss: Loss, dense: bool
) -> None:
    """Degenerate problems cause no exception, warning, infinite value or cost increase."""
    options = soft_l1(
        reprojection_loss=reprojection_loss,
        depth_loss=depth_loss,
        dense_poses=500 if dense else 0,
    )
    result = adjust_bundle(problem, options)
    assert np.isfinite([result.initial_cost, result.final_cost]).all()
    assert result.final_cost <= result.initial_cost
    for name in PARAMETERS:
        assert np.isfinite(getattr(result, name)).all()
    again = adjust_bundle(
        replace(problem, **{name: getattr(result, name) for name in PARAMETERS}), options
    )
    assert again.initial_cost == pytest.approx(result.final_cost, rel=1e-9, abs=1e-9)
