"""Checks of mask providers. The masks of the examples leave out what has no surface: the sky."""

from __future__ import annotations

import numpy as np

from mpsfm_core.testing.accuracy import MASK_TOLERANCE, judge
from mpsfm_core.testing.case import Case
from mpsfm_core.testing.checks.maps import painted_backwards
from mpsfm_core.testing.outcome import CheckFailed
from mpsfm_core.testing.painting import read_depth


def check_mask_polarity(case: Case) -> str:
    """True is a pixel that may be used, False one that may not."""
    case.needs("painted", "told", "seen")
    answer, truth = case.ask(case.main), case.main.truth()
    agreement = float((answer == truth.valid)[truth.edge_free].mean())
    if agreement < MASK_TOLERANCE:
        raise CheckFailed(f"is inverted: {1 - agreement:.0%} of the pixels have the wrong value")
    return f"{agreement:.1%} of the pixels agree"


def check_mask_place(case: Case) -> str:
    """The mask covers the whole view at its place: it is not shifted, turned or of another part."""
    case.needs("painted", "told", "seen")
    return judge(case, case.main, case.ask(case.main))


def check_mask_channel_order(case: Case) -> None:
    """The network gets RGB, not BGR."""
    case.needs("painted")
    answer, truth = case.ask(case.main), case.main.truth()
    swapped = read_depth(painted_backwards(case.main, answer.shape)) > 0
    right, backwards = (
        float((answer == expected)[truth.edge_free].mean()) for expected in (truth.valid, swapped)
    )
    if right < 1 - MASK_TOLERANCE <= backwards:
        raise CheckFailed("follows the blue channel where it should follow the red one")


def check_mask_flip(case: Case) -> str:
    """The mirrored view has the mirrored mask."""
    answer, mirrored = case.ask(case.main), case.ask(case.main.mirror())
    where = case.main.truth().edge_free
    wrong = float((answer != np.asarray(mirrored)[:, ::-1])[where].mean())
    if wrong > MASK_TOLERANCE:
        raise CheckFailed(f"differs at {wrong:.0%} of the pixels of the mirrored view")
    return f"differs at {wrong:.1%} of the pixels"


CHECKS = (check_mask_polarity, check_mask_place, check_mask_channel_order, check_mask_flip)
