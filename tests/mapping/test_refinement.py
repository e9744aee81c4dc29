"""Tests of depth scales in bundle adjustment, and of rough bundle adjustment."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mpsfm_core.data import Float64, PinholeCamera
from mpsfm_core.mapping.component import Component
from mpsfm_core.mapping.events import NullMappingEvents
from mpsfm_core.mapping.mapper import Mapper
from mpsfm_core.mapping.options import MapperOptions
from mpsfm_core.mapping.refinement.depth_noise import DepthNoise
from mpsfm_core.mapping.scene.depth_map import DepthRefinement
from mpsfm_core.testing.synthetic.problems import make_mapping_problem
from mpsfm_core.testing.synthetic.scenes import arc_poses, room_scene

CAMERA = PinholeCamera(320, 240, 260.0, 260.0, 160.0, 120.0)


def mapped(declared_depth_std: float, *, nearer: float = 1.0) -> Component:
    """Register three images; the depth prior of the last is too near by the factor ``nearer``."""
    problem = make_mapping_problem(
        room_scene(), CAMERA, arc_poses(3, 14.0), declared_depth_std=declared_depth_std
    )
    last = problem.images[-1]
    depth = replace(last.depth, depth=last.depth.depth / np.float32(nearer))
    problem = replace(problem, images=(*problem.images[:-1], replace(last, depth=depth)))
    mapper = Mapper(problem, MapperOptions(), NullMappingEvents())
    mapper.reconstruct_component()
    group = mapper.component
    assert group.scene.registered.all()
    group.refiner.noise = group.refiner.noise._replace(multiplier=1.0)
    return group


def push(group: Component, image: int, factor: float) -> None:
    """Scale the distances of an image's observed points from the camera center."""
    scene = group.scene
    seen = np.unique(scene.tracks.point_of[scene.graph.keypoints_of(image)])
    seen = seen[seen >= 0]
    center: Float64 = scene.centers()[image]
    scene.tracks.xyz[seen] = center + factor * (scene.tracks.xyz[seen] - center)


@pytest.mark.parametrize("metric", [True, False])
def test_metric_prior_without_common_points_takes_scale_of_other_priors(metric: bool) -> None:
    """If a view and its points are enlarged by 20 %, the observations of this view still fit."""
    group = mapped(0.01)
    scene = group.scene
    seen = scene.tracks.point_of[scene.graph.keypoints_of(2)]
    for image in (0, 1):  # remove the other views' observations of these points
        shared = np.arange(*scene.graph.offsets[image : image + 2])
        shared = shared[np.isin(scene.tracks.point_of[shared], seen[seen >= 0])]
        scene.tracks.remove_observations(shared, min_length=1)
    push(group, 2, 1.2)
    scene.maps[2].set_scale(1.2 * scene.maps[2].scale)
    for depth_map in scene.maps:
        depth_map.prior = replace(depth_map.prior, metric=metric)
    group.refiner.adjust([0, 1, 2])
    others = np.sqrt(scene.maps[0].scale * scene.maps[1].scale)
    assert scene.maps[2].scale / others == pytest.approx(1.0 if metric else 1.2, rel=0.01)


def test_wrong_scale_is_corrected_by_one_adjustment() -> None:
    """Scales and points are adjusted together, because depth is far more precise than keypoints."""
    group = mapped(0.001)
    maps, refiner = group.scene.maps, group.refiner
    right = [depth_map.scale for depth_map in maps]
    maps[2].set_scale(1.05 * maps[2].scale)
    refiner.adjust([0, 1, 2])
    found = np.array([depth_map.scale for depth_map in maps])
    assert found / found.mean() == pytest.approx(right / np.mean(right), rel=0.003)
    for _ in range(5):
        refiner.adjust([0, 1, 2])
    assert [depth_map.scale for depth_map in maps] == pytest.approx(found, rel=1e-3)


def test_deviating_scale_does_not_change_the_world_unit() -> None:
    """The prior on scales does not change all scales, which would change the unit of the world."""
    group = mapped(0.01, nearer=1.3)
    maps = group.scene.maps
    before = np.array([depth_map.scale for depth_map in maps])
    assert before[2] / before[0] == pytest.approx(1.3, rel=0.02)
    for _ in range(5):
        group.refiner.adjust([0, 1, 2])
    assert [depth_map.scale for depth_map in maps] == pytest.approx(before, rel=0.01)


def test_refined_depth_does_not_change_poses() -> None:
    group = mapped(0.01)
    scene, refiner = group.scene, group.refiner
    refinement = scene.maps[1].refinement
    assert refinement is not None
    refined = refinement.result
    before = scene.snapshot()
    refiner.adjust([0, 1, 2])
    straight = scene.translations.copy()
    scene.restore(before)
    tilt = np.linspace(-0.2, 0.2, refined.log_depth.shape[1])
    tilted = replace(refined, log_depth=refined.log_depth + tilt)
    scene.maps[1].set_refinement(DepthRefinement.from_result(tilted))
    refiner.adjust([0, 1, 2])
    assert np.array_equal(scene.translations, straight)


def adjusted(group: Component, *, rough: bool) -> Float64:
    """Move the points of image 2, and return the camera centers after bundle adjustment.

    The scene is restored afterwards.
    """
    before = group.scene.snapshot()
    push(group, 2, 1.02)
    group.refiner.adjust([0, 1, 2], rough=rough)
    centers: Float64 = group.scene.centers().copy()
    group.scene.restore(before)
    return centers


def test_rough_adjustment_stops_early_with_many_images() -> None:
    group = mapped(0.01)
    assert np.array_equal(adjusted(group, rough=True), adjusted(group, rough=False))
    refiner = group.refiner
    bundle = refiner.options.bundle.model_copy(update={"dense_poses": 2})
    refiner.options = refiner.options.model_copy(update={"bundle": bundle})
    exact = adjusted(group, rough=False)
    error = np.abs(adjusted(group, rough=True) - exact).max()
    assert 0 < error < 1e-3 * np.ptp(exact)


def test_loss_factor_depends_on_independent_errors() -> None:
    assert DepthNoise().loss_factor == 1.0
    assert DepthNoise(1.0, 0.0, 1.0).loss_factor == 1.0
    assert DepthNoise(1.3, 1.0, 1.0).loss_factor == 1.0, "cells of one residual tell nothing"
    assert DepthNoise(1.0, 0.75, 16.0).loss_factor == pytest.approx(0.5 / 4)
    assert DepthNoise(2.0, 1.0, 4.0).loss_factor > 0
