"""Tests of AdaLAM on synthetic features, and on SIFT features of real images."""

from __future__ import annotations

import numpy as np
import pytest
from mpsfm_kornia.adalam import AdalamMatcher
from mpsfm_kornia.options import AdalamOptions

from mpsfm_core import Features
from mpsfm_core.data.errors import ProviderError
from mpsfm_core.providers.builtin.mutual_nearest import MutualNearest
from mpsfm_core.providers.builtin.options import MutualNearestOptions, SiftOptions
from mpsfm_core.providers.builtin.sift import Sift

COUNT = 300


def features_of(keypoints, descriptors, scales=None):
    unit = descriptors / np.linalg.norm(descriptors, axis=1, keepdims=True)
    return Features(keypoints, unit.astype(np.float32), scales=scales)


@pytest.fixture
def moved():
    """Create two sets of features that differ by (8, 5) pixels, 100 of them by random shifts."""
    rng = np.random.default_rng(0)
    keypoints, descriptors = rng.uniform(10, 170, (COUNT, 2)), rng.normal(size=(COUNT, 16))
    there = keypoints + np.array([8.0, 5.0])
    there[:100] = rng.uniform(10, 170, (100, 2))
    order = rng.permutation(COUNT)
    noisy = descriptors + 0.1 * rng.normal(size=descriptors.shape)
    return features_of(keypoints, descriptors), features_of(there[order], noisy[order]), order


def test_matches_consistent_with_neighbors_are_kept(blocks, moved, context):
    a, b, order = moved
    found = AdalamMatcher(AdalamOptions(), context).match(blocks, blocks, a, b).sparse
    rows, partners = found.indices[:, 0], order[found.indices[:, 1]]
    np.testing.assert_array_equal(rows, partners)
    kept = np.isin(np.arange(COUNT), rows)
    assert kept[100:].mean() > 0.95 and kept[:100].mean() < 0.1
    assert 0 <= found.scores.min() <= found.scores.max() <= 1


def test_matches_of_inconsistent_scale_are_dropped(blocks, moved, context):
    a, b, order = moved
    scales = np.ones(COUNT, dtype=np.float32)
    other = np.where(np.arange(COUNT) < 200, 1.0, 4.0).astype(np.float32)[order]
    a = Features(a.keypoints, a.descriptors, scales=scales)
    b = Features(b.keypoints, b.descriptors, scales=other)
    found = [
        AdalamMatcher(AdalamOptions(scale_ratio=ratio), context).match(blocks, blocks, a, b).sparse
        for ratio in (1.5, None)
    ]
    kept = [np.isin(np.arange(COUNT), f.indices[:, 0]) for f in found]
    assert kept[1][100:].mean() > 0.95
    # A neighborhood only accepts matches with the same scale change as its seed match.
    assert kept[0][100:].sum() < kept[1][100:].sum()


def test_errors_and_few_features(blocks, moved, context):
    a, _, _ = moved
    matcher = AdalamMatcher(AdalamOptions(), context)
    none = Features(np.empty((0, 2)), np.empty((0, 16), dtype=np.float32))
    assert len(matcher.match(blocks, blocks, a, none).sparse) == 0
    with pytest.raises(ProviderError, match="choose a features provider"):
        matcher.match(blocks, blocks)
    other = Features(a.keypoints, a.descriptors[:, :8].copy())
    with pytest.raises(ProviderError, match="differ in dimension"):
        matcher.match(blocks, blocks, a, other)


def test_more_correct_matches_than_the_ratio_test_on_real_photos(load_pair, context):
    """Check that AdaLAM finds more correct SIFT matches than the ratio test in a real scene."""
    pair = load_pair("fountain", "0003.jpg", "0005.jpg")
    sift = Sift(SiftOptions(max_keypoints=3000, first_octave=0), context)
    a, b = sift.extract(pair.view_a), sift.extract(pair.view_b)
    right = {}
    for name, matcher in (
        ("adalam", AdalamMatcher(AdalamOptions(), context)),
        ("ratio", MutualNearest(MutualNearestOptions(), context)),
    ):
        rows = matcher.match(pair.view_a, pair.view_b, a, b).sparse.indices
        distance = pair.epipolar_distance(a.keypoints[rows[:, 0]], b.keypoints[rows[:, 1]])
        right[name] = int((distance < 2).sum()), float((distance < 2).mean())
    assert right["adalam"][0] > right["ratio"][0], right
    assert right["adalam"][1] > 0.9, right
