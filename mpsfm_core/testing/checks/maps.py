"""Requirements that the contract checks of depth and normal maps share."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mpsfm_core.data import Bool, DepthPrior, Float32, NormalPrior
from mpsfm_core.data.errors import DataError
from mpsfm_core.geometry import resize_map
from mpsfm_core.testing.accuracy import MAX_INVALID_RATIO, VALIDITY_TOLERANCE
from mpsfm_core.testing.contract_case import ContractCase
from mpsfm_core.testing.examples import Example, TrueMaps
from mpsfm_core.testing.outcome import CheckFailed, CheckSkipped


def require_true_validity(valid: Bool, truth: TrueMaps) -> str:
    """Require that a depth or normal map is valid only where the view shows a surface.

    Args:
        valid: Boolean mask (h, w) of the valid pixels of a depth or normal map.
        truth: Ground-truth maps (h, w) on the pixel grid of the map.

    Returns:
        Text with the ratios of wrongly valid and wrongly invalid pixels.

    Raises:
        CheckFailed: the ratio of wrongly valid pixels exceeds :data:`VALIDITY_TOLERANCE`, or that
            of invalid pixels with a surface exceeds :data:`MAX_INVALID_RATIO`.
        CheckSkipped: the map is too coarse to separate surfaces from sky.
    """
    empty, full = truth.edge_free & ~truth.valid, truth.smooth
    if not (empty.any() and full.any()):
        raise CheckSkipped("the map is too coarse to separate surfaces from sky")
    wrong, lost = float(valid[empty].mean()), float(1 - valid[full].mean())
    if wrong > VALIDITY_TOLERANCE:
        raise CheckFailed(f"{wrong:.0%} of the pixels without any surface are valid")
    if lost > MAX_INVALID_RATIO:
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
