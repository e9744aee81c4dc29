"""Tests of keypoint adjustment by patch alignment."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mpsfm_core.data import (
    Features,
    MappingProblem,
    PinholeCamera,
    SparseMatches,
    VerifiedPair,
    View,
)
from mpsfm_core.extraction.matching.keypoint_adjustment import (
    MAX_SHIFT_STD,
    AlignedPair,
    PairSide,
    adjust_keypoints,
    align_pair,
    fronto_parallel_warp,
    select_best_matches,
    smooth_gray_image,
    solve_shifts,
    split_equations,
)
from mpsfm_core.extraction.options import AdjustmentOptions
from mpsfm_core.extraction.runner import adjust_problem, extend_matches, extract
from mpsfm_core.geometry import compose, invert, project, transform, unproject
from mpsfm_core.inputs.images import load_images
from mpsfm_core.inputs.matches import ImportedMatches
from mpsfm_core.providers import ProviderSpec
from mpsfm_core.providers.provider_config import ProviderConfig
from mpsfm_core.testing.synthetic.scenes import arc_poses, room_scene

CAMERA = PinholeCamera(320, 240, 280.0, 280.0, 160.0, 120.0)
OTHER = PinholeCamera(300, 200, 240.0, 250.0, 140.0, 110.0)


def relative(pose_a: np.ndarray, pose_b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return compose((pose_b[:, :3], pose_b[:, 3]), invert(pose_a[:, :3], pose_a[:, 3]))


def side(xy: np.ndarray, camera: PinholeCamera = CAMERA, std_px: float = 1.0) -> PairSide:
    return PairSide(camera, np.zeros((camera.height, camera.width), np.float32), xy, std_px)


def pair_of(matches: list[tuple[int, int]], images: tuple[int, int] = (0, 1)) -> VerifiedPair:
    rows = np.array(matches, dtype=np.int64)
    return VerifiedPair(*images, rows, np.ones(len(rows), np.float32), np.eye(3), np.zeros(3))


def says(offset: np.ndarray, rows: list[int] | None = None) -> AlignedPair:
    """Build alignments with identity warp and a standard deviation of 0.05 px."""
    count = len(offset)
    return AlignedPair(
        np.arange(count) if rows is None else np.array(rows),
        np.tile(np.eye(2), (count, 1, 1)),
        np.asarray(offset, dtype=np.float64),
        np.tile(400 * np.eye(2), (count, 1, 1)),
    )


def test_fronto_parallel_warp_equals_finite_differences() -> None:
    """The warp equals finite differences of the plane's projection."""
    rng = np.random.default_rng(0)
    xy, depth = rng.uniform(40, 200, (20, 2)), rng.uniform(1, 4, 20)
    rotation, translation = relative(*arc_poses(2, 25.0))

    def seen(xy: np.ndarray) -> np.ndarray:
        return project(OTHER, transform(rotation, translation, unproject(CAMERA, xy, depth)))

    step = 1e-4
    numeric = [(seen(xy + step * e) - seen(xy - step * e)) / (2 * step) for e in np.eye(2)]
    warp = fronto_parallel_warp(side(xy), side(seen(xy), OTHER), rotation, 7 * translation)
    assert np.abs(warp - np.stack(numeric, axis=2)).max() < 1e-6


def test_fronto_parallel_warp_without_parallax_is_rotation_homography() -> None:
    xy = np.array([[100.0, 90.0], [200.0, 30.0]])
    rotation, _ = relative(*arc_poses(2, 10.0))

    def seen(xy: np.ndarray, far: float) -> np.ndarray:
        return project(CAMERA, transform(rotation, np.zeros(3), unproject(CAMERA, xy, [far, far])))

    numeric = [(seen(xy + 1e-4 * e, 1.0) - seen(xy - 1e-4 * e, 1.0)) / 2e-4 for e in np.eye(2)]
    # With the second translation, points are behind a camera and use the plane at infinity.
    for translation in (np.zeros(3), np.array([0.0, 0.0, -1.0])):
        warp = fronto_parallel_warp(side(xy), side(seen(xy, 1.0)), rotation, translation)
        if not translation.any():
            assert np.abs(warp - np.stack(numeric, axis=2)).max() < 1e-6
        assert np.isfinite(warp).all()


