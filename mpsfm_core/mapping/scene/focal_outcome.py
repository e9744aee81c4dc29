"""Outcome of self-calibration: the decision about the guessed focal length of a camera."""

from __future__ import annotations

from enum import IntEnum

MIN_FOCAL_IMAGES = 3
"""Number of registered images from which guessed focal lengths are refined. [ours]"""


class FocalOutcome(IntEnum):
    """Decision of self-calibration about the camera of an image."""

    NOT_ESTIMATED = 0
    """The focal length is known, or bundle adjustment did not estimate it."""
    REFINED = 1
    """The camera has the estimated focal length."""
    NOT_OBSERVABLE = 2
    """The observations do not determine the focal length; the guess stays."""
    OUT_OF_RANGE = 3
    """The estimate is no plausible focal length; the guess stays."""
