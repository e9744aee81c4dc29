"""Tests of the multigrid solver: solutions, symmetric positive preconditioner, convergence."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.sparse.linalg import spsolve

from mpsfm_core.optimize.multigrid import (
    Multigrid,
    _coarsen,
    _derive_interpolation,
    _prepare_smoother,
    _prolong,
)
from tests.optimize.integration_reference import grid_operator

Planes = tuple[np.ndarray, np.ndarray, np.ndarray]


def random_planes(shape: tuple[int, int], seed: int, decades: float, cut: float = 0.2) -> Planes:
    """Return couplings over several orders of magnitude, a share of them zero, and masses."""
    rng = np.random.default_rng(seed)
    east, south = 10 ** rng.uniform(0, decades, (2, *shape))
    east[rng.random(shape) < cut] = 0
    south[rng.random(shape) < cut] = 1e-20
    mass = 10 ** rng.uniform(-1, 1, shape)
    return east.astype(np.float32), south.astype(np.float32), mass.astype(np.float32)


def depth_like_planes(size: int) -> Planes:
    """Return strong couplings, weak masses, separate regions, and strips of one or two pixels."""
    rng = np.random.default_rng(size)
    rows, columns = np.mgrid[:size, :size]
    region = (np.hypot(rows - size / 2, columns - size / 3) < size / 4) + 2 * (rows > 0.6 * size)
    for k, width in enumerate((1, 1, 2)):
        region[7 + 11 * k : 7 + 11 * k + width] = 10 + k
        region[:, 8 + 13 * k : 8 + 13 * k + width] = 20 + k
    east, south = 1e5 * np.exp(rng.normal(size=(2, size, size)))
    east[:, :-1][region[:, 1:] != region[:, :-1]] *= 1e-20
    south[:-1][region[1:] != region[:-1]] *= 1e-20
    mass = np.full((size, size), 0.3)
    return east.astype(np.float32), south.astype(np.float32), mass.astype(np.float32)


def heavy_planes(shape: tuple[int, int], seed: int) -> Planes:
    """Return strong, partly cut couplings of pixels, and weak data terms, a few of them strong."""
    rng = np.random.default_rng(seed)
    east, south = 1e5 * np.exp(rng.normal(size=(2, *shape)))
    east[rng.random(shape) < 0.4] *= 1e-20
    south[rng.random(shape) < 0.1] *= 1e-20
    mass = np.where(rng.random(shape) < 0.05, 1e4, 0.05)
    return east.astype(np.float32), south.astype(np.float32), mass.astype(np.float32)


def energy_error(planes: Planes, x: np.ndarray, solution: np.ndarray) -> float:
    """Return the energy norm of the error relative to the energy norm of the solution."""
    matrix = grid_operator(*planes)
    error, full = (x - solution).ravel(), solution.ravel()
    return float(np.sqrt(error @ (matrix @ error) / (full @ (matrix @ full))))


@settings(max_examples=40)
@given(
    height=st.integers(1, 14),
    width=st.integers(1, 14),
    decades=st.floats(0, 3),
    seed=st.integers(0, 10**6),
)
def test_solution_equals_direct_solver(height, width, decades, seed):
    planes = random_planes((height, width), seed, decades)
    rhs = np.random.default_rng(seed + 1).normal(size=(height, width))
    solver = Multigrid(height, width)
    solver.update(*planes)
    x = solver.solve(rhs, 200, 1e-8).x
    exact = spsolve(grid_operator(*planes).tocsc(), rhs.ravel()).reshape(rhs.shape)
    assert energy_error(planes, x, exact) < 1e-6


@pytest.mark.parametrize("shape", [(1, 1), (1, 9), (8, 1), (5, 7), (12, 13)])
def test_preconditioner_is_symmetric_with_eigenvalues_up_to_one(shape):
    matrix = preconditioner_of(random_planes(shape, 3, 2.0))
    np.testing.assert_allclose(matrix, matrix.T, atol=1e-12 * np.abs(matrix).max())
    assert spectrum(random_planes(shape, 3, 2.0)).min() > 0.05
    assert spectrum(random_planes(shape, 3, 2.0)).max() < 1 + 1e-6


@pytest.mark.parametrize("seed", [1, 26, 33, 38])
def test_strong_data_terms_between_strips_keep_eigenvalues_up_to_one(seed):
    # Pixels with a strong data term give coarse grids negative masses.
    values = spectrum(heavy_planes((17, 16), seed))
    assert values.min() > 0
    assert values.max() < 1 + 1e-6


def spectrum(planes: Planes) -> np.ndarray:
    """Return the eigenvalues of the preconditioned operator."""
    return np.linalg.eigvals(preconditioner_of(planes) @ grid_operator(*planes).toarray()).real


def preconditioner_of(planes: Planes) -> np.ndarray:
    """Return the matrix of one V-cycle."""
    shape = planes[0].shape
    solver = Multigrid(*shape)
    solver.update(*planes)
    columns = []
    for unit in np.eye(planes[0].size):
        solver.solve(unit.reshape(shape), 1)
        columns.append(solver._levels[0].x[1:-1, 1:-1].ravel().copy())
    return np.array(columns)


@pytest.mark.parametrize("shape", [(9, 12), (1, 8), (7, 7)])
def test_coarse_energy_equals_energy_of_interpolated_map(shape):
    east, south, mass = random_planes(shape, 5, 2.0, cut=0.0)
    solver = Multigrid(*shape)
    solver.update(east, south, 0 * mass)
    for fine, coarse in zip(solver._levels[:2], solver._levels[1:3], strict=False):
        _prepare_smoother(fine)
        _derive_interpolation(fine, coarse)
        _coarsen(fine, coarse, fine is not solver._levels[0])
        height, width = coarse.x.shape
        values = np.random.default_rng(1).normal(size=(height - 2, width - 2))
        coarse.x[:] = fine.x[:] = 0
        coarse.x[1:-1, 1:-1] = values
        _prolong(coarse, fine)
        assert level_energy(coarse) == pytest.approx(level_energy(fine), rel=1e-9)


def level_energy(level) -> float:
    """Return x' A x of a multigrid level with nine-point stencils."""
    x = level.x
    total = (level.mass * x**2).sum()
    total += (level.east[:, :-1] * np.diff(x, axis=1) ** 2).sum()
    total += (level.south[:-1] * np.diff(x, axis=0) ** 2).sum()
    total += (level.southeast[:-1, :-1] * (x[1:, 1:] - x[:-1, :-1]) ** 2).sum()
    total += (level.southwest[:-1, 1:] * (x[1:, :-1] - x[:-1, 1:]) ** 2).sum()
    return float(total)


