"""Tests of selected inversion against the dense inverse."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mpsfm_core.optimize.depth_variance import compute_inverse_diagonal
from tests.optimize.integration_reference import grid_operator


@settings(max_examples=40)
@given(height=st.integers(1, 22), width=st.integers(1, 22), seed=st.integers(0, 10**6))
def test_selected_inverse_equals_dense_inverse(height, width, seed):
    rng = np.random.default_rng(seed)
    planes = (10 ** rng.uniform(-6, 4, (3, height, width))).astype(np.float32)
    planes[2] = np.maximum(planes[2], 1e-2)
    dense = np.linalg.inv(grid_operator(*planes).toarray())
    expected = np.diag(dense).reshape(height, width)
    np.testing.assert_allclose(compute_inverse_diagonal(*planes), expected, rtol=1e-6)


@pytest.mark.parametrize("shape", [(1, 50), (50, 1), (7, 6), (13, 14), (31, 45)])
def test_selected_inverse_of_odd_shapes_equals_dense_inverse(shape):
    ones = np.ones(shape, np.float32)
    dense = np.linalg.inv(grid_operator(ones, ones, 0.1 * ones).toarray())
    expected = np.diag(dense).reshape(shape)
    np.testing.assert_allclose(
        compute_inverse_diagonal(ones, ones, 0.1 * ones), expected, rtol=1e-6
    )


def test_detached_pixels_have_infinite_variance():
    east, south, mass = np.ones((3, 8, 8), np.float32)
    east[4, 3:5] = south[3:5, 4] = mass[4, 4] = 0
    variance = compute_inverse_diagonal(east, south, mass)
    assert np.isinf(variance[4, 4])
    assert np.isfinite(np.delete(variance.ravel(), 4 * 8 + 4)).all()


def test_one_weighted_pixel_determines_a_connected_map():
    ones = np.ones((5, 6), np.float32)
    mass = np.zeros((5, 6), np.float32)
    mass[2, 3] = 4.0
    variance = compute_inverse_diagonal(ones, ones, mass)
    assert variance[2, 3] == pytest.approx(0.25)
    assert (variance >= 0.25 - 1e-9).all()
