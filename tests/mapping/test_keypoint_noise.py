"""Tests of keypoint noise, measured from the epipolar errors of matches."""

from __future__ import annotations

import numpy as np
import pytest

from mpsfm_core.mapping.refinement.keypoint_noise import (
    EFFICIENT_SCALE,
    MAX_RESIDUAL,
    compute_epipolar_residuals,
    measure_loss_scale,
)
from mpsfm_core.mapping.scene.scene import Scene
from mpsfm_core.testing.synthetic.halls import make_hall_problem

SCALE = 0.65


def scene_of(noise_px: float, *, tails: bool = False, wrong: float = 0.0) -> Scene:
    """Return nine views of a hall at true poses; ``tails`` increases the noise of every fourth
    keypoint."""
    hall = make_hall_problem(9, keypoint_noise_px=noise_px, wrong_matches=wrong, seed=1)
    scene = Scene(hall.problem)
    for number, image in enumerate(hall.problem.images):
        scene.register(number, *hall.truth[image.name])
    if tails:
        rng = np.random.default_rng(0)
        far = rng.uniform(size=len(scene.keypoints)) < 0.25
        scene.keypoints[far] += 8 * noise_px * rng.normal(size=(far.sum(), 2))
    return scene


def test_epipolar_errors_have_the_std_of_the_keypoints() -> None:
    residuals = compute_epipolar_residuals(scene_of(0.7))
    assert np.sqrt((residuals**2).mean()) == pytest.approx(1.0, rel=0.05)
    assert (residuals < MAX_RESIDUAL).all()


@pytest.mark.parametrize("wrong", [0.0, 0.05])
def test_keypoints_without_outliers_get_loss_near_least_squares(wrong: float) -> None:
    scale = measure_loss_scale(scene_of(0.7, wrong=wrong), SCALE)
    assert scale == pytest.approx(EFFICIENT_SCALE, rel=0.1)


def test_keypoints_with_heavy_tails_keep_the_loss_scale() -> None:
    scene = scene_of(0.7, tails=True)
    # most keypoints are more accurate than declared, as learned keypoints are
    scene.keypoint_std_px *= 2
    assert measure_loss_scale(scene, SCALE) == SCALE


def test_few_matches_keep_the_loss_scale() -> None:
    scene = scene_of(0.7)
    scene.registered[1:] = False
    assert measure_loss_scale(scene, SCALE) == SCALE
