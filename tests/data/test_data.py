"""Constructors that clean up what networks put out."""

from __future__ import annotations

import numpy as np
import pytest

from mpsfm_core import Features, SparseMatches
from mpsfm_core.data.errors import ProviderError
from mpsfm_core.providers import require_features

FEATURES = Features(np.zeros((0, 2)), np.zeros((0, 8), np.float32), np.zeros(0, np.float32))


def test_matches_from_arrays_of_any_type_have_scores_within_range() -> None:
    found = SparseMatches.from_arrays(np.array([[0.0, 2.0], [1.0, 0.0]]), np.array([1.2, -0.1]))
    assert found.indices.dtype == np.int64 and found.indices.tolist() == [[0, 2], [1, 0]]
    assert found.scores.dtype == np.float32 and found.scores.tolist() == [1.0, 0.0]


def test_of_several_matches_of_a_feature_the_most_certain_stays() -> None:
    indices = np.array([[0, 5], [1, 5], [1, 6], [2, 7], [3, 6]])
    found = SparseMatches.best_first(indices, np.array([0.2, 0.9, 0.8, 0.3, 0.5]))
    # (1, 6) goes with its feature 1, but has not taken feature 6 from (3, 6)
    assert found.indices.tolist() == [[1, 5], [3, 6], [2, 7]]
    np.testing.assert_allclose(found.scores, [0.9, 0.5, 0.3])


def test_a_matcher_that_needs_features_says_so() -> None:
    assert require_features("x matches features", FEATURES, FEATURES) == (FEATURES, FEATURES)
    with pytest.raises(ProviderError, match="x matches features: choose a features provider"):
        require_features("x matches features", FEATURES, None)
