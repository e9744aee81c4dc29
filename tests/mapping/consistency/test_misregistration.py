"""Tests of misregistration: detection by minimum cuts, and re-registration."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

from mpsfm_core.data import Bool, PinholeCamera
from mpsfm_core.geometry import rotation_angle_deg
from mpsfm_core.mapping.component import Component
from mpsfm_core.mapping.consistency.misregistration import (
    Misregistration,
    PairCounts,
    compute_widest_paths,
    count_pair_matches,
    detect_misregistrations,
    find_contradicted_cuts,
    find_misregistrations,
    sum_across_tree_cuts,
)
from mpsfm_core.mapping.events import NullMappingEvents
from mpsfm_core.mapping.mapper import Mapper
from mpsfm_core.mapping.options import MapperOptions
from mpsfm_core.testing.synthetic.problems import make_mapping_problem
from mpsfm_core.testing.synthetic.scenes import arc_poses, room_scene

CAMERA = PinholeCamera(320, 240, 260.0, 260.0, 160.0, 120.0)


def detect(
    explained: dict[tuple[int, int], int],
    unexplained: dict[tuple[int, int], int],
    registered: Bool,
) -> list[Misregistration]:
    """Find misregistrations by numbers of matches of pairs that are explained, or that are not."""
    return find_misregistrations(count(explained, unexplained), registered)


def count(
    explained: dict[tuple[int, int], int], unexplained: dict[tuple[int, int], int]
) -> PairCounts:
    """Count the matches of pairs whose matches are explained, or are not."""
    numbers = {tuple(sorted(p)): (n, 0, True) for p, n in explained.items()}
    numbers |= {tuple(sorted(p)): (0, n, False) for p, n in unexplained.items() if n >= 30}
    pairs = sorted(numbers)
    a, b = np.array(pairs, dtype=np.int64).T
    supporting, contradicting, is_explained = zip(*(numbers[p] for p in pairs), strict=True)
    return PairCounts(
        a, b, np.array(supporting), np.array(contradicting), np.array(is_explained, np.bool_)
    )


def test_pair_with_more_matches_than_minimum_cut_is_detected() -> None:
    """False matches register images 3 and 4 next to image 2; correct matches connect 3 to 0."""
    explained = {(0, 1): 200, (1, 2): 200, (3, 4): 300, (2, 3): 40, (2, 4): 30}
    unexplained = {(0, 3): 150, (1, 4): 90}
    (detected,) = detect(explained, unexplained, np.ones(5, np.bool_))
    assert detected.images == (3, 4)
    assert detected.margin == 150 + 90 - 70
    assert detected.supporting_pairs.tolist() == [[3, 2], [4, 2]]


def test_pair_with_fewer_matches_than_minimum_cut_is_ignored() -> None:
    explained = {(0, 1): 200, (1, 2): 90, (0, 3): 80, (2, 3): 80}
    unexplained = {(0, 2): 160, (1, 3): 25}
    assert detect(explained, unexplained, np.ones(4, np.bool_)) == []


def test_unregistered_image_separates_two_images_that_it_matches() -> None:
    """Image 4 is not registered and matches 0 and 3, so both poses cannot be correct."""
    explained = {(0, 1): 200, (1, 2): 200, (2, 3): 60}
    unexplained = {(0, 4): 100, (3, 4): 120}
    registered = np.array([True, True, True, True, False])
    (detected,) = detect(explained, unexplained, registered)
    assert (detected.images, detected.margin) == ((3,), 40)


@pytest.mark.parametrize(("num_supporting", "is_detected"), [(504, True), (560, False)])
def test_part_on_one_pair_against_more_matches_of_others_is_split(
    num_supporting: int, is_detected: bool
) -> None:
    """Images 3 and 4 are registered by one planar pair, and several other pairs contradict it."""
    explained = {(0, 1): 900, (1, 2): 800, (3, 4): 1700, (2, 4): num_supporting}
    contradicting = {(0, 3): 77, (1, 3): 153, (2, 3): 223, (1, 4): 53}
    detected = detect(explained, contradicting, np.ones(5, np.bool_))
    found = [(d.images, d.splits) for d in detected]
    assert found == ([((3, 4), True)] if is_detected else [])


def test_contradicted_cut_at_the_only_supporting_pair_is_found() -> None:
    """One pair connects 3 and 4 to the others; several pairs across contradict it."""
    explained = {(0, 1): 200, (1, 2): 200, (0, 2): 150, (3, 4): 300, (2, 3): 140}
    contradicting = {(0, 3): 110, (1, 4): 90, (0, 4): 80}
    (cut,) = find_contradicted_cuts(count(explained, contradicting), np.ones(5, np.bool_))
    assert np.flatnonzero(cut.inside).tolist() == [3, 4]
    assert cut.margin == 280 - 140
    assert (cut.num_supporting_pairs, cut.num_contradicting_pairs) == (1, 3)


@pytest.mark.parametrize("num_trees", [1, 3])
def test_sums_across_tree_cuts_equal_sums_over_all_pairs(num_trees: int) -> None:
    rng = np.random.default_rng(num_trees)
    n = 40
    edges = np.array(
        [rng.permutation([child, rng.integers(0, child)]) for child in range(num_trees, n)]
    )
    pairs = np.stack(np.triu_indices(n, 1), axis=1)
    pairs = pairs[rng.permutation(len(pairs))[:300]]
    values = rng.integers(0, 100, (300, 2))
    sums = sum_across_tree_cuts(edges, pairs, values, n)
    for row, (node, _) in enumerate(edges):
        others = np.delete(edges, row, axis=0)
        forest = csr_array((np.ones(len(others)), others.T), shape=(n, n))
        part_of = connected_components(forest, directed=False)[1]
        inside = part_of == part_of[node]
        is_across = inside[pairs[:, 0]] != inside[pairs[:, 1]]
        assert np.array_equal(sums[row], values[is_across].sum(axis=0))


def test_cut_with_more_supporting_matches_is_ignored() -> None:
    explained = {(0, 1): 200, (1, 2): 200, (3, 4): 300, (2, 3): 140, (1, 3): 90}
    contradicting = {(0, 3): 110, (1, 4): 90}
    assert find_contradicted_cuts(count(explained, contradicting), np.ones(5, np.bool_)) == []


@pytest.mark.parametrize(("step", "is_found"), [(1, True), (3, False)])
def test_cut_is_contradicted_only_by_pairs_that_confirm_each_other(
    step: int, is_found: bool
) -> None:
    """Images on a circle match their neighbors, and four of them contradict opposite images."""
    n = 24
    explained = {(i, (i + 1) % n): 61 for i in range(n)}
    explained |= {(i, (i + 2) % n): 60 for i in range(n)}
    contradicting = {(i, i + n // 2): 150 for i in range(0, 4 * step, step)}
    cuts = find_contradicted_cuts(count(explained, contradicting), np.ones(n, np.bool_))
    assert any(cut.num_contradicting_pairs == 4 for cut in cuts) == is_found
    assert bool(cuts) == is_found


def test_image_whose_pairs_together_contradict_it_is_detected() -> None:
    """False matches register image 6 next to 0 to 2; no single pair outweighs them."""
    correct = {(a, b): 200 for a in range(6) for b in range(a)}
    explained = correct | {(6, 0): 100, (6, 1): 100, (6, 2): 100}
    everything = np.ones(7, np.bool_)
    (detected,) = detect(explained, {(6, 3): 170, (6, 4): 170, (6, 5): 170}, everything)
    assert (detected.images, detected.margin) == ((6,), 510 - 300)
    assert detected.supporting_pairs.tolist() == [[6, 0], [6, 1], [6, 2]]
    # more, but not significantly
    assert detect(explained, {(6, 3): 120, (6, 4): 120, (6, 5): 120}, everything) == []


def test_widest_paths_equal_floyd_warshall() -> None:
    rng = np.random.default_rng(0)
    for _ in range(20):
        upper = np.triu(rng.integers(0, 9, (7, 7)) * (rng.random((7, 7)) < 0.5), 1)
        widest = upper + upper.T
        explained = {(int(a), int(b)): int(upper[a, b]) for a, b in np.argwhere(upper)}
        for k, i, j in product(range(7), repeat=3):
            widest[i, j] = max(widest[i, j], min(widest[i, k], widest[k, j]))
        pairs = np.stack(np.triu_indices(7, 1), axis=1)
        np.testing.assert_array_equal(
            compute_widest_paths(count(explained, {}), pairs, 7), widest[tuple(pairs.T)]
        )


@pytest.fixture
def component() -> Component:
    """Return a component with all images of a noise-free scene registered."""
    problem = make_mapping_problem(room_scene(), CAMERA, arc_poses(5, 14.0))
    mapper = Mapper(problem, MapperOptions(), NullMappingEvents())
    mapper.reconstruct_component()
    return mapper.component


def misplace(component: Component, image: int) -> None:
    """Rotate a camera and remove all but ten of its observations."""
    scene = component.scene
    turn = np.array([[0.8, 0.0, 0.6], [0.0, 1.0, 0.0], [-0.6, 0.0, 0.8]])
    scene.rotations[image] = turn @ scene.rotations[image]
    scene.translations[image] = turn @ scene.translations[image]
    keypoints = np.arange(*scene.graph.offsets[image : image + 2])
    seen = keypoints[scene.tracks.point_of[keypoints] >= 0]
    scene.tracks.remove_observations(seen[10:])


def test_misregistered_image_is_reregistered_at_correct_pose(component: Component) -> None:
    assert detect_misregistrations(component.scene, 30) == []
    right = component.scene.rotations.copy()
    misplace(component, 4)
    assert [group.images for group in detect_misregistrations(component.scene, 30)] == [(4,)]
    component.reregister_images(np.ones(5, np.bool_))
    assert component.scene.registered.all()
    assert rotation_angle_deg(component.scene.rotations @ right.transpose(0, 2, 1)).max() < 0.1
    counts = count_pair_matches(component.scene)
    rows = (counts.a == 4) | (counts.b == 4)
    assert counts.is_explained[rows].all()


@pytest.mark.parametrize(
    ("images", "splits", "differs"),
    [
        ((4, 5, 6, 7, 8), False, False),
        ((4, 5), False, True),
        ((4, 5, 6, 7), True, False),
        ((4, 5, 6, 7, 8), True, True),
        ((7, 8, 9, 10), False, True),
    ],
)
def test_set_with_mostly_the_same_images_counts_as_the_same(
    images: tuple[int, ...], splits: bool, differs: bool
) -> None:
    none = np.zeros((0, 2), dtype=np.int64)
    tried = [Misregistration((4, 5, 6, 7), none, 90), Misregistration((1, 2), none, 80)]
    assert Misregistration(images, none, 70, splits).differs_from(tried) == differs


def test_failed_reregistration_restores_scene(
    component: Component, monkeypatch: pytest.MonkeyPatch
) -> None:
    misplace(component, 4)
    before, noise = component.scene.snapshot(), component.refiner.noise
    monkeypatch.setattr(component, "register_images", lambda candidates, *, wide: None)
    component.reregister_images(np.ones(5, np.bool_))
    after = component.scene.snapshot()
    np.testing.assert_array_equal(after.rotations, before.rotations)
    np.testing.assert_array_equal(after.point_of, before.point_of)
    assert after.registered.all()
    assert component.refiner.noise == noise


@pytest.mark.parametrize(("known", "moves"), [("start", False), ("guess", True)])
def test_image_with_known_pose_is_reregistered_only_if_guess(known: str, moves: bool) -> None:
    poses = arc_poses(5, 14.0)
    problem = make_mapping_problem(room_scene(), CAMERA, poses)
    named = zip(problem.images, poses, strict=True)
    problem = problem.with_poses({i.name: (p[:, :3].copy(), p[:, 3].copy()) for i, p in named})
    mapper = Mapper(problem, MapperOptions(known_poses=known), NullMappingEvents())  # type: ignore[arg-type]
    mapper.reconstruct_component()
    misplace(mapper.component, 4)
    wrong = mapper.component.scene.rotations[4].copy()
    mapper.component.reregister_images(np.ones(5, np.bool_))
    assert (rotation_angle_deg(mapper.component.scene.rotations[4] @ wrong.T) > 10) == moves
