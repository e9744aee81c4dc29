"""Test of the depth refinement of a finished reconstruction."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from mpsfm_core.mapping.depth_map_refinement import refine_depth_maps
from mpsfm_core.mapping.mapper import reconstruct
from mpsfm_core.mapping.options import MapperOptions
from tests.mapping.focal_scenes import make_room


def test_refine_depth_maps_of_reconstruction_equals_mapper_depth() -> None:
    problem, options = make_room(), MapperOptions()
    model = reconstruct(problem, options).reconstructions[0]
    blank = (replace(i, depth=problem.images[i.index].depth) for i in model.images)
    refined = refine_depth_maps(problem, replace(model, images=tuple(blank)), options)
    assert refined.poses.keys() == model.poses.keys()
    for old, new in zip(model.images, refined.images, strict=True):
        assert new.depth.metric == old.depth.metric
        np.testing.assert_array_equal(new.depth.valid, old.depth.valid)
        ratio = new.depth.depth[new.depth.valid] / old.depth.depth[old.depth.valid]
        assert np.median(np.abs(ratio - 1)) < 1e-3