def test_align_pair_is_symmetric_in_both_views() -> None:
    """The template comes from the image of higher resolution, in either order of the pair."""
    scene, poses = room_scene(), arc_poses(2, 10.0)
    views = [
        smooth_gray_image(scene.render(camera, pose).rgb, 1.0)
        for camera, pose in zip((CAMERA, OTHER), poses, strict=True)
    ]
    seeds = np.random.default_rng(0).uniform(40, 180, (100, 2))
    found = scene.correspondences(CAMERA, poses[0], OTHER, poses[1], seeds)
    xy = seeds[found.visible], found.xy_b[found.visible]
    a, b = PairSide(CAMERA, views[0], xy[0], 1.0), PairSide(OTHER, views[1], xy[1], 1.0)
    forth = align_pair(a, b, *relative(*poses))
    back = align_pair(b, a, *relative(*poses[::-1]))
    assert len(forth.rows) > 20 and np.array_equal(forth.rows, back.rows)
    left = forth.offset + np.einsum("mij,mj->mi", forth.warp, back.offset)
    assert np.median(np.linalg.norm(left, axis=1)) < 0.02
    assert np.median(np.abs(forth.warp @ back.warp - np.eye(2))) < 0.02
    # Information and offsets transform in the same way from pixels of b to pixels of a.
    turned = forth.warp.transpose(0, 2, 1) @ forth.information @ forth.warp
    ratio = np.linalg.det(turned) / np.linalg.det(back.information)
    assert 0.5 < np.median(ratio) < 2
    assert np.median(np.linalg.norm(forth.offset, axis=1)) < 0.1


def test_solve_shifts_equals_dense_least_squares() -> None:
    """For consistent alignments, the shifts equal a dense least-squares solution."""
    rng = np.random.default_rng(0)
    count, std = 12, np.ones(12)
    a, b = np.triu_indices(count, 1)
    warp = np.eye(2) + rng.normal(0, 0.1, (len(a), 2, 2))
    truth = rng.normal(0, 0.5, (count, 2))
    offset = truth[b] - np.einsum("mij,mj->mi", warp, truth[a])
    information = np.tile(np.diag([900.0, 100.0]), (len(a), 1, 1))
    found = solve_shifts(std, a, b, warp, offset, information)
    rows, right = [np.eye(2 * count)], [np.zeros(2 * count)]
    for i, (of_a, of_b) in enumerate(zip(a, b, strict=True)):
        block = np.zeros((2, 2 * count))
        block[:, 2 * of_b : 2 * of_b + 2] = np.eye(2)
        block[:, 2 * of_a : 2 * of_a + 2] = -warp[i]
        root = np.sqrt(information[i])
        rows.append(root @ block)
        right.append(root @ offset[i])
    expected = np.linalg.lstsq(np.vstack(rows), np.concatenate(right), rcond=None)[0]
    assert np.abs(found.ravel() - expected).max() < 1e-3
    assert np.abs(found - truth).max() < 0.05


def test_split_equations_solve_for_the_same_shifts() -> None:
    rng = np.random.default_rng(0)
    tracks = np.split(rng.permutation(600), np.cumsum(rng.integers(2, 8, 100))[:-1])
    tracks = [track for track in tracks if len(track) > 1]
    links = np.concatenate([np.column_stack([track[:-1], track[1:]]) for track in tracks])
    a, b = rng.permutation(np.sort(links, axis=1)).T
    warp = np.eye(2) + rng.normal(0, 0.1, (len(a), 2, 2))
    offset = rng.normal(0, 0.3, (len(a), 2))
    information = np.tile(np.diag([900.0, 100.0]), (len(a), 1, 1))

    def solve(rows: np.ndarray) -> np.ndarray:
        return solve_shifts(np.ones(600), a[rows], b[rows], *(x[rows] for x in equations))

    equations = warp, offset, information
    systems = split_equations(a, b, 600, max_equations=50)
    assert len(systems) > 5 and max(map(len, systems)) < 50 + max(map(len, tracks))
    assert np.array_equal(np.sort(np.concatenate(systems)), np.arange(len(a)))
    (whole,) = split_equations(a, b, 600, max_equations=len(a))
    assert np.allclose(sum(map(solve, systems)), solve(whole), atol=1e-12)


