"""Tests of data class constructors that normalize network outputs."""

from __future__ import annotations

import numpy as np
import pytest

from mpsfm_core import Features, SparseMatches
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
