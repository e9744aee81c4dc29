"""Self-calibration decisions about guessed focal lengths that bundle adjustment estimates.

Bundle adjustment estimates log focal lengths with a normal prior, whose standard deviation depends
on the source of the guess (EXIF, a network, or a default). A camera takes the estimated focal
length if the observations determine it better than the prior, and if a lens of this focal length
exists. Cameras that keep the guess are fixed, and the remaining focal lengths are estimated again.
"""

from __future__ import annotations

from mpsfm_core.geometry.focal_length import is_plausible_equivalent
from mpsfm_core.mapping.scene.focal_outcome import FocalOutcome

MAX_STD_RATIO = 0.5
"""Ratio of posterior and prior standard deviation of a log focal length above which a camera keeps
the guess. At a ratio of 0.5, the observations add three times the information of the prior.
[ours]"""


def decide_focal_outcome(
    equivalent_mm: float, posterior_std: float, prior_std: float
) -> FocalOutcome:
    """Decide whether a camera takes its estimated focal length.

    Args:
        equivalent_mm: The estimated focal length as 35 mm equivalent.
        posterior_std: Posterior standard deviation of the log focal length, given observations and
            prior.
        prior_std: Prior standard deviation of the log focal length.
    """
    if not is_plausible_equivalent(equivalent_mm):
        return FocalOutcome.OUT_OF_RANGE
    if not posterior_std <= MAX_STD_RATIO * prior_std:
        return FocalOutcome.NOT_OBSERVABLE
    return FocalOutcome.REFINED
