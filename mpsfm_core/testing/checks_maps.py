"""What the checks of depth and of normals share."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mpsfm_core.data import Bool, DepthPrior, Float32, Float64, NormalPrior
from mpsfm_core.geometry import resize_map
from mpsfm_core.testing.case import Case
from mpsfm_core.testing.examples import Example, Truth
from mpsfm_core.testing.measure import Shift
from mpsfm_core.testing.outcome import CheckFailed, CheckSkipped

SHIFT_TOLERANCE_PX = 0.25
"""Of the view, or of the map where its pixels are larger. Half of the shift that taking integers
for pixel centres makes. Ours: right resizing stays below 0.1, also at half and a quarter size."""
STD_FACTOR = 1.25
"""Between the std found and the one reported; a std of 0.25 m taken for a variance is 2 off."""
VALIDITY_TOLERANCE = 0.05
"""Share of pixels away from edges, for networks whose padding or blur costs some."""


def accept_shift(shift: Shift, shape: tuple[int, int], case: Case) -> str:
    """Raise ``CheckFailed`` if a map of this shape is shifted by too much.

    For providers that see, only the shift in the centre counts: estimates from neighbourhoods are
    biased where the surface bends, which looks like stretching.
    """
    width, height = case.main.camera.size
    cell = max(1.0, width / shape[1], height / shape[0])
    limit = SHIFT_TOLERANCE_PX * cell
    if shift.std > limit / 2:
        raise CheckSkipped(f"a map of {shape[1]} x {shape[0]} is too coarse to see a shift")
    text = f"shifted by ({shift.x:+.2f}, {shift.y:+.2f}) px"
    found = max(abs(shift.x), abs(shift.y)) if case.knows == "seen" else shift.largest
    if found > limit:
        border = f"and by another ({shift.stretch_x:+.2f}, {shift.stretch_y:+.2f}) px at the border"
        raise CheckFailed(f"content is {text} of the view {border}; {limit:.2f} is allowed")
    return text


def accept_std(variance: Float32, expected_std: Float64) -> str:
    """Raise ``CheckFailed`` unless the variance is the square of what was reported."""
    factor = float(np.median(np.sqrt(variance.astype(np.float64)) / expected_std))
    if 1 / STD_FACTOR < factor < STD_FACTOR:
        return f"std {factor:.3f} times the reported one"
    if 1 / STD_FACTOR < float(np.median(variance / expected_std)) < STD_FACTOR:
        raise CheckFailed("the variance is the std itself: it has to be squared")
    raise CheckFailed(f"the std is {factor:.2g} times what the stand-in reports")


def accept_validity(valid: Bool, truth: Truth) -> str:
    """Raise ``CheckFailed`` where valid pixels show no surface, or surfaces are not valid."""
    empty, full = truth.edge_free & ~truth.valid, truth.smooth
    if not (empty.any() and full.any()):
        raise CheckSkipped("the map is too coarse to tell surfaces from sky")
    wrong, lost = float(valid[empty].mean()), float(1 - valid[full].mean())
    if wrong > VALIDITY_TOLERANCE:
        raise CheckFailed(f"{wrong:.0%} of the pixels without any surface are called valid")
    if lost > VALIDITY_TOLERANCE:
        raise CheckFailed(f"{lost:.0%} of the pixels with a surface are not valid")
    return f"{wrong:.1%} wrongly valid, {lost:.1%} lost"


def accept_calibration(case: Case, prior: DepthPrior | NormalPrior) -> None:
    """Raise ``CheckFailed`` if the declared calibration loses the variance or turns it round."""
    calibration = case.calibration()

    def total(given: DepthPrior | NormalPrior, scale: float = 1.0) -> Float32:
        changed = {"std_scale": scale * calibration.std_scale}
        values: Float32 = calibration.model_copy(update=changed).apply(given).variance[given.valid]
        if not (np.isfinite(values).all() and (values > 0).all()):
            raise CheckFailed("has a variance that is not finite and positive after calibration")
        return values

    if not (total(prior, 2.0) >= total(prior)).all():
        raise CheckFailed("a larger std_scale gives a smaller variance")
    if prior.variance is not None and calibration.use_network_variance and prior.valid.any():
        larger = replace(prior, variance=prior.variance * np.float32(100))
        if not (total(larger) > total(prior)).any():
            raise CheckFailed("a ten times larger network std changes nothing after calibration")


def painted_backwards(example: Example, shape: tuple[int, int]) -> NDArray[Any]:
    """The painted image with its channels in the wrong order, on the grid of a map."""
    return resize_map(example.view.image[..., ::-1], shape[1], shape[0])
