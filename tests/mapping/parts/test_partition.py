"""Tests of the partition of the match graph into overlapping parts."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from mpsfm_core.data import (
    DepthPrior,
    Int64,
    MappingImage,
    MappingProblem,
    NormalPrior,
    PinholeCamera,
    Rig,
    VerifiedPair,
)
from mpsfm_core.mapping.parts.partition import MIN_COMMON_FRAMES, partition_match_graph

CAMERA = PinholeCamera(8, 6, 8.0, 8.0, 4.0, 3.0)
MAP = np.ones((6, 8), np.float32)
FACING = np.tile(np.float32([0, 0, -1]), (6, 8, 1))


def make_problem(num_images: int, links: list[tuple[int, int, int]]) -> MappingProblem:
    """Return images without content, and pairs (image, image, number of matches)."""
    images = tuple(
        MappingImage(
            f"{number:03d}.png",
            CAMERA,
            np.zeros((500, 2)),
            DepthPrior.from_arrays(MAP, MAP),
            NormalPrior.from_arrays(FACING, MAP),
        )
        for number in range(num_images)
    )
    pairs = []
    for a, b, count in links:
        matches = np.tile(np.arange(count)[:, None], 2)
        scores = np.ones(count, np.float32)
        pairs.append(VerifiedPair(a, b, matches, scores, np.eye(3), np.zeros(3)))
    return MappingProblem(images, tuple(pairs))


def grid_links(columns: int, rows: int) -> list[tuple[int, int, int]]:
    """Return the links of a street grid between neighbors, with random numbers of matches."""
    node = np.arange(rows * columns).reshape(rows, columns)
    a = np.concatenate([node[:, :-1].ravel(), node[:-1].ravel()])
    b = np.concatenate([node[:, 1:].ravel(), node[1:].ravel()])
    counts = np.random.default_rng(0).integers(30, 300, len(a))
    return list(zip(a.tolist(), b.tolist(), counts.tolist(), strict=True))


def num_components(problem: MappingProblem, part: Int64) -> int:
    inside = problem.subset([problem.images[i].name for i in part])
    ends = np.array([(pair.image_a, pair.image_b) for pair in inside.pairs])
    graph = coo_array((np.ones(len(ends)), ends.T), shape=(len(part), len(part)))
    return int(connected_components(graph, directed=False)[0])


@pytest.mark.parametrize("size", [30, 60, 100])
def test_parts_cover_all_images_overlap_and_are_connected(size: int) -> None:
    problem = make_problem(240, grid_links(20, 12))
    parts = partition_match_graph(problem, size, overlap=0.2)
    assert len(parts) >= 240 / size
    assert np.array_equal(np.unique(np.concatenate(parts)), np.arange(240))
    sets = [set(part.tolist()) for part in parts]
    overlaps = np.array([[len(a & b) for b in sets] for a in sets])
    assert connected_components(overlaps >= MIN_COMMON_FRAMES, directed=False)[0] == 1
    for part in parts:
        assert num_components(problem, part) == 1
        assert len(part) <= size + max(0.3 * size, 8 * MIN_COMMON_FRAMES)


def test_partition_is_independent_of_the_order_of_files() -> None:
    links = grid_links(16, 8)
    order = np.random.default_rng(3).permutation(128)
    shuffled = [(*sorted((int(order[a]), int(order[b]))), count) for a, b, count in links]
    parts = partition_match_graph(make_problem(128, links), 40)
    others = partition_match_graph(make_problem(128, shuffled), 40)
    assert {frozenset(order[part].tolist()) for part in parts} == {
        frozenset(part.tolist()) for part in others
    }


def test_cut_has_the_fewest_matches() -> None:
    # two chains of 20 images with many matches, connected by one weak pair in the middle
    links = [(i, i + 1, 200) for i in range(39)] + [(i, i + 2, 100) for i in range(38)]
    links = [(a, b, 10 if a <= 19 < b else count) for a, b, count in links]
    first, second = partition_match_graph(make_problem(40, links), 25, overlap=0)
    assert set(range(20)) <= set(first.tolist()) or set(range(20)) <= set(second.tolist())
    assert set(first.tolist()) & set(second.tolist()) == {18, 19, 20, 21}


def test_single_pair_of_images_that_look_alike_adds_no_image_to_a_part() -> None:
    links = grid_links(20, 12)
    parts = partition_match_graph(make_problem(240, links), 60)
    false_pair = (0, 239, 400)
    assert all(
        np.array_equal(part, other)
        for part, other in zip(
            parts, partition_match_graph(make_problem(240, [*links, false_pair]), 60), strict=True
        )
    )


def test_components_are_parts_and_unmatched_images_are_in_no_part() -> None:
    links = [(i, i + 1, 60) for i in range(9)] + [(i, i + 1, 60) for i in range(10, 15)]
    parts = partition_match_graph(make_problem(18, links), 30)
    assert [part.tolist() for part in parts] == [list(range(10)), list(range(10, 16))]


def test_frames_of_a_rig_are_not_separated() -> None:
    problem = make_problem(80, [(i, i + 2, 60) for i in range(78)])
    sensors = (np.eye(3), np.zeros(3)), (np.eye(3), np.array([-0.1, 0.0, 0.0]))
    frames = tuple((f"{i:03d}.png", f"{i + 1:03d}.png") for i in range(0, 80, 2))
    parts = partition_match_graph(replace(problem, rigs=(Rig(sensors, frames),)), 30)
    assert len(parts) > 2
    for part in parts:
        assert np.array_equal(part.reshape(-1, 2)[:, 0] + 1, part.reshape(-1, 2)[:, 1])
