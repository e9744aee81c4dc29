"""Tests of global initialization: accuracy, robustness, and fallback to an initial pair."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial.transform import Rotation

from mpsfm_core.data import Float64, Int64, MappingProblem
from mpsfm_core.evaluation.pose_auc import CONVENTIONS, pose_errors_deg
from mpsfm_core.geometry import rotation_angle_deg
from mpsfm_core.mapping.initialization import global_initialization
from mpsfm_core.mapping.initialization.global_initialization import (
    GlobalPoses,
    average_differences,
    average_rotations,
    estimate_global_poses,
    find_cycle_edges,
    find_short_cycle_edges,
)
from mpsfm_core.mapping.mapper import reconstruct
from mpsfm_core.mapping.options import MapperOptions
from mpsfm_core.mapping.scene.scene import Scene
from mpsfm_core.testing.synthetic.halls import CALIBRATED_PRIORS, HallProblem, make_hall_problem

VIEWS = 16


@pytest.fixture(scope="module")
def hall() -> HallProblem:
    return make_hall_problem(VIEWS, CALIBRATED_PRIORS, seed=2)


def place(problem: MappingProblem, candidates: Float64 | None = None) -> GlobalPoses | None:
    everything = np.ones(len(problem.images), dtype=np.bool_)
    return estimate_global_poses(Scene(problem), everything if candidates is None else candidates)


def worst_deg(placed: GlobalPoses, hall: HallProblem) -> float:
    """Return the 0.9 quantile of the relative pose errors in degrees."""
    names = [hall.problem.images[image].name for image in placed.images]
    poses = zip(names, zip(placed.rotations, placed.translations, strict=True), strict=True)
    truth = {name: hall.truth[name] for name in names}
    return float(np.quantile(pose_errors_deg(dict(poses), truth, CONVENTIONS["paper"]), 0.9))


def test_estimate_global_poses_registers_all_images_near_truth(hall: HallProblem) -> None:
    placed = place(hall.problem)
    assert placed is not None
    assert len(placed.images) >= VIEWS - 2
    assert worst_deg(placed, hall) < 3
    assert np.log(placed.scales).std() < 0.1


def test_small_blocks_of_matches_give_equal_poses(
    hall: HallProblem, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = place(hall.problem)
    monkeypatch.setattr(global_initialization, "BLOCK_MATCHES", 300)
    in_blocks = place(hall.problem)
    assert whole is not None
    assert in_blocks is not None
    for values, expected in zip(in_blocks, whole, strict=True):
        np.testing.assert_array_equal(values, expected)


def test_wrong_pair_is_removed(hall: HallProblem) -> None:
    problem = hall.problem
    turn = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
    wrong = replace(problem.pairs[0], rotation=turn @ problem.pairs[0].rotation)
    corrupted = MappingProblem(problem.images, (wrong, *problem.pairs[1:]))
    placed = place(corrupted)
    assert placed is not None
    assert worst_deg(placed, hall) < 3


def test_images_that_are_no_candidates_are_left_out(hall: HallProblem) -> None:
    candidates = np.ones(VIEWS, dtype=np.bool_)
    candidates[3] = False
    placed = place(hall.problem, candidates)
    assert placed is not None
    assert 3 not in placed.images


def test_chain_of_pairs_returns_none(hall: HallProblem) -> None:
    chain = [p for p in hall.problem.pairs if p.image_b == p.image_a + 1]
    assert place(MappingProblem(hall.problem.images, tuple(chain))) is None


def test_bridge_separates_components_and_largest_is_returned(hall: HallProblem) -> None:
    """A single pair connects two components; the larger one is returned."""
    problem = hall.problem
    first = [p for p in problem.pairs if p.image_b < 10]
    second = [p for p in problem.pairs if p.image_a >= 10]
    between = [p for p in problem.pairs if p.image_a < 10 <= p.image_b]
    bridge = max(between, key=len)
    placed = place(MappingProblem(problem.images, (*first, bridge, *second)))
    assert placed is not None
    assert max(placed.images) < 10


def draw_links(rng: np.random.Generator, count: int, end: int) -> Int64:
    """Draw a graph with ``count`` nodes and 1 to ``end - 1`` edges; return the edges (m, 2)."""
    possible = np.stack(np.triu_indices(count, 1), axis=1)
    return possible[rng.choice(len(possible), rng.integers(1, end), replace=False)]


@pytest.mark.parametrize("seed", range(20))
def test_find_cycle_edges_returns_edges_that_are_no_bridges(seed: int) -> None:
    rng = np.random.default_rng(seed)
    count = 20
    links = draw_links(rng, count, 30)
    flip = rng.random(len(links)) < 0.5
    links[flip] = links[flip][:, ::-1]

    def groups(rows: Int64) -> int:
        ends = rows[:, 0], rows[:, 1]
        matrix = coo_matrix((np.ones(len(rows)), ends), shape=(count, count))
        return int(connected_components(matrix, directed=False)[0])

    whole = groups(links)
    spared = [groups(np.delete(links, row, axis=0)) == whole for row in range(len(links))]
    assert find_cycle_edges(links[:, 0], links[:, 1], count).tolist() == spared


@pytest.mark.parametrize("seed", range(10))
def test_find_short_cycle_edges_returns_edges_on_triangles_and_squares(seed: int) -> None:
    rng = np.random.default_rng(seed)
    count = 14
    links = draw_links(rng, count, 25)
    neighbors = np.zeros((count, count), np.bool_)
    neighbors[links[:, 0], links[:, 1]] = neighbors[links[:, 1], links[:, 0]] = True

    def is_on_short_cycle(a: int, b: int) -> bool:
        first, second = neighbors[a].copy(), neighbors[b].copy()
        first[b] = second[a] = False
        return bool((first & second).any() or neighbors[first][:, second].any())

    expected = [is_on_short_cycle(a, b) for a, b in links.tolist()]
    assert find_short_cycle_edges(links[:, 0], links[:, 1], count).tolist() == expected


def test_rotations_of_a_circle_are_averaged_despite_heavy_wrong_edges() -> None:
    """Wrong edges between opposite images have most matches, but are on no short cycle."""
    count, rng = 60, np.random.default_rng(0)
    truth = Rotation.random(count, rng=rng).as_matrix()
    near = [(i, (i + step) % count) for step in (1, 2) for i in range(count)]
    wrong = [(i, i + 30) for i in range(0, 30, 6)]
    a, b = np.array([*near, *wrong]).T
    relative = truth[b] @ truth[a].transpose(0, 2, 1)
    relative[len(near) :] = Rotation.random(len(wrong), rng=rng).as_matrix()
    weights = np.where(np.arange(len(a)) < len(near), 50.0, 400.0)
    averaged = average_rotations(
        a, b, relative, weights, count, find_short_cycle_edges(a, b, count)
    )
    gauge = truth[0].T @ averaged[0]
    assert np.abs(truth @ gauge - averaged).max() < 1e-6


def test_pairs_that_contradict_depth_have_low_weight(hall: HallProblem) -> None:
    """Two of three pairs of an image have a rotation error of 12 degrees."""
    problem, image = hall.problem, 5
    tilt = Rotation.from_rotvec([0.0, np.radians(12.0), 0.0]).as_matrix()
    pairs = []
    for number, pair in enumerate(problem.pairs):
        if number % 3 and image == pair.image_a:
            pair = replace(pair, rotation=pair.rotation @ tilt.T)
        elif number % 3 and image == pair.image_b:
            turned = tilt @ pair.rotation, tilt @ pair.translation
            pair = replace(pair, rotation=turned[0], translation=turned[1])
        pairs.append(pair)
    placed = place(MappingProblem(problem.images, tuple(pairs)))
    assert placed is not None
    assert image in placed.images
    assert worst_deg(placed, hall) < 3


def test_average_differences_with_outlier_recovers_values() -> None:
    rng = np.random.default_rng(0)
    truth = rng.normal(size=(6, 3))
    a, b = (np.array(ends) for ends in np.tril_indices(6, -1))
    steps = truth[b] - truth[a]
    steps[4] += 5
    ones = np.ones(len(a))
    values = average_differences(a, b, steps, ones, 6, ones)
    np.testing.assert_allclose(values, truth - truth.mean(axis=0), atol=1e-3)


def test_average_differences_with_prior_do_not_drift() -> None:
    """With a prior, small errors of the steps along a chain do not add up."""
    rng = np.random.default_rng(0)
    a, b = np.array([(i, i + k) for i in range(97) for k in (1, 2, 3)]).T
    ones, true = np.ones(len(a)), rng.normal(0, 0.1, 100)
    steps = true[b] - true[a] + 0.03 * (b - a) + rng.normal(0, 0.02, len(a))
    drifted = average_differences(a, b, steps, ones, 100, ones) - true
    values = average_differences(a, b, steps, ones, 100, ones, np.ones(100))
    assert np.ptp(drifted) > 2
    assert np.ptp(values - true) < 0.5
    assert np.corrcoef(np.diff(values), np.diff(true))[0, 1] > 0.9


def test_average_differences_start_from_confirmed_edges() -> None:
    """The differences between neighbors are correct, and those between distant nodes are wrong.

    With equal first weights, the wrong differences make the line of nodes too short.
    """
    count, rng = 400, np.random.default_rng(0)
    near = np.array([(i, i + step) for step in (1, 2) for i in range(count - step)])
    wrong = np.array([(i, i + 150) for i in range(0, 240, 12)])
    a, b = np.concatenate([near, wrong]).T
    steps = (b - a + rng.normal(0, 0.02, len(a)))[:, None]
    steps[len(near) :] = 1.0
    weights = np.where(np.arange(len(a)) < len(near), 1.0, 3.0)
    is_confirmed = find_short_cycle_edges(a, b, count)
    np.testing.assert_array_equal(is_confirmed, np.arange(len(a)) < len(near))

    def measure_length(first_weights: Float64) -> float:
        values = average_differences(a, b, steps, weights, count, first_weights)
        return float(values[-1, 0] - values[0, 0])

    assert abs(measure_length(np.where(is_confirmed, 1.0, 1e-3)) - 399) < 2
    assert measure_length(np.ones(len(a))) < 300


def test_average_rotations_with_outliers_recovers_rotations() -> None:
    """A third of the pairs are wrong with fewer matches; the rest has an error of 1 degree."""
    rng = np.random.default_rng(0)
    count = 16
    truth = Rotation.random(count, rng).as_matrix()
    a, b = np.array([(i, j) for i in range(count) for j in range(i)], dtype=np.int64).T
    noise = Rotation.from_rotvec(np.radians(1.0) * rng.normal(size=(len(a), 3)))
    turns = noise.as_matrix() @ truth[b] @ truth[a].transpose(0, 2, 1)
    wrong = rng.random(len(a)) < 0.33
    turns[wrong] = Rotation.random(int(wrong.sum()), rng).as_matrix()
    is_confirmed = np.ones(len(a), dtype=np.bool_)
    weights = np.where(wrong, 30.0, 100.0)
    rotations = average_rotations(a, b, turns, weights, count, is_confirmed)
    world = rotations[0].T @ truth[0]
    off = rotation_angle_deg(rotations @ world @ truth.transpose(0, 2, 1))
    assert off.max() < 2.5


def test_global_initialization_is_as_accurate_as_initial_pair(hall: HallProblem) -> None:
    errors = {}
    for global_first in (True, False):
        options = MapperOptions.model_validate({"global_initialization": global_first})
        result = reconstruct(hall.problem, options)
        poses = result.reconstructions[0].poses
        assert len(poses) == VIEWS
        errors[global_first] = np.median(pose_errors_deg(poses, hall.truth, CONVENTIONS["paper"]))
        assert ("global initialization" in result.report.counts) == global_first
        assert ("local refinement" in result.report.counts) != global_first
    assert errors[True] < 1.1 * errors[False]


@pytest.mark.slow
def test_unexplained_matches_fall_back_to_initial_pair(hall: HallProblem) -> None:
    rng = np.random.default_rng(0)
    pairs = []
    for pair in hall.problem.pairs:
        matches = pair.matches.copy()
        wrong = rng.choice(len(matches), len(matches) // 3, replace=False)
        matches[wrong, 1] = np.roll(matches[wrong, 1], 1)
        pairs.append(replace(pair, matches=matches))
    result = reconstruct(
        MappingProblem(hall.problem.images, tuple(pairs)),
        MapperOptions(max_runs=1),
    )
    assert "initialization" in result.report.counts
    assert len(result.reconstructions[0].images) >= VIEWS - 2
