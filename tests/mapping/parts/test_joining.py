"""Tests of the alignment and joining of reconstructions with common images."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mpsfm_core.data import MappingProblem, Pose
from mpsfm_core.geometry import camera_center, rotation_angle_deg
from mpsfm_core.geometry.similarity import SimilarityTransform
from mpsfm_core.mapping import mapper
from mpsfm_core.mapping.options import MapperOptions
from mpsfm_core.mapping.parts.alignment import align_reconstructions
from mpsfm_core.mapping.parts.joining import join_reconstructions, merge_reconstructions
from mpsfm_core.mapping.scene.reconstruction import Reconstruction, transform_reconstruction
from mpsfm_core.testing.synthetic.halls import HallProblem, make_hall_problem
from mpsfm_core.testing.synthetic.two_rooms import make_twin_room_problem, shift_pose

OPTIONS = MapperOptions()
MOTION = SimilarityTransform(
    2.5, Rotation.from_rotvec([0.3, -1.0, 0.4]).as_matrix(), np.array([5.0, -2.0, 9.0])
)


def map_at_poses(problem: MappingProblem, poses: dict[int, Pose]) -> Reconstruction:
    """Map some images at given poses, with image indices of the whole problem."""
    names = [problem.images[i].name for i in sorted(poses)]
    part = problem.subset(names).with_poses({problem.images[i].name: p for i, p in poses.items()})
    (model,) = mapper.reconstruct(part, MapperOptions(known_poses="fixed")).reconstructions
    images = tuple(replace(i, index=sorted(poses)[i.index]) for i in model.images)
    return replace(model, images=images)


def move(model: Reconstruction, motion: SimilarityTransform = MOTION) -> Reconstruction:
    return transform_reconstruction(
        model, motion.scale, motion.rotation, motion.translation, model.metric
    )


@pytest.fixture(scope="module")
def hall() -> HallProblem:
    return make_hall_problem(24, map_width=80)


@pytest.fixture(scope="module")
def halves(hall: HallProblem) -> tuple[Reconstruction, Reconstruction]:
    """Return the reconstructions of two overlapping halves at the true poses."""
    poses = list(hall.truth.values())
    first = map_at_poses(hall.problem, {i: poses[i] for i in range(14)})
    second = map_at_poses(hall.problem, {i: poses[i] for i in range(10, 24)})
    return first, second


def test_alignment_is_the_true_similarity(
    halves: tuple[Reconstruction, Reconstruction],
) -> None:
    first, second = halves
    alignment = align_reconstructions(move(first), second)
    assert alignment is not None
    found = alignment.a_from_b
    assert found.scale == pytest.approx(MOTION.scale, rel=0.01)
    assert rotation_angle_deg(found.rotation @ MOTION.rotation.T) < 0.2
    assert alignment.num_images == alignment.num_common_images == 4
    assert align_reconstructions(first, replace(second, images=second.images[4:])) is None


def test_alignment_ignores_a_common_image_with_a_wrong_pose(
    halves: tuple[Reconstruction, Reconstruction],
) -> None:
    first, second = halves
    wrong = replace(second.images[0], translation=second.images[0].translation + 3.0, scale=4.0)
    alignment = align_reconstructions(first, replace(second, images=(wrong, *second.images[1:])))
    assert alignment is not None
    assert alignment.a_from_b.scale == pytest.approx(1.0, rel=0.01)


def test_merged_reconstruction_has_all_images_and_common_points_once(
    hall: HallProblem, halves: tuple[Reconstruction, Reconstruction]
) -> None:
    first, second = halves
    (joined,) = join_reconstructions(hall.problem, [move(first), second], OPTIONS)
    assert [image.index for image in joined.images] == list(range(24))
    assert len(joined.points) < len(first.points) + len(second.points)
    for image in joined.images:
        observed = image.point_ids[image.point_ids >= 0]
        assert len(np.unique(observed)) == len(observed) and observed.max() < len(joined.points)
    truth = np.array([camera_center(*pose) for pose in hall.truth.values()])
    centers = np.array([camera_center(i.rotation, i.translation) for i in joined.images])
    assert np.abs(centers - MOTION.apply(truth)).max() < 0.05 * MOTION.scale


def test_part_that_closes_a_loop_is_joined_despite_drift(hall: HallProblem) -> None:
    """The last part agrees with each of two joined parts, but not with both at once."""
    poses = list(hall.truth.values())

    def map_images(first: int, end: int) -> Reconstruction:
        return map_at_poses(hall.problem, {i: poses[i] for i in range(first, end)})

    drift = SimilarityTransform(1.0, np.eye(3), np.array([1.0, 0.0, 0.0]))
    last = merge_reconstructions(map_images(19, 24), move(map_images(0, 4), drift))
    parts = [map_images(0, 14), map_images(10, 23), last]
    alignment = align_reconstructions(merge_reconstructions(*parts[:2]), last)
    assert alignment is not None and not alignment.is_supported
    (joined,) = join_reconstructions(hall.problem, parts, OPTIONS)
    assert [image.index for image in joined.images] == list(range(24))


def test_merging_a_reconstruction_with_itself_changes_nothing(
    halves: tuple[Reconstruction, Reconstruction],
) -> None:
    merged = merge_reconstructions(halves[0], halves[0])
    assert np.array_equal(merged.points, halves[0].points)
    for image, original in zip(merged.images, halves[0].images, strict=True):
        assert np.array_equal(image.point_ids, original.point_ids)


@pytest.mark.parametrize("seed", [0, 1])
def test_look_alike_rooms_are_not_joined_and_the_same_room_is(seed: int) -> None:
    case = make_twin_room_problem(seed)
    rooms = np.array(case.room)
    poses: list[Pose] = [(pose[:, :3], pose[:, 3]) for pose in case.poses]
    first = {int(i): poses[i] for i in np.flatnonzero(rooms <= 0)}
    second = {int(i): poses[i] for i in np.flatnonzero(rooms != 0)}
    models = [map_at_poses(case.problem, part) for part in (first, second)]
    assert len(join_reconstructions(case.problem, models, OPTIONS)) == 1
    # three images of the second room in the first room, where the same furniture stands
    only_first = {int(i): poses[i] for i in np.flatnonzero(rooms == 0)}
    only_second = {int(i): poses[i] for i in np.flatnonzero(rooms == 1)}
    shifted = {i: shift_pose(case.poses[i], 1) for i in list(only_second)[:3]}
    false = {i: (pose[:, :3], pose[:, 3]) for i, pose in shifted.items()}
    models = [map_at_poses(case.problem, part) for part in (only_first | false, only_second)]
    assert len(join_reconstructions(case.problem, models, OPTIONS)) == 2