def test_adjust_keypoints_shares_offset_by_variance() -> None:
    keypoints = [np.array([[10.0, 10.0]]), np.array([[20.0, 20.0]])]
    pairs, found = [pair_of([(0, 0)])], [says(np.array([[0.6, -0.4]]))]
    a, b = adjust_keypoints(keypoints, [1.0, 1.0], pairs, found, 3.0)
    assert np.allclose(a.keypoints, [[9.7, 10.2]], atol=0.01)
    assert np.allclose(b.keypoints, [[20.3, 19.8]], atol=0.01)
    a, b = adjust_keypoints(keypoints, [0.1, 1.0], pairs, found, 9.0)  # smaller std of a
    assert np.abs(a.keypoints - keypoints[0]).max() < 0.02


def test_adjust_keypoints_ignores_outlier_alignment() -> None:
    keypoints = [np.full((1, 2), 50.0) for _ in range(4)]
    pairs = [pair_of([(0, 0)], (a, b)) for a in range(4) for b in range(a + 1, 4)]
    truth = np.array([[0.0, 0.0], [0.5, 0.2], [-0.4, 0.1], [-0.1, -0.3]])
    found = [says((truth[p.image_b] - truth[p.image_a])[None]) for p in pairs]
    found[-1] = says(np.array([[2.9, 0.0]]))
    adjusted = adjust_keypoints(keypoints, [1.0] * 4, pairs, found, 3.0)
    moved = np.concatenate([each.keypoints for each in adjusted]) - 50
    assert np.abs(moved - truth).max() < 0.06


def test_keypoints_without_alignment_are_unchanged() -> None:
    keypoints = [np.arange(6.0).reshape(3, 2), np.arange(4.0).reshape(2, 2)]
    pairs = [pair_of([(0, 0), (2, 1)])]
    adjusted = adjust_keypoints(keypoints, [1.0, 1.0], pairs, [says(np.ones((1, 2)), [1])], 3.0)
    assert [each.measured.tolist() for each in adjusted] == [[False, False, True], [False, True]]
    for before, after in zip(keypoints, adjusted, strict=True):
        assert np.array_equal(after.keypoints[~after.measured], before[~after.measured])
        assert (after.keypoints[after.measured] != before[after.measured]).all()


def test_keypoint_with_too_large_shift_is_unchanged() -> None:
    keypoints = [np.zeros((1, 2)), np.zeros((1, 2))]
    found = [says(np.array([[5.0, 0.0]]))]
    adjusted = adjust_keypoints(keypoints, [1.0, 1.0], [pair_of([(0, 0)])], found, 2.0)
    assert not any(each.measured.any() or each.keypoints.any() for each in adjusted)


def test_adjust_keypoints_without_pairs_changes_nothing() -> None:
    (adjusted,) = adjust_keypoints([np.ones((2, 2))], [1.0], [], [], 3.0)
    assert np.array_equal(adjusted.keypoints, np.ones((2, 2))) and not adjusted.measured.any()


def test_smooth_gray_image_of_coarse_keypoints_is_downscaled() -> None:
    rgb = np.random.default_rng(0).integers(0, 255, (100, 200, 3), dtype=np.uint8)
    assert smooth_gray_image(rgb, 0.5).shape == (100, 200)
    assert smooth_gray_image(rgb, 4.0).shape == (25, 50)
    assert smooth_gray_image(rgb, 1e6).shape == (1, 1)


OFF = AdjustmentOptions(enabled=False)
ROUNDED = {"features": ProviderConfig(use="rounded"), "adjustment": AdjustmentOptions()}


class RoundedFeatures:
    """Scene whose feature provider rounds ground-truth keypoints to whole pixels."""

    def __init__(self, world) -> None:
        self._world = world

    def extract(self, view: View) -> Features:
        xy, points = self._world.positions(view.name)
        return Features(np.floor(xy) + 0.5, points.astype(np.float32))


@pytest.fixture
def rounded(world):
    spec = ProviderSpec("features", "rounded", lambda options, context: RoundedFeatures(world))
    world.registry.add(spec)
    return world


def miss(world, problem: MappingProblem, measured: bool) -> float:
    """Median distance in pixels of matches from where the scene has them, of matches whose
    keypoints were measured, or of all."""
    off = []
    for pair in problem.pairs:
        a, b = problem.images[pair.image_a], problem.images[pair.image_b]
        xy_a, xy_b = a.keypoints[pair.matches[:, 0]], b.keypoints[pair.matches[:, 1]]
        poses = world.poses[a.name], world.poses[b.name]
        truth = world.scene.correspondences(a.camera, poses[0], b.camera, poses[1], xy_a)
        keep = truth.visible
        if measured:
            keep = keep & (a.keypoint_std_factor[pair.matches[:, 0]] < 1)
            keep &= b.keypoint_std_factor[pair.matches[:, 1]] < 1
        off.append(np.linalg.norm(xy_b - truth.xy_b, axis=1)[keep])
    return float(np.median(np.concatenate(off)))