def test_few_iterations_suffice_at_any_size():
    needed = []
    for size in (65, 130, 260):
        planes = depth_like_planes(size)
        solver = Multigrid(size, size)
        solver.update(*planes)
        truth = np.random.default_rng(0).normal(size=(size, size)).cumsum(0).cumsum(1)
        rhs = (grid_operator(*planes) @ truth.ravel()).reshape(size, size)
        needed.append(solver.solve(rhs, 100, 1e-4).iterations)
        assert energy_error(planes, solver.solve(rhs, 8).x, truth) < 1e-2
    assert max(needed) <= 12
    assert needed[-1] <= 2 * needed[0]


def test_relative_error_is_close_to_the_true_error():
    planes = depth_like_planes(64)
    solver = Multigrid(64, 64)
    solver.update(*planes)
    truth = np.random.default_rng(0).normal(size=(64, 64))
    rhs = (grid_operator(*planes) @ truth.ravel()).reshape(64, 64)
    solution = solver.solve(rhs, 50, 1e-3)
    assert solution.relative_error < 1e-3
    assert energy_error(planes, solution.x, truth) < 3 * solution.relative_error


def test_detached_pixels_stay_zero():
    planes = random_planes((9, 10), 1, 2.0)
    for plane in planes:
        plane[3:6, 3:6] = 0
    planes[0][3:6, 2] = 0
    planes[1][2, 3:6] = 0
    solver = Multigrid(9, 10)
    solver.update(*planes)
    rhs = np.ones((9, 10))
    rhs[3:6, 3:6] = 0
    x = solver.solve(rhs, 30).x
    assert np.isfinite(x).all()
    assert (x[3:6, 3:6] == 0).all()


def test_zero_right_hand_side_needs_no_iteration():
    solver = Multigrid(6, 6)
    solver.update(*random_planes((6, 6), 1, 2.0))
    solution = solver.solve(np.zeros((6, 6)), 10, 1e-3)
    assert solution.iterations == 0
    assert not solution.x.any()


def test_threads_do_not_change_results():
    planes = depth_like_planes(64)
    rhs = np.random.default_rng(0).normal(size=(64, 64))

    def solve(_: int) -> np.ndarray:
        solver = Multigrid(64, 64)
        solver.update(*planes)
        return solver.solve(rhs, 5).x

    alone = solve(0)
    with ThreadPoolExecutor(4) as pool:
        for x in pool.map(solve, range(8)):
            np.testing.assert_array_equal(x, alone)
