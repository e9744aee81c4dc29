"""Outcome of self-calibration for the guessed focal length of a camera."""

from __future__ import annotations

from enum import IntEnum

MIN_FOCAL_IMAGES = 3
"""Number of registered images from which guessed focal lengths are refined. [ours]"""


class FocalOutcome(IntEnum):
    """Decision of self-calibration about the focal length of a camera."""

    NOT_ESTIMATED = 0
    """The focal length is known, or bundle adjustment did not estimate it."""
    REFINED = 1
    """The camera takes the focal length that bundle adjustment estimated."""
    NOT_OBSERVABLE = 2
    """The observations do not determine the focal length, so the camera keeps the guess."""
    OUT_OF_RANGE = 3
    """The estimated focal length is not plausible, so the camera keeps the guess."""
