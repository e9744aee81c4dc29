"""Intrinsic parameters that bundle adjustment estimates, and COLMAP's camera models of them."""

from __future__ import annotations

from enum import Enum, IntEnum

import numpy as np

from mpsfm_core.data.arrays import Bool, Float64


class IntrinsicParameter(IntEnum):
    """Intrinsic parameter of a camera that bundle adjustment estimates.

    A member is a column of arrays (k, 8) of bundle adjustment and self-calibration. Its lower-case
    name is its key in ``summary.json``.
    """

    FOCAL_LENGTH = 0
    """``log fx`` in bundle adjustment, whose change keeps ``fy / fx``."""
    ASPECT_RATIO = 1
    """``log(fy / fx)`` in bundle adjustment."""
    PRINCIPAL_POINT_X = 2
    """``cx`` in pixels."""
    PRINCIPAL_POINT_Y = 3
    """``cy`` in pixels."""
    RADIAL_DISTORTION = 4
    """``k1``, the coefficient of SIMPLE_RADIAL."""
    DISTORTION_2 = 5
    """``k2``."""
    DISTORTION_3 = 6
    """``p1`` of OPENCV, ``k3`` of OPENCV_FISHEYE."""
    DISTORTION_4 = 7
    """``p2`` of OPENCV, ``k4`` of OPENCV_FISHEYE."""


NUM_INTRINSICS = len(IntrinsicParameter)
"""Number of intrinsic parameters of a camera."""
NUM_DISTORTION = NUM_INTRINSICS - IntrinsicParameter.RADIAL_DISTORTION
"""Number of distortion coefficients of a camera."""
Distortion = tuple[float, float, float, float]
"""Coefficients k1, k2, p1, p2 of OPENCV, or k1, k2, k3, k4 of OPENCV_FISHEYE."""
NO_DISTORTION: Distortion = (0.0, 0.0, 0.0, 0.0)
"""Distortion coefficients of a pinhole camera."""


def to_distortion(coefficients: Float64) -> Distortion:
    """Convert distortion coefficients (4,) to a tuple."""
    first, second, third, fourth = map(float, coefficients)
    return first, second, third, fourth


def intrinsic_parameters(intrinsics: Float64, distortion: Float64 | None) -> Float64:
    """Convert intrinsics to the columns of :class:`IntrinsicParameter`.

    Args:
        intrinsics: (k, 4) camera parameters fx, fy, cx, cy in pixels.
        distortion: (k, 4) distortion coefficients (None uses 0).

    Returns:
        (k, 8) intrinsic parameters.
    """
    fx, fy = intrinsics[:, 0], intrinsics[:, 1]
    coefficients = np.zeros((len(intrinsics), NUM_DISTORTION)) if distortion is None else distortion
    return np.column_stack([np.log(fx), np.log(fy / fx), intrinsics[:, 2:], coefficients])


class CameraModel(str, Enum):
    """COLMAP camera model whose parameters self-calibration estimates."""

    SIMPLE_PINHOLE = "SIMPLE_PINHOLE"
    PINHOLE = "PINHOLE"
    SIMPLE_RADIAL = "SIMPLE_RADIAL"
    RADIAL = "RADIAL"
    OPENCV = "OPENCV"
    OPENCV_FISHEYE = "OPENCV_FISHEYE"

    @property
    def num_distortion(self) -> int:
        """Number of distortion coefficients."""
        return {"SIMPLE_RADIAL": 1, "RADIAL": 2, "OPENCV": 4, "OPENCV_FISHEYE": 4}.get(
            self.value, 0
        )

    @property
    def has_aspect(self) -> bool:
        """True if the model has two focal lengths ``fx`` and ``fy``."""
        return self.value in ("PINHOLE", "OPENCV", "OPENCV_FISHEYE")

    @property
    def is_fisheye(self) -> bool:
        """True if the model projects angles instead of slopes of rays."""
        return self is CameraModel.OPENCV_FISHEYE

    def free_parameters(self, *, principal_point: bool = False) -> Bool:
        """Return the mask (8,) of the intrinsic parameters that the model estimates.

        Args:
            principal_point: Include the principal point.
        """
        free = np.zeros(NUM_INTRINSICS, dtype=np.bool_)
        free[IntrinsicParameter.FOCAL_LENGTH] = True
        free[IntrinsicParameter.ASPECT_RATIO] = self.has_aspect
        free[[IntrinsicParameter.PRINCIPAL_POINT_X, IntrinsicParameter.PRINCIPAL_POINT_Y]] = (
            principal_point
        )
        first = IntrinsicParameter.RADIAL_DISTORTION
        free[first : first + self.num_distortion] = True
        return free

    def to_params(self, intrinsics: Float64, distortion: Float64) -> list[float]:
        """Convert intrinsics to COLMAP's parameters; a single focal length takes ``fx``.

        Args:
            intrinsics: (4,) camera parameters fx, fy, cx, cy in pixels.
            distortion: (4,) distortion coefficients.
        """
        fx, fy, *center = map(float, intrinsics)
        focals = [fx, fy] if self.has_aspect else [fx]
        return [*focals, *center, *map(float, distortion[: self.num_distortion])]

    def from_params(self, params: Float64) -> tuple[Float64, Float64]:
        """Convert COLMAP's parameters of the model to (fx, fy, cx, cy) and (4,) coefficients."""
        num_focals = 2 if self.has_aspect else 1
        intrinsics = np.concatenate([params[:1], params[num_focals - 1 : num_focals + 2]])
        distortion = np.zeros(NUM_DISTORTION)
        distortion[: self.num_distortion] = params[num_focals + 2 :]
        return intrinsics, distortion
