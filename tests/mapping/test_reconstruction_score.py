"""Tests of the score by which reconstructions of the same images are compared."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mpsfm_core.data import MappingProblem
from mpsfm_core.mapping.mapper import reconstruct
from mpsfm_core.mapping.reconstruction_score import (
    FALSE_PAIR_RATIO,
    OCCAM_FACTOR,
    score_pair,
    score_reconstruction,
)
from mpsfm_core.mapping.scene.reconstruction import Reconstruction


@pytest.fixture(scope="module")
def model(problem: MappingProblem) -> Reconstruction:
    (model,) = reconstruct(problem).reconstructions
    return model


def rotate_last(model: Reconstruction, angle_deg: float) -> Reconstruction:
    """Rotate the last camera about its vertical axis, without a change of its position."""
    *rest, last = model.images
    turn = Rotation.from_euler("y", angle_deg, degrees=True).as_matrix()
    turned = replace(last, rotation=turn @ last.rotation, translation=turn @ last.translation)
    return replace(model, images=(*rest, turned))


def test_score_decreases_with_the_error_of_a_pose(
    problem: MappingProblem, model: Reconstruction
) -> None:
    scores = [
        score_reconstruction(rotate_last(model, angle), problem).total for angle in (0, 2, 8, 40)
    ]
    assert scores == sorted(scores, reverse=True)
    assert scores[0] > scores[1] + 1


def test_wrong_pose_scores_no_better_than_a_missing_image(
    problem: MappingProblem, model: Reconstruction
) -> None:
    missing = replace(model, images=model.images[:-1])
    right, without = (score_reconstruction(m, problem) for m in (model, missing))
    wrong = score_reconstruction(rotate_last(model, 90.0), problem)
    assert right.matches > without.matches >= wrong.matches
    assert right.depth > without.depth >= wrong.depth


def test_score_does_not_depend_on_the_unit_of_the_world(
    problem: MappingProblem, model: Reconstruction
) -> None:
    images = tuple(
        replace(
            image,
            translation=3 * image.translation,
            depth=replace(
                image.depth,
                depth=3 * image.depth.depth,
                variance=9 * np.asarray(image.depth.variance),
            ),
        )
        for image in model.images
    )
    scaled = score_reconstruction(replace(model, images=images), problem)
    assert scaled == pytest.approx(score_reconstruction(model, problem), rel=1e-5)


def test_score_of_a_pair_is_bounded_on_both_sides(
    problem: MappingProblem, model: Reconstruction
) -> None:
    pair = next(p for p in problem.pairs if 3 in (p.image_a, p.image_b))
    away = rotate_last(model, 180.0).images
    a, b = pair.image_a, pair.image_b
    right = score_pair(model.images[a], model.images[b], pair, problem)
    wrong = score_pair(away[a], away[b], pair, problem)
    assert 0 < right < OCCAM_FACTOR
    assert wrong == pytest.approx(np.log(FALSE_PAIR_RATIO))


def test_keypoints_without_depth_are_scored_by_their_epipolar_lines(
    problem: MappingProblem, model: Reconstruction
) -> None:
    images = tuple(
        replace(image, depth=replace(image.depth, valid=np.zeros(image.depth.shape, np.bool_)))
        for image in model.images
    )
    unknown = replace(model, images=images)
    score = score_reconstruction(unknown, problem)
    assert score.depth == 0
    assert score.matches > score_reconstruction(rotate_last(unknown, 20.0), problem).matches