def test_adjustment_of_rounded_keypoints_is_subpixel_accurate(rounded) -> None:
    off = rounded.extract(**{**ROUNDED, "adjustment": OFF}).problem
    on = rounded.extract(**ROUNDED).problem
    assert all(image.keypoint_std_factor.min() == 1 for image in off.images)
    assert miss(rounded, off, measured=False) > 0.4
    assert miss(rounded, on, measured=True) < 0.2
    share = np.mean([(image.keypoint_std_factor < 1).mean() for image in on.images])
    assert share > 0.3
    moved = [
        np.linalg.norm(a.keypoints - b.keypoints, axis=1).max()
        for a, b in zip(on.images, off.images, strict=True)
    ]
    assert max(moved) <= MAX_SHIFT_STD
    images = load_images(rounded.root / "images", rounded.root / "intrinsics.yaml")
    later = adjust_problem(images, rounded.config(**ROUNDED), rounded.registry, off)
    for a, b in zip(later.images, on.images, strict=True):
        assert np.array_equal(a.keypoints, b.keypoints)


def test_adjustment_does_not_depend_on_order_of_pairs(rounded) -> None:
    off = rounded.extract(**{**ROUNDED, "adjustment": OFF}).problem
    images = load_images(rounded.root / "images", rounded.root / "intrinsics.yaml")
    config = rounded.config(**ROUNDED)
    forth = adjust_problem(images, config, rounded.registry, off)
    back = adjust_problem(images, config, rounded.registry, replace(off, pairs=off.pairs[::-1]))
    for a, b in zip(forth.images, back.images, strict=True):
        assert np.abs(a.keypoints - b.keypoints).max() < 1e-6


def test_imported_keypoints_are_not_adjusted(rounded) -> None:
    found = rounded.extract(**{**ROUNDED, "adjustment": OFF}).problem
    images = load_images(rounded.root / "images", rounded.root / "intrinsics.yaml")
    imported = ImportedMatches(
        "another program",
        tuple(image.keypoints for image in found.images),
        (1.0,) * len(found.images),
        {(p.image_a, p.image_b): SparseMatches(p.matches, p.scores) for p in found.pairs},
    )
    config = rounded.config(**ROUNDED)
    problem = extract(images, config, rounded.registry, imported=imported).problem
    for image, as_found in zip(problem.images, found.images, strict=True):
        assert np.array_equal(image.keypoints, as_found.keypoints)
        assert (image.keypoint_std_factor == 1).all()


def test_extend_matches_keeps_adjusted_keypoints(rounded) -> None:
    """Only keypoints of the second pass are adjusted; the first keypoints are unchanged."""
    images = load_images(rounded.root / "images", rounded.root / "intrinsics.yaml")
    config = rounded.config(**ROUNDED)
    first = extract(images, config, rounded.registry)
    both = extend_matches(images, config, rounded.registry, first, {3}).problem
    for before, after in zip(first.problem.images, both.images, strict=True):
        count = len(before.keypoints)
        assert np.array_equal(after.keypoints[:count], before.keypoints)
        assert np.array_equal(after.keypoint_std_factor[:count], before.keypoint_std_factor)
        assert (after.keypoint_std_factor[count:] < 1).any()


def test_select_best_matches_drops_matches_that_are_not_best() -> None:
    """In a star of matches, the best of the center and the only match of each end remain."""
    pairs = [
        replace(pair_of([(0, 0)], (0, other)), scores=np.array([score], np.float32))
        for other, score in ((1, 0.9), (2, 0.5), (3, 0.7))
    ]
    pairs.append(replace(pair_of([(0, 0)], (2, 3)), scores=np.array([0.6], np.float32)))
    kept = select_best_matches(pairs, [1] * 4, 1)
    assert [(p.image_a, p.image_b) for p in kept] == [(0, 1), (0, 3), (2, 3)]
    assert len(select_best_matches(pairs, [1] * 4, 3)) == len(pairs)
    assert select_best_matches([], [], 1) == []
