"""Tests of data class constructors that normalize network outputs."""

from __future__ import annotations

import pickle
from dataclasses import replace

import numpy as np
import pytest

from mpsfm_core import Features, PinholeCamera, SparseMatches, View
from mpsfm_core.data.cameras import defer_decoding
from mpsfm_core.data.errors import ProviderError
from mpsfm_core.providers import require_features

FEATURES = Features(np.zeros((0, 2)), np.zeros((0, 8), np.float32), np.zeros(0, np.float32))


def test_sparse_matches_from_arrays_converts_dtypes_and_clips_scores() -> None:
    found = SparseMatches.from_arrays(np.array([[0.0, 2.0], [1.0, 0.0]]), np.array([1.2, -0.1]))
    assert found.indices.dtype == np.int64 and found.indices.tolist() == [[0, 2], [1, 0]]
    assert found.scores.dtype == np.float32 and found.scores.tolist() == [1.0, 0.0]


def test_from_best_scores_keeps_highest_score_per_feature() -> None:
    indices = np.array([[0, 5], [1, 5], [1, 6], [2, 7], [3, 6]])
    found = SparseMatches.from_best_scores(indices, np.array([0.2, 0.9, 0.8, 0.3, 0.5]))
    # The match (1, 6) loses to (1, 5), so feature 6 remains available for (3, 6).
    assert found.indices.tolist() == [[1, 5], [3, 6], [2, 7]]
    np.testing.assert_allclose(found.scores, [0.9, 0.5, 0.3])


def test_require_features_without_features_raises() -> None:
    assert require_features("x matches features", FEATURES, FEATURES) == (FEATURES, FEATURES)
    with pytest.raises(ProviderError, match="x matches features: choose a features provider"):
        require_features("x matches features", FEATURES, None)


def test_view_with_deferred_decoding_is_decoded_once() -> None:
    camera, decoded = PinholeCamera(4, 3, 5.0, 5.0, 2.0, 1.5), []

    def decode() -> View:
        decoded.append(1)
        return View("a.jpg", np.ones((3, 4, 3), np.uint8), camera, np.eye(3, 4, dtype=bool), 6)

    view = defer_decoding("a.jpg", camera, 6, decode)
    assert (view.name, view.camera, view.orientation) == ("a.jpg", camera, 6)
    assert not decoded
    with pytest.raises(AttributeError, match="no attribute 'pixels'"):
        _ = view.pixels
    for other in (view, pickle.loads(pickle.dumps(view)), replace(view, name="b.jpg")):
        assert other.image.sum() == 36 and other.mask.sum() == 3
    assert decoded == [1]
