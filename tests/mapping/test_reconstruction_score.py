"""Tests of the score by which reconstructions of the same images are compared."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mpsfm_core.data import MappingProblem
from mpsfm_core.geometry.distortion import distort_rays
from mpsfm_core.mapping.mapper import reconstruct
from mpsfm_core.mapping.reconstruction_score import (
    FALSE_PAIR_RATIO,
    OCCAM_FACTOR,
    score_pairs,
    score_reconstruction,
)
from mpsfm_core.mapping.scene.reconstruction import Reconstruction
from mpsfm_core.mapping.scene.scene import Scene


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
    scene = Scene(problem)
    scores = [
        score_reconstruction(rotate_last(model, angle), scene).total for angle in (0, 2, 8, 40)
    ]
    assert score_reconstruction(model, scene).total == scores[0]
    assert not scene.registered.any()
    assert scores == sorted(scores, reverse=True)
    assert scores[0] > scores[1] + 1


def test_wrong_pose_scores_no_better_than_a_missing_image(
    problem: MappingProblem, model: Reconstruction
) -> None:
    missing = replace(model, images=model.images[:-1])
    right, without = (score_reconstruction(m, Scene(problem)) for m in (model, missing))
    wrong = score_reconstruction(rotate_last(model, 90.0), Scene(problem))
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
    scaled = score_reconstruction(replace(model, images=images), Scene(problem))
    assert scaled == pytest.approx(score_reconstruction(model, Scene(problem)), rel=1e-5)


def test_score_of_a_pair_is_bounded_on_both_sides(
    problem: MappingProblem, model: Reconstruction
) -> None:
    scores = []
    for reconstruction in (model, rotate_last(model, 180.0)):
        scene = Scene(problem)
        scene.resume(reconstruction)
        a, b, score = score_pairs(scene)
        of_last = (a == 3) | (b == 3)
        assert of_last.any()
        assert not of_last.all()
        scores.append(score[of_last])
    right, wrong = scores
    assert ((right > 0) & (right < OCCAM_FACTOR)).all()
    np.testing.assert_allclose(wrong, np.log(FALSE_PAIR_RATIO))


def test_keypoints_without_depth_are_scored_by_their_epipolar_lines(
    problem: MappingProblem, model: Reconstruction
) -> None:
    images = tuple(
        replace(image, depth=replace(image.depth, valid=np.zeros(image.depth.shape, np.bool_)))
        for image in problem.images
    )
    unknown = replace(problem, images=images)
    score = score_reconstruction(model, Scene(unknown))
    assert score.depth == 0
    assert score.matches > score_reconstruction(rotate_last(model, 20.0), Scene(unknown)).matches


def test_keypoints_are_scored_without_the_estimated_distortion(
    problem: MappingProblem, model: Reconstruction
) -> None:
    distortion = np.array([-0.1, 0.0, 0.0, 0.0])
    images = []
    for image in problem.images:
        center = np.array([image.camera.cx, image.camera.cy])
        focal_px = np.array([image.camera.fx, image.camera.fy])
        rays = (image.keypoints - center) / focal_px
        keypoints = center + focal_px * distort_rays(rays, distortion.tolist(), fisheye=False)
        images.append(replace(image, keypoints=keypoints))
    distorted = replace(problem, images=tuple(images))
    estimated = replace(
        model, images=tuple(replace(image, distortion=distortion) for image in model.images)
    )
    score, ignored, original = (
        score_reconstruction(reconstruction, Scene(given)).matches
        for reconstruction, given in ((estimated, distorted), (model, distorted), (model, problem))
    )
    # depth at distorted keypoints differs a little from depth at the original keypoints
    assert abs(score - original) < (original - ignored) / 2
