"""Tests of LightGlue and LighterGlue on views that differ by a known shift."""

from __future__ import annotations

import numpy as np
import pytest
from kornia.feature import LightGlue

from mpsfm_core import Features
from mpsfm_core.data.errors import ProviderError

FAMILIES = {"xfeat": "lighterglue", "aliked": "lightglue-aliked", "disk": "lightglue-disk"}
SHIFT = (32, 32)
"""Shift in pixels, a multiple of all network strides, so that networks see identical patches."""


@pytest.fixture(params=FAMILIES)
def family(request):
    return request.param


def shifted(view, dx, dy):
    """Shift an image right and down by whole pixels, repeating its border."""
    padded = np.pad(view.image, ((dy, 0), (dx, 0), (0, 0)), mode="edge")
    return type(view)("shifted.png", padded[: -dy or None, : -dx or None].copy(), view.camera)


def test_matches_of_shifted_views_have_the_known_shift(make, blocks, family):
    other = shifted(blocks, *SHIFT)
    detector, matcher = make("features", family), make("matcher", FAMILIES[family])
    features = detector.extract(blocks), detector.extract(other)
    sparse = matcher.match(blocks, other, *features).sparse
    rows = sparse.indices
    flow = features[1].keypoints[rows[:, 1]] - features[0].keypoints[rows[:, 0]]
    assert len(rows) > 40
    assert (np.abs(flow - SHIFT).max(axis=1) < 1.5).mean() > 0.9
    np.testing.assert_allclose(np.median(flow, axis=0), SHIFT, atol=0.1)
    assert 0.1 < sparse.scores.min() <= sparse.scores.max() <= 1


def test_order_of_the_views(make, blocks, family):
    other = shifted(blocks, *SHIFT)
    detector, matcher = make("features", family), make("matcher", FAMILIES[family])
    a, b = detector.extract(blocks), detector.extract(other)
    there = matcher.match(blocks, other, a, b).sparse.indices
    back = matcher.match(other, blocks, b, a).sparse.indices
    common = set(map(tuple, there)) & set(map(tuple, back[:, ::-1]))
    assert len(common) > 0.95 * max(len(there), len(back))


def test_threshold_option(make, blocks):
    other = shifted(blocks, *SHIFT)
    detector = make("features", "xfeat")
    a, b = detector.extract(blocks), detector.extract(other)
    scores = [
        make("matcher", "lighterglue", filter_threshold=t).match(blocks, other, a, b).sparse.scores
        for t in (0.1, 0.9)
    ]
    assert len(scores[1]) < len(scores[0])
    assert scores[1].min() > 0.9


def test_no_features_no_matches(make, blocks, family):
    detector, matcher = make("features", family), make("matcher", FAMILIES[family])
    some = detector.extract(blocks)
    none = Features(np.empty((0, 2)), np.empty((0, some.descriptors.shape[1]), dtype=np.float32))
    for a, b in ((some, none), (none, some), (none, none)):
        assert len(matcher.match(blocks, blocks, a, b).sparse) == 0


def test_features_of_another_family(make, blocks):
    features = make("features", "xfeat").extract(blocks)
    matcher = make("matcher", "lightglue-aliked")
    with pytest.raises(ProviderError, match="64 dimensions, this matcher needs 128"):
        matcher.match(blocks, blocks, features, features)
    with pytest.raises(ProviderError, match="choose a features provider"):
        matcher.match(blocks, blocks)


def test_changed_kornia_defaults_have_no_effect(make, blocks, monkeypatch):
    features = make("features", "aliked").extract(blocks)
    before = make("matcher", "lightglue-aliked").match(blocks, blocks, features, features)
    foreign = {**LightGlue.default_conf, "descriptor_dim": 96, "n_layers": 6, "num_heads": 1}
    monkeypatch.setattr(LightGlue, "default_conf", foreign | {"width_confidence": 0.5})
    after = make("matcher", "lightglue-aliked").match(blocks, blocks, features, features)
    np.testing.assert_array_equal(before.sparse.indices, after.sparse.indices)
    assert LightGlue.default_conf["n_layers"] == 6
