"""Intrinsic parameters that self-calibration estimates, with std and decision of each image."""

from __future__ import annotations

from enum import IntEnum
from typing import NamedTuple

import numpy as np

from mpsfm_core.data import Bool, Float64, Int64
from mpsfm_core.data.camera_models import IntrinsicParameter
from mpsfm_core.mapping.state import StateDict

MIN_FOCAL_IMAGES = 3
"""Minimum number of registered images for the refinement of guessed intrinsics. [ours]"""


class CalibrationOutcome(IntEnum):
    """Decision of self-calibration about an intrinsic parameter of a camera."""

    NOT_ESTIMATED = 0
    """The intrinsic parameter is known, or bundle adjustment did not estimate the parameter."""
    REFINED = 1
    """The camera takes the value that bundle adjustment estimated for the intrinsic parameter."""
    NOT_OBSERVABLE = 2
    """The observations do not determine the intrinsic parameter, so the camera keeps the guess."""
    OUT_OF_RANGE = 3
    """The estimated intrinsic parameter is not plausible, so the camera keeps the guess."""


class IntrinsicEstimate(NamedTuple):
    """Estimate of one intrinsic parameter of a camera by bundle adjustment."""

    outcome: CalibrationOutcome = CalibrationOutcome.NOT_ESTIMATED
    value: float = float("nan")
    """Estimated value of the parameter, even if implausible, or NaN without an estimate."""
    std: float = float("nan")
    """Posterior standard deviation of the parameter (of the log focal length), or NaN without an
    estimate."""


class PredictedErrors(NamedTuple):
    """Predicted root mean square errors of all images of a scene, NaN without a prediction.

    See :func:`~mpsfm_core.optimize.calibration_errors.predict_calibration_errors`.
    """

    pose_deg: Float64
    """(n,) relative pose error of each image in degrees."""
    stds: Float64
    """(n, p) error of each :class:`IntrinsicParameter` of each image, 0 for known cameras."""

    @classmethod
    def unknown(cls, num_images: int) -> PredictedErrors:
        """Return NaN for the predicted pose and intrinsics errors of ``num_images`` images."""
        return cls(
            np.full(num_images, np.nan), np.full((num_images, len(IntrinsicParameter)), np.nan)
        )


class EstimatedIntrinsics:
    """Estimates of all intrinsic parameters of all images.

    Args:
        num_images: Number of images of the mapping problem.

    Attributes:
        outcomes: (n, p) int64 :class:`CalibrationOutcome` of each parameter of each image.
        values: (n, p) float64 estimated value of each parameter, NaN without an estimate.
        stds: (n, p) float64 posterior standard deviation of each parameter, NaN without an
            estimate.
    """

    def __init__(self, num_images: int) -> None:
        shape = num_images, len(IntrinsicParameter)
        self.outcomes: Int64 = np.zeros(shape, dtype=np.int64)
        self.values: Float64 = np.full(shape, np.nan)
        self.stds: Float64 = np.full(shape, np.nan)

    def get(self, image: int, parameter: IntrinsicParameter) -> IntrinsicEstimate:
        """Return the estimate of a parameter of an image."""
        return IntrinsicEstimate(
            CalibrationOutcome(int(self.outcomes[image, parameter])),
            float(self.values[image, parameter]),
            float(self.stds[image, parameter]),
        )

    def set(self, images: Bool, parameter: IntrinsicParameter, estimate: IntrinsicEstimate) -> None:
        """Record the estimate of a parameter for the images (n,) of a camera, given as a mask."""
        self.outcomes[images, parameter] = estimate.outcome
        self.values[images, parameter] = estimate.value
        self.stds[images, parameter] = estimate.std

    def is_refined(self, parameter: IntrinsicParameter) -> Bool:
        """Return a bool mask (n,) of the images with a refined parameter."""
        refined: Bool = self.outcomes[:, parameter] == CalibrationOutcome.REFINED
        return refined

    def state_dict(self) -> StateDict:
        """Return a copy of all estimates."""
        return {name: array.copy() for name, array in vars(self).items()}

    def load_state_dict(self, state: StateDict) -> None:
        """Restore a copy of all estimates from :meth:`state_dict`."""
        vars(self).update({name: state[name].copy() for name in vars(self)})
