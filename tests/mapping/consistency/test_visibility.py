"""Tests of the selection of images that see most points of a depth map."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mpsfm_core.data import Float64
from mpsfm_core.mapping.consistency.visibility import Views, measure_visibility


def random_views(rng: np.random.Generator, count: int) -> Views:
    return Views.of_cameras(
        np.arange(100, 100 + count),
        Rotation.random(count, rng=rng).as_matrix(),
        rng.normal(0, 4, (count, 3)),
        rng.uniform(20, 60, (count, 4)),
        rng.uniform(40, 80, (count, 2)),
    )


def project_all(views: Views, points: Float64) -> tuple[Float64, Float64]:
    """Return depth (p, n) in each image, and which points (p, n) are visible."""
    local = np.einsum("nij,pj->pni", views.rotations, points) + views.translations
    depth = local[..., 2:]
    xy = views.intrinsics[:, :2] * local[..., :2] / depth + views.intrinsics[:, 2:]
    return depth[..., 0], ((xy >= 0) & (xy < views.sizes) & (depth > 0)).all(axis=-1)


@pytest.mark.parametrize("num_points", [0, 1, 16, 100])
def test_visible_points_and_depth_ratios_are_those_of_projection(num_points: int) -> None:
    rng = np.random.default_rng(num_points)
    points, other = rng.normal(0, 1.5, (num_points, 3)), rng.uniform(1, 8, num_points)
    views = random_views(rng, 300)
    z, is_inside = project_all(views, points)
    counts, similarities = measure_visibility(points, other, views, num_best=300, min_count=1)
    np.testing.assert_array_equal(counts, is_inside.sum(axis=0))
    other = other[:, None]
    ratios = np.where(is_inside, np.minimum(z, other) / np.maximum(z, other), 0)
    np.testing.assert_allclose(similarities, ratios.sum(axis=0))


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize(("num_best", "min_count"), [(1, 1), (5, 20), (17, 13)])
def test_skipped_images_are_not_among_the_best(seed: int, num_best: int, min_count: int) -> None:
    rng = np.random.default_rng(seed)
    points, other = rng.normal(0, 0.5, (200, 3)), rng.uniform(1, 8, 200)
    views = random_views(rng, 400)
    counts, similarities = measure_visibility(points, other, views, num_best=400, min_count=1)
    rows = np.argsort(-np.where(counts >= min_count, similarities, 0), kind="stable")[:num_best]
    best = views.find_best(points, other, num_best=num_best, min_count=min_count)
    assert len(best) == num_best
    np.testing.assert_array_equal(best, views.images[rows])
    some, _ = measure_visibility(points, other, views, num_best, min_count)
    assert num_best <= np.count_nonzero(some) < np.count_nonzero(counts)
