"""Tests that duplicates are registered in the poses of their originals."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from mpsfm_core.data import MappingProblem, PinholeCamera, VerifiedPair
from mpsfm_core.data.decisions import ImageReason
from mpsfm_core.geometry import compose, invert
from mpsfm_core.mapping.mapper import reconstruct
from mpsfm_core.mapping.options import MapperOptions
from mpsfm_core.mapping.registration.duplicate_registration import remove_duplicates
from mpsfm_core.testing.synthetic.problems import make_mapping_problem
from mpsfm_core.testing.synthetic.rigs import make_rig_problem
from mpsfm_core.testing.synthetic.scenes import arc_poses, look_at, room_scene

CAMERA = PinholeCamera(320, 240, 260.0, 260.0, 160.0, 120.0)
OPTIONS = MapperOptions()


def add_copy(problem: MappingProblem, original: int = 1) -> MappingProblem:
    """Append a copy of an image, which has matches with this image only."""
    image = problem.images[original]
    copy = replace(image, name="copy", duplicate_of=image.name)
    rows = np.arange(len(image.keypoints))
    pair = VerifiedPair(
        original,
        len(problem.images),
        np.stack([rows, rows], axis=1),
        np.ones(len(rows), np.float32),
        np.eye(3),
        np.zeros(3),
    )
    return MappingProblem((*problem.images, copy), (*problem.pairs, pair))


def test_reconstruct_registers_a_copy_in_the_pose_of_its_original() -> None:
    problem = make_mapping_problem(room_scene(), CAMERA, arc_poses(3, 14.0))
    result, expected = (reconstruct(p, OPTIONS) for p in (add_copy(problem), problem))
    model, reference = result.reconstructions[0], expected.reconstructions[0]
    assert [image.index for image in model.images] == [0, 1, 2, 3]
    assert not result.report.image_reasons
    original, copy = model.images[1], model.images[3]
    assert copy.name == "copy"
    np.testing.assert_array_equal(copy.point_ids, original.point_ids)
    for name, pose in reference.poses.items():
        np.testing.assert_allclose(model.poses[name][0], pose[0], atol=1e-6)
        np.testing.assert_allclose(model.poses[name][1], pose[1], atol=1e-6)
    np.testing.assert_array_equal(model.poses["copy"][1], model.poses[original.name][1])


def test_reconstruct_gives_the_copy_of_an_unregistered_image_the_same_reason() -> None:
    problem = make_mapping_problem(room_scene(), CAMERA, arc_poses(3, 14.0))
    linked = tuple(pair for pair in problem.pairs if 2 not in (pair.image_a, pair.image_b))
    alone = add_copy(MappingProblem(problem.images, linked), original=2)
    reasons = reconstruct(alone, OPTIONS).report.image_reasons
    assert {reason.code for reason in reasons.values()} == {ImageReason.NO_VERIFIED_MATCHES}
    assert set(reasons) == {problem.images[2].name, "copy"}


def test_reconstruct_registers_a_duplicate_with_the_frame_of_its_rig() -> None:
    poses = [look_at(np.array([x, -0.6, 1.4]), (x + 3.5, 0.0, 1.2)) for x in (-1.4, -0.9, -0.4)]
    truth = make_rig_problem(room_scene(), "stereo", poses, num_points=300)
    images = list(truth.problem.images)
    images[5] = replace(images[5], duplicate_of=images[1].name)
    result = reconstruct(replace(truth.problem, images=tuple(images)), OPTIONS)
    model = result.reconstructions[0]
    assert not result.report.image_reasons
    assert len(model.images) == len(images)
    left, right = (model.poses[image.name] for image in images[4:])
    rotation, translation = compose(right, invert(*left))
    known_rotation, known_translation = model.rigs[0].sensor_poses[1]
    np.testing.assert_allclose(rotation, known_rotation, atol=1e-6)
    np.testing.assert_allclose(translation, known_translation, atol=1e-6)


def test_remove_duplicates_keeps_copies_without_other_views_or_with_poses_of_the_user() -> None:
    problem = make_mapping_problem(room_scene(), CAMERA, arc_poses(2, 14.0))
    copies = add_copy(problem)
    assert len(remove_duplicates(copies, OPTIONS).pairs) == len(problem.pairs)
    one_view = replace(copies, pairs=copies.pairs[-1:])
    assert remove_duplicates(one_view, OPTIONS) is one_view
    posed = copies.with_poses({image.name: (np.eye(3), np.zeros(3)) for image in copies.images})
    assert remove_duplicates(posed, OPTIONS) is posed
    guess = OPTIONS.model_copy(update={"known_poses": "guess"})
    assert remove_duplicates(posed, guess).images[-1].known_pose is None
