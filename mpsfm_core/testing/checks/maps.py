"""Requirements that the contract checks of depth and normal maps share."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mpsfm_core.data import Bool, DepthPrior, Float32, Float64, NormalPrior
from mpsfm_core.data.errors import DataError
from mpsfm_core.geometry import resize_map
from mpsfm_core.testing import map_errors
from mpsfm_core.testing.contract_case import ContractCase
from mpsfm_core.testing.examples import Example, TrueMaps
from mpsfm_core.testing.outcome import CheckFailed, CheckSkipped
from mpsfm_core.testing.painted_views import NORMALS_STD, RELATIVE_STD

STD_FACTOR = 1.25
"""Largest accepted ratio between the returned std and the std that the test network reports. A std
of 0.25 m that is returned as a variance of 0.25 m^2 gives a ratio of 2."""
STD_SPREAD_FACTOR = 1.5
"""Largest accepted ratio between the returned std and the reported std at the 10 % and 90 %
quantiles of all pixels. A mirrored or averaged std gives a ratio of 2 where depth varies."""
VALIDITY_TOLERANCE = 0.05
"""Largest accepted ratio of pixels, away from edges, that are wrongly valid or wrongly invalid.
Padding and blur of a network cause some such pixels."""


def require_reported_std(variance: Float32, expected_std: Float64) -> str:
    """Require that the output variance is the square of the std that the test network reports.

    Args:
        variance: Variances (n,) in the output of the provider.
        expected_std: Standard deviations (n,) that the test network reports.

    Returns:
        Text with the median ratio between returned and expected standard deviations.

    Raises:
        CheckFailed: the median ratio of the standard deviations is above :data:`STD_FACTOR` or
            below its inverse.
    """
    ratios = np.sqrt(variance.astype(np.float64)) / expected_std
    low, factor, high = map(float, np.quantile(ratios, (0.1, 0.5, 0.9)))
    if 1 / STD_FACTOR < factor < STD_FACTOR:
        if low < 1 / STD_SPREAD_FACTOR or high > STD_SPREAD_FACTOR:
            raise CheckFailed(
                f"the std is {low:.2g} to {high:.2g} times the std that the test network reports: "
                "the variance belongs to other pixels or is averaged"
            )
        return f"std {factor:.3f} times the reported one"
    if 1 / STD_FACTOR < float(np.median(variance / expected_std)) < STD_FACTOR:
        raise CheckFailed("the variance equals the std: return the squared std")
    raise CheckFailed(f"the std is {factor:.2g} times the std that the test network reports")


def require_depth_std(prior: DepthPrior, example: Example) -> str:
    """Require the variance of depth that a test network reports, if there is a variance."""
    if prior.variance is None:
        return "no variance"
    where = map_errors.select_comparable(prior.valid, example.truth(prior.shape))
    expected = RELATIVE_STD * prior.depth[where].astype(np.float64)
    return require_reported_std(prior.variance[where], expected)


def require_normals_std(prior: NormalPrior, example: Example) -> str:
    """Require the variance of normals that a test network reports, if there is a variance."""
    if prior.variance is None:
        return "no variance"
    where = map_errors.select_comparable(prior.valid, example.truth(prior.shape))
    expected = np.full(int(where.sum()), NORMALS_STD)
    return require_reported_std(prior.variance[where], expected)


def require_true_validity(valid: Bool, truth: TrueMaps) -> str:
    """Require that a depth or normal map is valid exactly where the view shows a surface.

    Args:
        valid: Boolean mask (h, w) of the valid pixels of a depth or normal map.
        truth: Ground-truth maps (h, w) on the pixel grid of the map.

    Returns:
        Text with the ratios of wrongly valid and wrongly invalid pixels.

    Raises:
        CheckFailed: the ratio of wrongly valid or of wrongly invalid pixels exceeds
            :data:`VALIDITY_TOLERANCE`.
        CheckSkipped: the map is too coarse to separate surfaces from sky.
    """
    empty, full = truth.edge_free & ~truth.valid, truth.smooth
    if not (empty.any() and full.any()):
        raise CheckSkipped("the map is too coarse to separate surfaces from sky")
    wrong, lost = float(valid[empty].mean()), float(1 - valid[full].mean())
    if wrong > VALIDITY_TOLERANCE:
        raise CheckFailed(f"{wrong:.0%} of the pixels without any surface are valid")
    if lost > VALIDITY_TOLERANCE:
        raise CheckFailed(f"{lost:.0%} of the pixels with a surface are not valid")
    return f"{wrong:.1%} wrongly valid, {lost:.1%} lost"


def require_monotonic_calibration(case: ContractCase, prior: DepthPrior | NormalPrior) -> None:
    """Require that calibration gives each pixel a variance and keeps the order of the variances.

    Args:
        case: Provider under test.
        prior: Its answer.

    Raises:
        CheckFailed: the calibrated variance is invalid, or does not grow with ``std_scale`` and
            with
            the variance of the network.
    """
    calibration = case.calibration()

    def total(given: DepthPrior | NormalPrior, scale: float = 1.0) -> Float32:
        changed = {"std_scale": scale * calibration.std_scale}
        try:
            with np.errstate(over="ignore"):
                applied = calibration.model_copy(update=changed).apply(given)
        except DataError as error:
            raise CheckFailed(f"after calibration, {error}") from error
        values: Float32 = applied.variance[given.valid]
        return values

    if not (total(prior, 2.0) >= total(prior)).all():
        raise CheckFailed("a larger std_scale gives a smaller variance")
    if prior.variance is not None and calibration.use_network_variance and prior.valid.any():
        larger = replace(prior, variance=prior.variance * np.float32(100))
        if not (total(larger) > total(prior)).any():
            raise CheckFailed(
                "a ten times larger network std does not change the calibrated variance"
            )


def swap_painted_channels(example: Example, shape: tuple[int, int]) -> NDArray[Any]:
    """Return the painted image with its channels in BGR order, resized to the grid of a map."""
    return resize_map(example.view.image[..., ::-1], shape[1], shape[0])
