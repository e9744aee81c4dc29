"""Tests of even sampling of points over the image."""

from __future__ import annotations

import numpy as np
import pytest

from mpsfm_core.calibration.model_selection import DepthData, select_candidate
from mpsfm_core.calibration.model_truth import REACH, sample_evenly
from mpsfm_core.calibration.samples import DepthSamples, DepthTruth, compare_depth
from mpsfm_core.data import DepthPrior, Float64
from mpsfm_core.providers.uncertainty.calibration import DepthCalibration

SIZE = WIDTH, HEIGHT = 200, 150


def truth_at(xy: Float64, depth: Float64 | None = None) -> DepthTruth:
    depth = np.arange(1.0, len(xy) + 1) if depth is None else depth
    return DepthTruth(xy, depth, depth / 1000)


def test_sample_evenly_weights_by_area() -> None:
    rng = np.random.default_rng(0)
    crowd = rng.normal((50, 75), 0.1, (99, 2))
    even = sample_evenly(truth_at(np.vstack([crowd, [[150.0, 75.0]]])), SIZE, 40_000, rng)
    alone = even.depth == 100
    assert alone.mean() == pytest.approx(0.5, abs=0.03)
    np.testing.assert_array_equal(even.xy[alone], np.tile([150.0, 75.0], (alone.sum(), 1)))
    np.testing.assert_array_equal(even.std, even.depth / 1000)


def test_sample_evenly_skips_distant_pixels() -> None:
    rng = np.random.default_rng(0)
    even = sample_evenly(truth_at(np.array([[100.0, 75.0]])), SIZE, 20_000, rng)
    disc = np.pi * (REACH * WIDTH) ** 2 / (WIDTH * HEIGHT)
    assert len(even.xy) / 20_000 == pytest.approx(disc, rel=0.1)


def photos(*, texture_only: bool) -> DepthData:
    """Return depth with larger errors and fewer points on the textureless half of images."""
    rng = np.random.default_rng(1)
    samples: list[DepthSamples] = []
    for number in range(12):
        points = rng.uniform((0, 0), SIZE, (2000, 2))
        textured = points[:, 0] < WIDTH / 2
        kept = textured | (rng.random(len(points)) < 0.05)
        points, textured = points[kept], textured[kept]
        depth = 2.0 * np.exp(np.where(textured, 0.05, 0.15) * rng.normal(size=len(points)))
        truth = truth_at(points, depth)
        if not texture_only:
            truth = sample_evenly(truth, SIZE, 500, rng)
        prior = DepthPrior.from_arrays(np.full((HEIGHT, WIDTH), 2.0), None, metric=False)
        compared = compare_depth(f"{number}.png", prior, SIZE, truth)
        assert compared is not None
        samples.append(compared)
    return DepthData(tuple(samples), in_meters=False)


def test_sample_evenly_removes_texture_bias() -> None:
    """Errors with a std of 5 % on one half and 15 % on the other are within 8.8 % for 68.27 %."""
    stds = []
    for texture_only in (True, False):
        calibration = select_candidate(photos(texture_only=texture_only).fit()).calibration
        assert isinstance(calibration, DepthCalibration)
        stds.append(calibration.relative_std)
    assert stds[0] < 0.06
    assert stds[1] == pytest.approx(0.088, rel=0.1)
