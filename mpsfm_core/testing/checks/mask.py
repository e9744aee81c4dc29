"""Contract checks of mask providers.

The true masks of the synthetic views exclude the sky, where there is no surface.
"""

from __future__ import annotations

import numpy as np

from mpsfm_core.testing.accuracy import MASK_TOLERANCE, compare_with_truth
from mpsfm_core.testing.checks.maps import swap_painted_channels
from mpsfm_core.testing.contract_case import ContractCase
from mpsfm_core.testing.examples import indoor_example
from mpsfm_core.testing.outcome import CheckFailed
from mpsfm_core.testing.painted_views import read_depth

_MIN_USABLE_ROOM = 0.7
"""Smallest accepted ratio of usable pixels in a view without sky. Simple rules take bright surfaces
for sky."""


def check_mask_polarity(case: ContractCase) -> str:
    """Require a mask that is True for usable pixels and False for the sky.

    In a view of a room, which shows no sky, most pixels are usable.
    """
    case.require_truth("painted", "prepared", "image")
    answer, truth = case.run(case.example), case.example.truth()
    agreement = float((answer == truth.valid)[truth.edge_free].mean())
    if agreement < MASK_TOLERANCE:
        raise CheckFailed(
            f"the mask is inverted: {1 - agreement:.0%} of the pixels have the wrong value"
        )
    room = float(np.mean(case.run(indoor_example(case.example.look))))
    if room < _MIN_USABLE_ROOM:
        raise CheckFailed(f"only {room:.0%} of the pixels of a room are usable")
    return f"{agreement:.1%} of the pixels agree"


def check_mask_place(case: ContractCase) -> str:
    """Require that the mask covers the whole view without a shift.

    Shifted, rotated and cropped masks fail the check. A second view shows mostly sky.
    """
    case.require_truth("painted", "prepared", "image")
    width, height = case.example.camera.size
    sky = case.example.crop(0, -height // 2, width, height)
    compare_with_truth(case, sky, case.run(sky))
    return compare_with_truth(case, case.example, case.run(case.example))


def check_mask_channel_order(case: ContractCase) -> None:
    """Require that the network receives RGB, not BGR."""
    case.require_truth("painted")
    answer, truth = case.run(case.example), case.example.truth()
    swapped = read_depth(swap_painted_channels(case.example, answer.shape)) > 0
    right, backwards = (
        float((answer == expected)[truth.edge_free].mean()) for expected in (truth.valid, swapped)
    )
    if right < 1 - MASK_TOLERANCE <= backwards:
        raise CheckFailed(
            "the network receives BGR instead of RGB: the output follows the blue channel"
        )


def check_mask_flip(case: ContractCase) -> str:
    """Require the mirrored mask for the mirrored view."""
    answer, mirrored = case.run(case.example), case.run(case.example.mirror())
    where = case.example.truth().edge_free
    wrong = float((answer != np.asarray(mirrored)[:, ::-1])[where].mean())
    if wrong > MASK_TOLERANCE:
        raise CheckFailed(f"the mask of the mirrored view differs at {wrong:.0%} of the pixels")
    return f"differs at {wrong:.1%} of the pixels"


CHECKS = (check_mask_polarity, check_mask_place, check_mask_channel_order, check_mask_flip)
