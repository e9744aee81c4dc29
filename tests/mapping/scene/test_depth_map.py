"""Depth maps are refined when they are first used."""

from __future__ import annotations

import pickle
from dataclasses import fields, replace
from pathlib import Path
from unittest.mock import patch

import numpy as np

from mpsfm_core.data import DepthPrior, MappingProblem
from mpsfm_core.mapping.mapper import reconstruct
from mpsfm_core.mapping.options import MapperOptions
from mpsfm_core.mapping.scene.depth_map import DepthMap, DepthRefinement, LazyDepth
from mpsfm_core.mapping.scene.reconstruction import compute_depth_maps
from mpsfm_core.optimize.depth_integration import NO_ANCHORS, Anchors, DepthIntegrator
from mpsfm_core.support.disk_arrays import store_on_disk
from mpsfm_core.testing.synthetic.halls import CALIBRATED_PRIORS, make_hall_problem


def make_problem() -> MappingProblem:
    return make_hall_problem(12, CALIBRATED_PRIORS, seed=1).problem


def make_integrator(depth_map: DepthMap) -> DepthIntegrator:
    return DepthIntegrator(depth_map.prior, depth_map.normals, depth_map.camera)


def test_mapping_well_connected_images_refines_no_depth_map() -> None:
    with patch.object(DepthIntegrator, "refine", side_effect=AssertionError("refined")):
        result = reconstruct(make_problem(), MapperOptions())
    assert len(result.reconstructions[0].images) == 12


def test_reading_the_depth_of_a_reconstruction_refines_it() -> None:
    problem = make_problem()
    (model,) = reconstruct(problem, MapperOptions()).reconstructions
    (eager,) = reconstruct(problem, MapperOptions()).reconstructions
    (priors,) = reconstruct(
        problem, MapperOptions.model_validate({"refinement": {"integrate": False}})
    ).reconstructions
    (eager,) = compute_depth_maps([eager])
    for image, other, unrefined in zip(model.images, eager.images, priors.images, strict=True):
        assert image.depth.metric == other.depth.metric
        assert type(other.depth) is DepthPrior
        for item in fields(DepthPrior):
            assert np.array_equal(getattr(image.depth, item.name), getattr(other.depth, item.name))
        assert not np.allclose(image.depth.depth, unrefined.depth.depth, rtol=1e-3)


def test_reconstruct_with_maps_on_disk_is_identical(tmp_path: Path) -> None:
    problem, options = make_problem(), MapperOptions(global_initialization=False)
    expected = compute_depth_maps(reconstruct(problem, options).reconstructions)
    with store_on_disk(tmp_path, in_memory=0):
        stored = compute_depth_maps(reconstruct(problem, options).reconstructions)
    for a, b in zip(expected[0].images, stored[0].images, strict=True):
        assert b.depth.depth.base is not None  # mapped from a file
        assert np.array_equal(a.depth.depth, b.depth.depth)
        assert np.array_equal(a.depth.variance, b.depth.variance)
        assert np.array_equal(a.translation, b.translation)


def test_pickled_and_replaced_depth_equals_the_depth_that_is_read() -> None:
    (model,) = reconstruct(make_problem(), MapperOptions()).reconstructions
    first, second, third = (image.depth for image in model.images[:3])
    assert isinstance(first, LazyDepth)
    copied = pickle.loads(pickle.dumps(first))
    assert np.array_equal(copied.depth, first.depth)
    assert np.array_equal(copied.variance, first.variance)
    assert replace(second, metric=False).shape == second.shape
    assert not hasattr(third, "normals")


def test_refinement_starts_from_the_result_of_the_previous_refinement() -> None:
    depth_map = DepthMap(make_problem().images[0])
    integrator, xy = make_integrator(depth_map), np.array([[20.5, 20.5]])
    near = Anchors(xy, 0.9 * depth_map.prior.depth[20:21, 20].astype(float), np.full(1, 1e-4))
    first = DepthRefinement(integrator, NO_ANCHORS, 1.0)
    second = DepthRefinement(integrator, near, 1.1, first)
    start = integrator.refine(NO_ANCHORS, scale=1.0)
    expected = integrator.refine(near, scale=1.1, start=start)
    assert np.array_equal(second.result.log_depth, expected.log_depth)
    assert np.array_equal(first.result.log_depth, start.log_depth)
    restored = pickle.loads(pickle.dumps(second))
    assert restored.scale == 1.1
    assert np.array_equal(restored.result.log_depth, expected.log_depth)


def test_depth_follows_scale_after_the_refinement_was_requested() -> None:
    depth_map = DepthMap(make_problem().images[0])
    depth_map.set_scale(2.0)
    assert np.allclose(depth_map.depth, 2.0 * depth_map.prior.depth)
    depth_map.set_refinement(DepthRefinement(make_integrator(depth_map), NO_ANCHORS, 2.0))
    depth_map.set_scale(3.0)
    at_two = DepthRefinement(make_integrator(depth_map), NO_ANCHORS, 2.0).result.depth
    assert np.allclose(depth_map.depth, 1.5 * at_two)
    assert np.allclose(depth_map.scaled_prior, 3.0 * depth_map.prior.depth)
    depth_map.reset()
    assert np.allclose(depth_map.depth, depth_map.prior.depth)


def test_resumed_depth_of_a_scaled_map_is_that_of_the_computed_map() -> None:
    """The scaled map is not stored, and a refinement starts from the resumed map."""
    image = make_problem().images[0]
    width = image.depth.shape[1]
    resumed, expected = DepthMap(image), DepthMap(image)
    scaled = LazyDepth(image.depth, None, 1.7, metric=False)
    resumed.resume(scaled, 1.3, width)
    assert np.allclose(resumed.depth, np.float32(1.7) * image.depth.depth, rtol=1e-5)
    assert isinstance(scaled, LazyDepth)
    scaled.compute()
    expected.resume(scaled, 1.3, width)
    assert np.array_equal(resumed.depth, expected.depth)
    integrator = make_integrator(resumed)
    refined = DepthRefinement(integrator, NO_ANCHORS, 1.3, resumed.refinement)
    assert resumed.refinement is not None
    start = resumed.refinement.result
    expected_log = integrator.refine(NO_ANCHORS, scale=1.3, start=start).log_depth
    assert np.array_equal(refined.result.log_depth, expected_log)
