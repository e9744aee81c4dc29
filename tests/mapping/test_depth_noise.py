"""Tests of depth noise, measured from the disagreement of the views of a scene."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np
import pytest

from mpsfm_core.data import DepthPrior, Float64, MappingProblem, PinholeCamera
from mpsfm_core.mapping.options import TriangulationOptions
from mpsfm_core.mapping.refinement import depth_noise
from mpsfm_core.mapping.refinement.depth_noise import (
    DepthNoise,
    find_well_constrained_keypoints,
    measure_depth_noise,
    measure_local_depth_noise,
    measure_outlier_ratio,
)
from mpsfm_core.mapping.scene.scene import Scene
from mpsfm_core.mapping.triangulation import complete_and_merge_tracks
from mpsfm_core.testing.synthetic.problems import make_mapping_problem
from mpsfm_core.testing.synthetic.scenes import arc_poses, room_scene

CAMERA = PinholeCamera(320, 240, 260.0, 260.0, 160.0, 120.0)
POSES = arc_poses(3, 14.0)
DECLARED = 0.01
Errors = Callable[[np.random.Generator, tuple[int, int]], Float64]


def measured(errors: Errors, scales: tuple[float, ...] = (1.0, 1.0, 1.0)) -> DepthNoise:
    """Measure depth noise with true poses, priors with relative errors, and images with wrong
    scales."""
    return measure_depth_noise(scene_with(errors, scales))


def scene_with(errors: Errors, scales: tuple[float, ...] = (1.0, 1.0, 1.0)) -> Scene:
    """Create a scene with true poses and tracks, priors with relative errors, and wrong scales."""
    problem = make_mapping_problem(
        room_scene(), CAMERA, POSES, points_per_view=400, declared_depth_std=DECLARED
    )
    images = []
    for number, image in enumerate(problem.images):
        prior = image.depth
        error = errors(np.random.default_rng(number), prior.depth.shape)
        depth = prior.depth * np.exp(error).astype(np.float32)
        images.append(
            replace(image, depth=DepthPrior.from_arrays(depth, prior.variance, prior.valid))
        )
    scene = Scene(MappingProblem(tuple(images), problem.pairs))
    for image, (pose, scale) in enumerate(zip(POSES, scales, strict=True)):
        scene.register(image, pose[:, :3], pose[:, 3])
        scene.maps[image].set_scale(scale)
    complete_and_merge_tracks(scene, TriangulationOptions(), create=True)
    return scene


def independent(rng: np.random.Generator, shape: tuple[int, int]) -> Float64:
    """Return independent errors of each pixel with twice the declared std."""
    return 2 * DECLARED * rng.normal(size=shape)


def smooth(rng: np.random.Generator, shape: tuple[int, int]) -> Float64:
    """Return errors with twice the declared std, correlated over an eighth of the map's width."""
    noise = cv2.GaussianBlur(rng.normal(size=shape), (0, 0), shape[1] / 8)
    return np.asarray(2 * DECLARED * noise / noise.std())


def test_small_blocks_of_matches_give_equal_noise(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = scene_with(independent)
    whole = measure_depth_noise(scene)
    monkeypatch.setattr(depth_noise, "BLOCK_MATCHES", 100)
    assert len(scene.graph.source) > 500
    assert measure_depth_noise(scene) == whole


def test_independent_errors_are_measured_with_size_and_low_correlation() -> None:
    noise = measured(independent)
    # depth is interpolated between pixels, which averages their errors
    assert 1.2 < noise.multiplier < 2.2
    assert noise.correlation < 0.1
    assert noise.design_effect < 2


def test_smooth_errors_are_measured_with_size_and_high_correlation() -> None:
    noise = measured(smooth)
    assert noise.multiplier == pytest.approx(2.0, rel=0.35)
    assert noise.correlation > 0.5
    assert noise.design_effect > 5


def test_few_independent_errors_give_larger_noise() -> None:
    """Two views have one pair to estimate one pose, but three views have three pairs for two
    poses."""

    def ratio(errors: Errors) -> float:
        scene = scene_with(errors)
        three = measure_depth_noise(scene).multiplier
        scene.deregister(2)
        return measure_depth_noise(scene).multiplier / three

    assert ratio(lambda rng, shape: smooth(rng, shape) / 20) > 1.3
    assert ratio(independent) == pytest.approx(1.0, rel=0.05)


def test_wrong_scales_are_no_noise() -> None:
    right, wrong = measured(independent), measured(independent, (1.0, 1.05, 0.96))
    assert wrong.multiplier == pytest.approx(right.multiplier, rel=0.15)
    assert wrong.correlation < 0.15


def test_too_few_common_points_keep_the_declared_std() -> None:
    problem = make_mapping_problem(room_scene(), CAMERA, POSES)
    assert measure_depth_noise(Scene(problem)) == DepthNoise()


def test_outlier_ratio_is_the_share_of_wrong_depth() -> None:
    def wrong_by_half(rng: np.random.Generator, shape: tuple[int, int]) -> Float64:
        """Return log-depth errors of the declared std, plus log(1.5) in the upper fifth."""
        errors = DECLARED * rng.normal(size=shape)
        errors[: shape[0] // 5] += np.log(1.5)
        return errors

    scene = scene_with(wrong_by_half)
    keypoints = scene.tracks.observations()
    is_upper = scene.keypoints[keypoints, 1] < CAMERA.height / 5
    assert 0.1 < is_upper.mean() < 0.3
    assert measure_outlier_ratio(scene, 1.0, 2.7) == pytest.approx(is_upper.mean(), abs=0.05)
    declared = scene_with(lambda rng, shape: DECLARED * rng.normal(size=shape))
    assert measure_outlier_ratio(declared, 1.0, 2.7) < 0.02


def test_outlier_ratio_needs_points_of_three_images() -> None:
    scene = scene_with(lambda rng, shape: np.full(shape, 0.5))
    assert measure_outlier_ratio(scene, 1.0, 2.7) == 1
    scene.deregister(2)
    assert measure_outlier_ratio(scene, 1.0, 2.7) == 0


@pytest.mark.parametrize("views", [2, 3])
def test_local_noise_is_large_at_wrong_depth(views: int) -> None:
    """The prior is 20 % too far in one spot, and its declared std is right everywhere else."""

    def spot(_: np.random.Generator, shape: tuple[int, int]) -> Float64:
        y, x = np.mgrid[: shape[0], : shape[1]] / shape[1]
        return np.where(np.hypot(x - 0.45, y - 0.4) < 0.15, 0.2, 0.0)

    scene = scene_with(spot)
    if views == 2:
        scene.deregister(2)
    noise = measure_local_depth_noise(scene, 1, find_well_constrained_keypoints(scene, 1), 1.0)
    assert noise.shape == scene.maps[1].valid.shape
    columns = noise.shape[1]
    middle = noise[round(0.4 * columns), round(0.45 * columns)]
    declared = DECLARED / np.exp(0.2)  # relative to the depth that is 20 % too far
    assert middle == pytest.approx(0.2 / declared / np.sqrt(2), rel=0.1)
    assert np.median(noise) == 1.0
    no_points = np.zeros(len(scene.maps[1].keypoints), np.bool_)
    assert (measure_local_depth_noise(scene, 1, no_points, 1.5) == 1.5).all()
