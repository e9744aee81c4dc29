"""Tests of the uncertainty model against values computed by hand."""

from __future__ import annotations

import numpy as np
import pytest

from mpsfm_core.data import DepthPrior, NormalPrior
from mpsfm_core.providers.uncertainty.calibration import DepthCalibration, NormalCalibration

DEPTH = np.array([[1.0, 2.0], [4.0, 8.0]])


def stds(calibration: DepthCalibration, prior: DepthPrior) -> list[float]:
    variance = calibration.apply(prior).variance
    assert variance is not None
    return list(np.sqrt(variance.astype(np.float64)).ravel())


def test_total_std_is_the_maximum_of_three_terms() -> None:
    prior = DepthPrior.from_arrays(DEPTH, np.full((2, 2), 0.1**2))
    calibration = DepthCalibration(std_scale=2.0, relative_std=0.1, std_floor=0.3)
    assert stds(calibration, prior) == pytest.approx([0.3, 0.3, 0.4, 0.8], rel=1e-6)
    calibration = DepthCalibration(std_scale=5.0, relative_std=0.1, std_floor=0.3)
    assert stds(calibration, prior) == pytest.approx([0.5, 0.5, 0.5, 0.8], rel=1e-6)


def test_zero_std_scale_ignores_network_and_floor_needs_meters() -> None:
    prior = DepthPrior.from_arrays(DEPTH, np.ones((2, 2)), metric=False)
    calibration = DepthCalibration(relative_std=0.1, std_floor=0.3, use_network_variance=False)
    assert stds(calibration, prior) == pytest.approx([0.1, 0.2, 0.4, 0.8], rel=1e-6)


def test_pixels_beside_a_step_get_more() -> None:
    depth = np.array([[1.0, 1.04, 1.3, 1.31, 1.32]])
    calibration = DepthCalibration(
        relative_std=0.1, std_floor=0, edge_ratio=1.1, edge_std_scale=3.0
    )
    found = np.array(stds(calibration, DepthPrior.from_arrays(depth))) / depth.ravel()
    assert found == pytest.approx([0.1, 0.3, 0.3, 0.1, 0.1], rel=1e-5)


def test_depth_step_to_invalid_pixel_is_no_edge() -> None:
    prior = DepthPrior.from_arrays(np.array([[1.0, 1.0, np.nan, 5.0]]))
    calibration = DepthCalibration(relative_std=0.1, std_floor=0, edge_ratio=1.1, edge_std_scale=3)
    assert stds(calibration, prior) == pytest.approx([0.1, 0.1, 0, 0.5], rel=1e-5)


@pytest.mark.parametrize("space", ["depth", "disparity"])
def test_shift_is_in_units_of_the_median_depth(space: str) -> None:
    prior = DepthPrior.from_arrays(np.array([[1.0, 2.0, 5.0]]))
    shifted = DepthCalibration(shift=0.5, shift_space=space).apply(prior).depth.ravel()
    expected = [2.0, 3.0, 6.0] if space == "depth" else [1 / 1.25, 1 / 0.75, 1 / 0.45]
    assert shifted == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize("space", ["depth", "disparity"])
def test_shift_of_disparity_changes_the_variance(space: str) -> None:
    depth, step = np.array([[1.0, 2.0, 5.0]]), 1e-3
    calibration = DepthCalibration(
        std_scale=1.0, relative_std=0, std_floor=0, shift=0.3, shift_space=space
    )
    near, far = (calibration.shift_depth(depth + offset, (2.0, 0.5))[0] for offset in (-step, step))
    expected = (far - near) / (2 * step) * 0.05
    found = stds(calibration, DepthPrior.from_arrays(depth, np.full((1, 3), 0.05**2)))
    assert found == pytest.approx(list(expected.ravel()), rel=1e-4)


def test_depth_that_a_shift_destroys_is_invalid() -> None:
    prior = DepthPrior.from_arrays(np.array([[1.0, 10.0, 12.0]]))
    applied = DepthCalibration(shift=-0.2).apply(prior)
    assert applied.valid.tolist() == [[False, True, True]]


def test_map_without_valid_pixels_stays_invalid() -> None:
    prior = DepthPrior.from_arrays(np.zeros((2, 3)))
    assert not DepthCalibration(shift=0.4).apply(prior).valid.any()


def test_angles_of_normals() -> None:
    normals = np.tile([0.0, 0.0, -1.0], (1, 2, 1))
    prior = NormalPrior.from_arrays(normals, np.radians([[3.0, 10.0]]) ** 2)
    with_network = NormalCalibration(std_scale=0.5, std_floor_deg=2.0).apply(prior).variance
    assert np.degrees(np.sqrt(with_network)) == pytest.approx(np.array([[2.0, 5.0]]), rel=1e-5)
    constant = NormalCalibration(use_network_variance=False, std_default_deg=6.0)
    assert np.degrees(np.sqrt(constant.apply(prior).variance)) == pytest.approx(6.0, rel=1e-5)
