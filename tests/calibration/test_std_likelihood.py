"""Tests that the fit recovers the parameters of simulated errors."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mpsfm_core.calibration.model_selection import DepthData, NormalData, select_candidate, std_of
from mpsfm_core.calibration.samples import (
    DepthSamples,
    NormalSamples,
    depth_residuals,
    normal_residuals,
    tangent_errors,
)
from mpsfm_core.calibration.std_likelihood import bootstrap_fit, fit_std
from mpsfm_core.data import Float64
from mpsfm_core.providers.uncertainty.calibration import DepthCalibration, NormalCalibration
from tests.calibration.simulation import Simulated, simulate

PLAIN = Simulated()


def fitted(samples: tuple[DepthSamples, ...], *alignments: str) -> DepthCalibration:
    calibration = select_candidate(DepthData(samples, alignments or ("scale",)).fit()).calibration
    assert isinstance(calibration, DepthCalibration)
    return calibration


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_fit_recovers_three_terms_within_5_percent(seed: int) -> None:
    found = fitted(simulate(PLAIN, 20, seed))
    assert found.use_network_variance
    assert found.std_scale == pytest.approx(PLAIN.std_scale, rel=0.05)
    assert found.relative_std == pytest.approx(PLAIN.relative_std, rel=0.05)
    assert found.std_floor == pytest.approx(PLAIN.std_floor, rel=0.05)
    assert found.edge_ratio is None


def test_fit_without_network_variance() -> None:
    found = fitted(simulate(replace(PLAIN, network=False, relative_std=0.2), 20))
    assert not found.use_network_variance
    assert found.relative_std == pytest.approx(0.2, rel=0.05)


def test_fit_subtracts_noise_of_truth() -> None:
    noisy = replace(PLAIN, truth_std=0.05)
    found = fitted(simulate(noisy, 20))
    assert found.std_scale == pytest.approx(PLAIN.std_scale, rel=0.05)
    assert found.relative_std == pytest.approx(PLAIN.relative_std, rel=0.07)


def test_fit_recovers_edge_scale() -> None:
    found = fitted(simulate(replace(PLAIN, edge_std_scale=3.0), 20))
    assert found.edge_ratio in (1.05, 1.1)
    assert found.edge_std_scale == pytest.approx(3.0, rel=0.05)
    assert found.relative_std == pytest.approx(PLAIN.relative_std, rel=0.05)


def test_fit_ignores_uninformative_network_std() -> None:
    samples = simulate(replace(PLAIN, network=False, gross=0.02), 12)
    rng = np.random.default_rng(5)
    pretending = tuple(
        replace(s, network_std=s.prior * np.exp(rng.normal(-4, 1, len(s.prior)))) for s in samples
    )
    assert not fitted(pretending).use_network_variance


def test_fit_undetermined_floor_has_default() -> None:
    coarse = simulate(replace(PLAIN, network=False, relative_std=0.3, std_floor=0), 10)
    assert fitted(coarse).std_floor == pytest.approx(0.02)
    fine = simulate(replace(PLAIN, network=False, relative_std=0.003, std_floor=0, gross=0.01), 10)
    found = fitted(fine)
    assert found.relative_std == pytest.approx(0.003, rel=0.05)
    assert found.std_floor < 0.003 * np.quantile(fine[0].prior, 0.5)


@pytest.mark.parametrize("alignment", ["scale-shift", "disparity"])
def test_fit_recovers_shift_of_relative_network(alignment: str) -> None:
    parameters = Simulated(network=False, metric=False, relative_std=0.05, gross=0.02)
    shifted = tuple(_unshift(s, alignment, 0.4) for s in simulate(parameters, 20))
    found = fitted(shifted, "scale", "scale-shift", "disparity")
    assert found.shift_space == ("depth" if alignment == "scale-shift" else "disparity")
    truth = 0.4 / 0.6  # The unit is the median of the shifted prior, 0.6 of the true median.
    assert found.shift == pytest.approx(truth, rel=0.05)
    assert found.relative_std == pytest.approx(0.05, rel=0.05)


def test_fit_without_shift_selects_scale() -> None:
    samples = simulate(replace(PLAIN, metric=False, network=False), 20)
    assert abs(fitted(samples, "scale", "scale-shift", "disparity").shift) < 0.02


def test_fit_estimates_gross_ratio() -> None:
    assert fit_std(depth_residuals(simulate(PLAIN, 10), DepthCalibration())).gross > 0.02
    clean = replace(PLAIN, gross=0.0)
    assert fit_std(depth_residuals(simulate(clean, 10), DepthCalibration())).gross < 0.005


def test_fit_heavy_tails_matches_coverage() -> None:
    samples = simulate(replace(PLAIN, gross=0.0, network=False), 10)
    rng = np.random.default_rng(0)
    heavy = tuple(
        replace(s, truth=s.prior * np.exp(0.1 * rng.standard_t(2.5, len(s.prior)))) for s in samples
    )
    calibration = fitted(heavy)
    residuals = depth_residuals(heavy, calibration)
    within = np.abs(residuals.error) <= std_of(calibration, residuals)
    assert within.mean() == pytest.approx(0.683, abs=0.02)


def test_bootstrap_intervals_cover_truth_and_shrink() -> None:
    widths = []
    for images in (5, 30):
        residuals = depth_residuals(simulate(PLAIN, images, seed=7, pixels=300), DepthCalibration())
        fit = fit_std(residuals)
        drawn = bootstrap_fit(residuals, fit, 40, np.random.default_rng(0))
        low, high = np.percentile(drawn[:, 1], [2.5, 97.5])
        assert low < PLAIN.relative_std * 1.02
        assert high > PLAIN.relative_std * 0.98
        widths.append(high - low)
    assert widths[1] < 0.6 * widths[0]


def test_fit_weights_images_equally() -> None:
    good = simulate(replace(PLAIN, network=False, relative_std=0.05, std_floor=0), 6, pixels=200)
    many = simulate(replace(PLAIN, network=False, relative_std=0.2, std_floor=0), 6, pixels=4000)
    few = simulate(replace(PLAIN, network=False, relative_std=0.2, std_floor=0), 6, pixels=200)
    assert fitted(good + many).relative_std == pytest.approx(
        fitted(good + few).relative_std, rel=0.1
    )


@pytest.mark.parametrize("network", [True, False])
def test_fit_recovers_normal_std_within_5_percent(network: bool) -> None:
    rng = np.random.default_rng(0)
    samples = tuple(_normal_samples(rng, 2.0, np.radians(4.0), network) for _ in range(20))
    found = select_candidate(NormalData(samples).fit()).calibration
    assert isinstance(found, NormalCalibration)
    assert found.use_network_variance == network
    if network:
        assert found.std_scale == pytest.approx(2.0, rel=0.05)
        assert found.std_floor_deg == pytest.approx(4.0, rel=0.05)
    else:
        assert found.std_default_deg == pytest.approx(4.0, rel=0.05)


def test_tangent_errors_are_angles() -> None:
    rng = np.random.default_rng(1)
    prior = _unit(rng.normal((0, 0, -4), 1, (100, 3)))
    truth = _unit(prior + 0.3 * rng.normal(size=(100, 3)))
    length = np.linalg.norm(tangent_errors(prior, truth), axis=1)
    assert length == pytest.approx(np.arccos((prior * truth).sum(axis=1)), abs=1e-9)


def test_std_of_matches_apply() -> None:
    """The std in the fit must equal the std that extraction computes with the calibration."""
    samples = simulate(PLAIN, 1)
    calibration = DepthCalibration(
        std_scale=2.0, relative_std=0.05, std_floor=0.1, edge_ratio=1.1, edge_std_scale=1.7
    )
    residuals = depth_residuals(samples, calibration)
    image = samples[0]
    by_hand = np.maximum(2.0 * image.network_std, np.maximum(0.05 * image.prior, 0.1)) / image.prior
    by_hand = np.where(image.step > np.log(1.1), 1.7 * by_hand, by_hand)
    assert std_of(calibration, residuals) == pytest.approx(by_hand, rel=1e-12)


def test_normal_residuals_have_two_directions() -> None:
    samples = _normal_samples(np.random.default_rng(0), 1.0, 0.1, True)
    residuals = normal_residuals([samples])
    assert len(residuals) == 2 * len(samples.prior)
    assert residuals.names == ("std_scale", "std_floor_deg")


def _unshift(samples: DepthSamples, alignment: str, share: float) -> DepthSamples:
    """Subtract a ratio of the map's median from depth or inverse depth of the samples."""
    space = 0 if alignment == "scale-shift" else 1
    median = samples.depth_medians[space]
    quantity = samples.prior if space == 0 else 1 / samples.prior
    keep = quantity > 1.05 * share * median
    moved = quantity[keep] - share * median
    medians = list(samples.depth_medians)
    medians[space] = (1 - share) * median
    return replace(
        samples,
        prior=moved if space == 0 else 1 / moved,
        step=samples.step[keep],
        truth=samples.truth[keep],
        truth_std=samples.truth_std[keep],
        depth_medians=(medians[0], medians[1]),
    )


def _normal_samples(
    rng: np.random.Generator, scale: float, floor: float, network: bool
) -> NormalSamples:
    count = 1000
    prior = _unit(rng.normal((0, 0, -1), 0.4, (count, 3)))
    network_std = np.exp(rng.normal(np.log(0.04), 0.7, count))
    std = np.maximum(scale * network_std, floor) if network else np.full(count, floor)
    first = _unit(np.cross(prior, [0.0, 1.0, 0.0]))
    second = np.cross(prior, first)
    turn = rng.normal(size=(count, 2)) * std[:, None]
    angle = np.linalg.norm(turn, axis=1, keepdims=True)
    side = (turn[:, :1] * first + turn[:, 1:] * second) / angle
    truth = np.cos(angle) * prior + np.sin(angle) * side
    return NormalSamples("a", prior, network_std if network else None, truth, np.zeros(count))


def _unit(vectors: Float64) -> Float64:
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)
