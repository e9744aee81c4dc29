"""Tests of depth consistency: violations, explanations by depth errors, and twin rooms."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest

from mpsfm_core.data import (
    DepthPrior,
    Float32,
    Float64,
    MappingImage,
    MappingProblem,
    NormalPrior,
    PinholeCamera,
)
from mpsfm_core.mapping.consistency import depth_consistency
from mpsfm_core.mapping.consistency.depth_consistency import (
    DepthConsistencyCheck,
    find_overlapping_images,
)
from mpsfm_core.mapping.consistency.visibility import Views
from mpsfm_core.mapping.options import ConsistencyOptions, MapperOptions, TriangulationOptions
from mpsfm_core.mapping.refinement.refinement import Refiner
from mpsfm_core.mapping.scene.scene import Scene
from mpsfm_core.mapping.scene.tracks import Tracks
from mpsfm_core.mapping.triangulation import complete_and_merge_tracks
from mpsfm_core.testing.synthetic.halls import LOCALLY_BIASED_PRIORS, PriorErrors, make_hall_problem
from mpsfm_core.testing.synthetic.scenes import AnalyticScene, Box, look_at
from mpsfm_core.testing.synthetic.two_rooms import (
    CAMERA,
    make_twin_room_poses,
    make_twin_room_problem,
    make_twin_rooms,
    shift_pose,
)

OPTIONS = ConsistencyOptions()
SMALL = PinholeCamera(40, 30, 40.0, 40.0, 20.0, 15.0)


def posed_scene(
    maps: list[Float32], poses: list[Float64], camera: PinholeCamera, std: float = 0.01
) -> Scene:
    """Return a scene of registered images with given depth and no keypoints."""
    images = []
    for number, depth in enumerate(maps):
        normals = np.zeros((*depth.shape, 3), np.float32)
        normals[..., 2] = -1
        images.append(
            MappingImage(
                f"{number}.png",
                camera,
                np.zeros((0, 2)),
                DepthPrior.from_arrays(depth, (std * depth) ** 2),
                NormalPrior.from_arrays(normals, np.full(depth.shape, 0.01, np.float32)),
            )
        )
    scene = Scene(MappingProblem(tuple(images), ()))
    for number, pose in enumerate(poses):
        scene.register(number, pose[:, :3], pose[:, 3])
        scene.maps[number].set_scale(1.0)
    return scene


def test_near_images_are_compared_before_images_far_behind_walls() -> None:
    """An image at 0.5 m is compared first, although 16 images at 60 m see more pixels."""
    far = [np.column_stack([np.eye(3), [0.1 * k, 0, 60.0]]) for k in range(16)]
    poses = [np.eye(3, 4), *far, np.column_stack([np.eye(3), [0.5, 0, 0]])]
    scene = posed_scene([np.full((30, 40), 4.0, np.float32)] * len(poses), poses, SMALL)
    compared = find_overlapping_images(scene, 0)
    assert compared[0] == len(poses) - 1
    assert len(compared) == 16


def wall(depth: float) -> Float32:
    return np.full((30, 40), depth, np.float32)


HERE = np.eye(3, 4)


def between(scene: Scene, a: int, b: int, **settings: float) -> float:
    return DepthConsistencyCheck(scene, OPTIONS).measure_violation_ratio(a, b, **settings)


def test_surface_in_empty_space_is_violation_and_occluded_one_is_not() -> None:
    """A box that one image sees in front of the wall is a violation, the wall behind it is not."""
    near = wall(4.0)
    near[10:20, 10:25] = 2.0
    scene = posed_scene([near, wall(4.0)], [HERE, HERE], SMALL)
    box = 5 * 7 / (15 * 20)  # every second pixel in both directions
    assert between(scene, 0, 1) == pytest.approx(box)
    assert between(scene, 1, 0) == pytest.approx(box)
    check = DepthConsistencyCheck(scene, OPTIONS).check_image(0)
    assert check.other_image == 1
    assert check.ratio == pytest.approx(box)


def test_by_target_area_weights_violations_by_projected_area() -> None:
    """A surface that fills one image covers few pixels of an image ten meters behind."""
    behind = np.eye(3, 4)
    behind[2, 3] = 10.0
    scene = posed_scene([wall(1.0), wall(20.0)], [HERE, behind], SMALL)
    check = DepthConsistencyCheck(scene, OPTIONS)
    assert check.measure_violation_ratio(0, 1) == 1
    assert check.measure_violation_ratio(0, 1, by_target_area=True) == pytest.approx(1 / 11**2)
    assert not check.find_conflicting_images([0, 1], OPTIONS.max_violations)


def test_occluded_surface_is_no_violation() -> None:
    """The box in the first image hides what the second image sees next to it."""
    rooms = make_twin_rooms()
    poses, _ = make_twin_room_poses(0)
    grid = CAMERA.resized(160, 120)
    maps = [rooms.render(grid, pose).depth for pose in poses[:7]]
    scene = posed_scene(maps, poses[:7], CAMERA)
    assert max(DepthConsistencyCheck(scene, OPTIONS).check_image(i).ratio for i in range(7)) < 0.03


@pytest.mark.parametrize(("gap", "contradicts"), [(0.03, False), (0.10, True)])
def test_gap_below_min_gap_is_no_violation(gap: float, contradicts: bool) -> None:
    scene = posed_scene([wall(4.0), wall(4.0 * (1 - gap))], [HERE, HERE], SMALL, std=0.001)
    assert (between(scene, 0, 1) > 0.5) == contradicts


def test_large_depth_std_gives_no_violation() -> None:
    scene = posed_scene([wall(4.0), wall(3.0)], [HERE, HERE], SMALL, std=0.03)
    assert between(scene, 0, 1) > 0.5
    assert between(scene, 0, 1, std_factor=4.0) == 0


@pytest.mark.parametrize(("gap", "contradicts"), [(0.34, False), (0.40, True)])
def test_errors_of_both_images_explain_gap(gap: float, contradicts: bool) -> None:
    """A gap g on one ray has the likelihood exp(-g^2 / 4 s^2) / 2^.5 for std s in both images.

    It equals the likelihood of ``max_deviation`` at g = 3.63 s.
    """
    scene = posed_scene([wall(4.0), wall(4.0 * np.exp(-gap))], [HERE, HERE], SMALL, std=0.1)
    assert (between(scene, 0, 1) > 0.5) == contradicts


@pytest.mark.parametrize(("std", "contradicts"), [(0.06, False), (0.01, True)])
def test_depth_error_explains_lateral_shift_at_right_angle(std: float, contradicts: bool) -> None:
    """A pillar that is 12 % too far in one image is shifted sideways in the other."""
    hall = AnalyticScene((Box((0.0, 0.0, 1.5), (8.0, 8.0, 1.5)), Box((0.0, 0.0, 1.5), (1, 1, 1.5))))
    poses = [look_at((-5.0, 0.0, 1.5), (0, 0, 1.5)), look_at((0.0, -5.0, 1.5), (0, 0, 1.5))]
    grid = SMALL.resized(160, 120)
    maps = [hall.render(grid, pose).depth for pose in poses]
    maps[0] = np.where(maps[0] < 4.5, 1.12 * maps[0], maps[0])
    scene = posed_scene(maps, poses, SMALL, std)
    assert (between(scene, 0, 1) > OPTIONS.max_violations) == contradicts


def test_error_past_depth_edge_counts_by_its_likelihood() -> None:
    """Errors of 2.025 std that move pixels past a depth edge explain them; 2.7 std do not.

    The weight of an error of 2.7 std is 0.007, below the limit of 1 in 38.
    """
    aside = np.eye(3, 4)
    aside[0, 3] = 1.0
    near, far = np.full((2, 120, 160), [[[4.0]], [[40.0]]], np.float32)
    far[:, 120:] = 0  # unknown
    scene = posed_scene([near, far], [HERE, aside], SMALL.resized(160, 120), std=0.2)
    lands = np.arange(1, 160, 2) + 0.5 + 40 * np.exp(2.025 * 0.2)  # compared columns
    assert between(scene, 0, 1) == pytest.approx((lands < 120).mean())


def hall_at_truth(errors: PriorErrors) -> Scene:
    """Return the images of a hall at their true poses, with tracks and scaled priors."""
    problem, truth, _ = make_hall_problem(16, errors)
    scene = Scene(problem)
    for image, pose in enumerate(truth.values()):
        scene.register(image, *pose)
    complete_and_merge_tracks(scene, TriangulationOptions(), create=True)
    Refiner(scene, MapperOptions(), np.zeros((16, 16))).estimate_scales(list(range(16)))
    return scene


def worst(scene: Scene, *, weigh_evidence: bool) -> Float64:
    """Return (n,) the largest violation ratio of each image."""
    options = OPTIONS.model_copy(update={"weigh_evidence": weigh_evidence})
    check = DepthConsistencyCheck(scene, options)
    return np.array([check.check_image(i).ratio for i in range(scene.num_images)])


def test_prior_contradicted_by_points_gives_no_violation() -> None:
    """Priors with an error of 20 % in a tenth of their area contradict no correct pose."""
    scene = hall_at_truth(LOCALLY_BIASED_PRIORS)
    assert (worst(scene, weigh_evidence=False) > OPTIONS.max_violations).sum() >= 2
    assert (worst(scene, weigh_evidence=True) < OPTIONS.max_violations).all()


def test_misplaced_image_with_own_tracks_is_violation() -> None:
    """Images of one twin room are registered in the other, with the tracks that result there."""
    case = make_twin_room_problem(1, keypoint_noise_px=0.2)
    scene = Scene(case.problem)
    for image, pose in enumerate(case.poses):
        scene.register(image, pose[:, :3], pose[:, 3])
        scene.maps[image].set_scale(1.0)
    room = np.array(case.room)
    wrong = []
    for image in map(int, np.flatnonzero(room == 1)[::2]):
        # the view before its twin's surroundings, with the tracks that it finds there
        truth = scene.translations[image].copy()
        scene.translations[image] = shift_pose(case.poses[image], 1)[:, 3]
        scene.registered = (room != 1) | (np.arange(len(room)) == image)
        scene.tracks = Tracks(len(scene.keypoints))
        complete_and_merge_tracks(scene, TriangulationOptions(), create=True)
        if (scene.tracks.point_of[scene.graph.keypoints_of(image)] >= 0).sum() > 30:
            wrong.append(
                DepthConsistencyCheck(scene, OPTIONS).check_image(image).ratio
                > OPTIONS.max_violations
            )
        scene.translations[image] = truth
    assert len(wrong) >= 4, wrong
    assert np.mean(wrong) >= 0.75


def test_images_facing_away_do_not_overlap() -> None:
    back = np.column_stack([np.diag([-1.0, 1.0, -1.0]), np.zeros(3)])
    scene = posed_scene([wall(3.0)] * 3, [HERE, back, HERE], SMALL)
    assert find_overlapping_images(scene, 0) == [2]
    assert DepthConsistencyCheck(scene, OPTIONS).check_image(1).other_image == -1


def test_subsampled_map_is_aligned_with_full_map() -> None:
    """An image agrees with itself at full and at a third of the resolution."""
    rooms = make_twin_rooms()
    pose = make_twin_room_poses(0)[0][0]
    maps = [rooms.render(CAMERA.resized(480, 360), pose).depth] * 2
    scene = posed_scene(maps, [pose, pose], CAMERA)
    assert between(scene, 0, 1) == 0
    whole = OPTIONS.model_copy(update={"map_width": 480})
    assert DepthConsistencyCheck(scene, whole).measure_violation_ratio(0, 1) == 0


def test_image_in_twin_room_is_violation_and_in_own_room_is_not() -> None:
    """Most images of the second room contradict the first room, and none contradicts its own."""
    rooms = make_twin_rooms()
    poses, room = make_twin_room_poses(1)
    maps = [rooms.render(CAMERA.resized(160, 120), pose).depth for pose in poses]
    wrong = []
    for image in np.flatnonzero(np.array(room) == 1):
        scene = posed_scene(maps, poses, CAMERA)
        assert (
            DepthConsistencyCheck(scene, OPTIONS).check_image(int(image)).ratio
            < OPTIONS.max_violations
        )
        scene.translations[image] = shift_pose(poses[image], 1)[:, 3]
        scene.registered &= np.array(room) != 1
        wrong.append(
            DepthConsistencyCheck(scene, OPTIONS).check_image(int(image)).ratio
            > OPTIONS.max_violations
        )
    assert np.mean(wrong) >= 0.75


def test_quarter_of_pixels_decides_like_all_pixels() -> None:
    """The ratio is on the same side of the limit for images in their room and in its twin."""
    rooms = make_twin_rooms()
    poses, room = make_twin_room_poses(1)
    maps = [rooms.render(CAMERA.resized(160, 120), pose).depth for pose in poses]
    scene = posed_scene(maps, poses, CAMERA)
    for image in np.flatnonzero(np.array(room) == 1)[::2]:
        scene.translations[image] = shift_pose(poses[image], 1)[:, 3]
    check, limit = DepthConsistencyCheck(scene, OPTIONS), OPTIONS.max_violations
    pairs = list(combinations(range(len(poses)), 2))
    all_pixels = np.array([check.measure_violation_ratio(a, b) for a, b in pairs])
    quarter = np.array([check.measure_violation_ratio(a, b, limit=limit) for a, b in pairs])
    assert ((all_pixels > limit) == (quarter > limit)).all()
    assert 0.05 < (all_pixels > limit).mean() < 0.95
    assert (all_pixels != quarter).any()
    assert np.abs(all_pixels - quarter).max() < 0.1


def test_find_conflicting_images_removes_image_with_most_conflicts() -> None:
    scene = posed_scene([wall(4.0), wall(4.0), wall(2.0), wall(4.0)], [HERE] * 4, SMALL)
    images = scene.registered_images()
    removed = DepthConsistencyCheck(scene, OPTIONS).find_conflicting_images(
        images, OPTIONS.max_violations
    )
    assert [image for image, _ in removed] == [2]
    assert removed[0][1] == pytest.approx(1.0)


def test_images_surrounded_by_their_set_are_not_compared_again(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Two sets of images form one line; only images near the end of a set are compared."""
    count = 100  # per set
    poses = [np.column_stack([np.eye(3), [-0.5 * k, 0, 0]]) for k in range(2 * count)]
    maps = [wall(4.0)] * (2 * count)
    maps[count - 1] = wall(2.0)  # contradicts its neighbors in both sets
    scene = posed_scene(maps, poses, SMALL)
    images = scene.registered_images()
    sets = [images[:count], images[count:]]
    searched: list[int] = []

    def search(scene: Scene, image: int, views: Views) -> list[int]:
        searched.append(image)
        return find_overlapping_images(scene, image, views)

    monkeypatch.setattr(depth_consistency, "find_overlapping_images", search)
    check = DepthConsistencyCheck(scene, OPTIONS)
    removed = check.find_conflicting_images(images, OPTIONS.max_violations, compared=sets)
    assert [image for image, _ in removed] == [count - 1]
    assert min(searched) > count / 2
    assert max(searched) < 1.5 * count
