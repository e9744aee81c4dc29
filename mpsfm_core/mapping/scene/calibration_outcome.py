"""Outcome of self-calibration for the guessed intrinsics of a camera."""

from __future__ import annotations

from enum import IntEnum

MIN_FOCAL_IMAGES = 3
"""Minimum number of registered images for the refinement of guessed intrinsics. [ours]"""


class CalibrationOutcome(IntEnum):
    """Decision of self-calibration about the focal length or radial distortion of a camera."""

    NOT_ESTIMATED = 0
    """The intrinsic parameter is known, or bundle adjustment did not estimate the parameter."""
    REFINED = 1
    """The camera takes the value that bundle adjustment estimated for the intrinsic parameter."""
    NOT_OBSERVABLE = 2
    """The observations do not determine the intrinsic parameter, so the camera keeps the guess."""
    OUT_OF_RANGE = 3
    """The estimated intrinsic parameter is not plausible, so the camera keeps the guess."""
