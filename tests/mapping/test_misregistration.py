"""Images that fewer matches hold where they are than would hold them elsewhere."""

from __future__ import annotations

from itertools import product
from types import SimpleNamespace

import numpy as np
import pytest

from mpsfm_core.data import Bool, Int64, PinholeCamera
from mpsfm_core.geometry import rotation_angle_deg
from mpsfm_core.mapping.component import Component
from mpsfm_core.mapping.consistency import misregistration as module
from mpsfm_core.mapping.consistency.misregistration import (
    Misregistration,
    compute_widest_paths,
    count_pair_matches,
    detect_misregistrations,
)
from mpsfm_core.mapping.events import NullMappingEvents
from mpsfm_core.mapping.mapper import Mapper
from mpsfm_core.mapping.options import MapperOptions
from mpsfm_core.testing.synthetic.problems import make_mapping_problem
from mpsfm_core.testing.synthetic.scenes import arc_poses, room_scene

CAMERA = PinholeCamera(320, 240, 260.0, 260.0, 160.0, 120.0)


def symmetric(n: int, entries: dict[tuple[int, int], int]) -> Int64:
    matrix = np.zeros((n, n), dtype=np.int64)
    for (a, b), value in entries.items():
        matrix[a, b] = matrix[b, a] = value
    return matrix


def holds(
    matches: Int64, explained: Int64, registered: Bool, monkeypatch: pytest.MonkeyPatch
) -> list[Misregistration]:
    """Of a scene of which nothing but that is known."""

    def mask(images: Int64) -> Bool:
        return np.isin(np.arange(len(matches)), images)

    monkeypatch.setattr(module, "count_pair_matches", lambda scene: (matches, explained))
    scene = SimpleNamespace(registered=registered, mask=mask)
    return detect_misregistrations(scene, 30)  # type: ignore[arg-type]


def test_a_pair_that_has_more_matches_than_hold_it_apart(monkeypatch: pytest.MonkeyPatch) -> None:
    """0, 1 and 2 stand together, 3 and 4 beside 2 by false matches; 3 belongs beside 0."""
    explained = symmetric(5, {(0, 1): 200, (1, 2): 200, (3, 4): 300, (2, 3): 40, (2, 4): 30})
    matches = explained + symmetric(5, {(0, 3): 150, (1, 4): 90})
    (hold,) = holds(matches, explained, np.ones(5, np.bool_), monkeypatch)
    assert hold.images == (3, 4)
    assert hold.margin == 150 - 70
    assert hold.supporting_pairs.tolist() == [[3, 2], [4, 2]]


def test_matches_that_are_fewer_than_what_holds_are_not_heard(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    explained = symmetric(4, {(0, 1): 200, (1, 2): 90, (0, 3): 80, (2, 3): 80})
    matches = explained + symmetric(4, {(0, 2): 160, (1, 3): 25})
    assert holds(matches, explained, np.ones(4, np.bool_), monkeypatch) == []


def test_an_image_that_two_want_beside_them_stands_against_both(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """4 could not be registered: 0 and 3 cannot both be where they are."""
    explained = symmetric(5, {(0, 1): 200, (1, 2): 200, (2, 3): 60})
    matches = explained + symmetric(5, {(0, 4): 100, (3, 4): 120})
    registered = np.array([True, True, True, True, False])
    (hold,) = holds(matches, explained, registered, monkeypatch)
    assert (hold.images, hold.margin) == ((3,), 40)


def test_an_image_that_all_its_pairs_together_outweigh(monkeypatch: pytest.MonkeyPatch) -> None:
    """6 stands beside 0 to 2 by false matches; no pair alone has more than these."""
    together = {(a, b): 200 for a in range(6) for b in range(a)}
    explained = symmetric(7, together | {(6, 0): 100, (6, 1): 100, (6, 2): 100})
    everything = np.ones(7, np.bool_)
    torn = {(6, 3): 170, (6, 4): 170, (6, 5): 170}
    (hold,) = holds(explained + symmetric(7, torn), explained, everything, monkeypatch)
    assert (hold.images, hold.margin) == ((6,), 510 - 300)
    assert hold.supporting_pairs.tolist() == [[6, 0], [6, 1], [6, 2]]

    torn = {(6, 3): 120, (6, 4): 120, (6, 5): 120}  # more, but not clearly
    assert holds(explained + symmetric(7, torn), explained, everything, monkeypatch) == []


def test_widest_ways_are_those_of_all_ways() -> None:
    rng = np.random.default_rng(0)
    for _ in range(20):
        upper = np.triu(rng.integers(0, 9, (7, 7)) * (rng.random((7, 7)) < 0.5), 1)
        widest = (upper + upper.T).astype(np.int64)
        found = compute_widest_paths(widest)
        for k, i, j in product(range(7), repeat=3):
            widest[i, j] = max(widest[i, j], min(widest[i, k], widest[k, j]))
        np.fill_diagonal(widest, 0)
        np.fill_diagonal(found, 0)
        np.testing.assert_array_equal(found, widest)


@pytest.fixture
def group() -> Component:
    """All of an exact scene is registered."""
    problem = make_mapping_problem(room_scene(), CAMERA, arc_poses(5, 14.0))
    mapper = Mapper(problem, MapperOptions(), NullMappingEvents())
    mapper.reconstruct_component()
    return mapper.component


def misplace(group: Component, image: int) -> None:
    """Turn a camera, with ten points left."""
    scene = group.scene
    turn = np.array([[0.8, 0.0, 0.6], [0.0, 1.0, 0.0], [-0.6, 0.0, 0.8]])
    scene.rotations[image] = turn @ scene.rotations[image]
    scene.translations[image] = turn @ scene.translations[image]
    keypoints = np.arange(*scene.graph.offsets[image : image + 2])
    seen = keypoints[scene.tracks.point_of[keypoints] >= 0]
    scene.tracks.remove_observations(seen[10:])


def test_an_image_comes_to_where_more_matches_tie_it(group: Component) -> None:
    assert detect_misregistrations(group.scene, 30) == []
    right = group.scene.rotations.copy()
    misplace(group, 4)
    assert [hold.images for hold in detect_misregistrations(group.scene, 30)] == [(4,)]
    group.reregister_images(np.ones(5, np.bool_))
    assert group.scene.registered.all()
    assert rotation_angle_deg(group.scene.rotations @ right.transpose(0, 2, 1)).max() < 0.1
    matches, explained = count_pair_matches(group.scene)
    assert explained[4].sum() > 0.8 * matches[4].sum()


def test_an_image_that_nothing_else_holds_stays(
    group: Component, monkeypatch: pytest.MonkeyPatch
) -> None:
    misplace(group, 4)
    before, noise = group.scene.snapshot(), group.refiner.noise
    monkeypatch.setattr(group, "grow", lambda available, *, wide: None)
    group.reregister_images(np.ones(5, np.bool_))
    after = group.scene.snapshot()
    np.testing.assert_array_equal(after.rotations, before.rotations)
    np.testing.assert_array_equal(after.point_of, before.point_of)
    assert after.registered.all()
    assert group.refiner.noise == noise


@pytest.mark.parametrize(("known", "moves"), [("start", False), ("guess", True)])
def test_images_that_came_with_a_pose_stay_unless_it_is_a_guess(known: str, moves: bool) -> None:
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
