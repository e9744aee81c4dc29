"""Tests of tentative registration of images that cannot be verified."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mpsfm_core.data import Float64, MappingProblem, PinholeCamera
from mpsfm_core.geometry import compose, invert, rotation_angle_deg
from mpsfm_core.mapping.mapper import reconstruct
from mpsfm_core.mapping.options import MapperOptions
from mpsfm_core.mapping.scene.reconstruction import RegisteredImage
from mpsfm_core.testing.synthetic.problems import make_mapping_problem
from mpsfm_core.testing.synthetic.scenes import arc_poses, room_scene

CAMERA = PinholeCamera(640, 480, 520.0, 520.0, 320.0, 240.0)
POSES = arc_poses(6, 14.0)
LINKS = [(2, 3), (3, 4), (2, 4), (1, 2), (0, 1)]
COMPLETE = MapperOptions(register_tentatively=True)


def with_few_matches(problem: MappingProblem, weak: tuple[int, int]) -> MappingProblem:
    """Return the problem with at most eight matches of one pair."""
    pairs = tuple(
        replace(pair, matches=pair.matches[:8], scores=pair.scores[:8])
        if (pair.image_a, pair.image_b) == weak
        else pair
        for pair in problem.pairs
    )
    return replace(problem, pairs=pairs)


@pytest.fixture(scope="module", params=[True, False], ids=["metric", "up to scale"])
def problem(request: pytest.FixtureRequest) -> MappingProblem:
    """Three connected images, two connected to them by eight matches, and one without matches."""
    whole = with_few_matches(make_mapping_problem(room_scene(), CAMERA, POSES, links=LINKS), (1, 2))
    images = tuple(
        replace(image, depth=replace(image.depth, metric=request.param)) for image in whole.images
    )
    return replace(whole, images=images)


def rotation_errors_deg(images: list[RegisteredImage]) -> Float64:
    """Return the rotation errors relative to the third image."""
    truth = np.array([POSES[image.index][:, :3] @ POSES[2][:, :3].T for image in images])
    (third,) = (image for image in images if image.index == 2)
    found = np.array([image.rotation @ third.rotation.T for image in images])
    return rotation_angle_deg(found @ truth.transpose(0, 2, 1))


def test_image_with_few_matches_and_its_component_are_registered(problem: MappingProblem) -> None:
    plain, complete = reconstruct(problem), reconstruct(problem, COMPLETE)
    assert [len(model.images) for model in plain.reconstructions] == [3, 2]
    best, other = complete.reconstructions
    assert [image.index for image in other.images] == [0, 1], "the smaller component stays"
    assert {image.index: image.confirmed for image in best.images} == {
        **dict.fromkeys([0, 1], False),
        **dict.fromkeys([2, 3, 4], True),
    }
    assert rotation_errors_deg(list(best.images)).max() < 1.0
    assert list(complete.report.image_reasons) == ["view_5.png"], "has no matches"


def test_component_keeps_its_relative_poses_and_scales(problem: MappingProblem) -> None:
    best, group = reconstruct(problem, COMPLETE).reconstructions
    placed = [image for image in best.images if not image.confirmed]
    (turn, step), (own_turn, own_step) = (
        compose((b.rotation, b.translation), invert(a.rotation, a.translation))
        for a, b in (placed, group.images)
    )
    ratio = placed[0].scale / group.images[0].scale
    np.testing.assert_allclose(turn, own_turn, atol=1e-12)
    np.testing.assert_allclose(step, ratio * own_step, atol=1e-12)
    assert placed[1].scale == pytest.approx(ratio * group.images[1].scale)


def test_confirmed_images_and_points_stay_unchanged(problem: MappingProblem) -> None:
    (plain, _), (complete, _) = (
        reconstruct(problem, options).reconstructions for options in (MapperOptions(), COMPLETE)
    )
    assert plain.points.tobytes() == complete.points.tobytes()
    for before, after in zip(plain.images, complete.confirmed_images, strict=True):
        assert before.rotation.tobytes() == after.rotation.tobytes()
        assert before.translation.tobytes() == after.translation.tobytes()
        assert before.point_ids.tolist() == after.point_ids.tolist()
    guessed = [image for image in complete.images if not image.confirmed]
    assert all((image.point_ids == -1).all() for image in guessed)


def test_scales_of_tentative_images_agree_with_confirmed_ones(problem: MappingProblem) -> None:
    best = reconstruct(problem, COMPLETE).reconstructions[0]
    scales = np.array([image.scale for image in best.images])
    assert np.allclose(scales, np.median(scales), rtol=0.03)


def test_complete_reconstruction_stays_unchanged() -> None:
    problem = make_mapping_problem(room_scene(), CAMERA, POSES[:3])
    best = reconstruct(problem, COMPLETE).reconstructions[0]
    assert len(best.images) == 3
    assert best.confirmed_images == best.images
