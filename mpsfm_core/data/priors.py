"""Monocular, pairwise and multi-view priors that providers return."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mpsfm_core.data.arrays import (
    Bool,
    Float32,
    Float64,
    require_array,
    require_finite,
    require_positive_where_valid,
)
from mpsfm_core.data.cameras import PinholeCamera, dot_with_rays
from mpsfm_core.data.errors import DataError

UNIT_NORMAL_TOLERANCE = 1e-3
"""Maximum deviation of a normal's length from 1; rounding to float16 is about 5e-4."""


@dataclass(frozen=True, eq=False)
class DepthPrior:
    """Depth map with variance, at any resolution of the whole undistorted image.

    Depth and variance at invalid pixels are finite but meaningless.
    """

    depth: Float32
    """(h, w) float32 z-depth, > 0 at valid pixels, in meters if ``metric``, else in any unit."""
    variance: Float32 | None
    """(h, w) float32 variance of depth in squared depth units, > 0 where valid.

    If the network predicts no variance, the attribute is None and a calibration provides the
    variance later."""
    valid: Bool
    """(h, w) bool, True where depth is valid."""
    metric: bool = True
    """True if the unit of depth is meters."""

    def __post_init__(self) -> None:
        require_array(self, "depth", np.float32, (None, None))
        shape = self.depth.shape
        require_array(self, "valid", np.bool_, shape)
        require_finite(self, "depth")
        require_positive_where_valid(self.depth, self.valid, "depth")
        if self.variance is not None:
            require_array(self, "variance", np.float32, shape)
            require_finite(self, "variance")
            require_positive_where_valid(self.variance, self.valid, "variance")

    @classmethod
    def from_arrays(
        cls,
        depth: NDArray[Any],
        variance: NDArray[Any] | None = None,
        valid: NDArray[Any] | None = None,
        *,
        metric: bool = True,
    ) -> DepthPrior:
        """Build a depth prior from arrays; pixels without finite positive depth become invalid.

        Args:
            depth: (h, w) z-depth, any number type.
            variance: (h, w) variance of depth in squared depth units, or None.
            valid: (h, w) mask of valid pixels, or None for all True.
            metric: True if the unit of depth is meters.
        """
        depth = np.asarray(depth, dtype=np.float32)
        usable = np.isfinite(depth) & (depth > 0)
        if valid is not None:
            usable &= np.asarray(valid, dtype=np.bool_)
        if variance is not None:
            variance = np.asarray(variance, dtype=np.float32)
            usable &= np.isfinite(variance) & (variance > 0)
            variance = np.where(usable, variance, np.float32(0))
        return cls(np.where(usable, depth, np.float32(0)), variance, usable, metric)

    @property
    def shape(self) -> tuple[int, int]:
        """Number of (rows, columns) of the depth or normal map."""
        return self.depth.shape[0], self.depth.shape[1]


@dataclass(frozen=True, eq=False)
class NormalPrior:
    """Surface normal map with variance, at any resolution of the whole undistorted image.

    Normals face the camera, so the dot product of a normal with the ray of its pixel is negative.
    The component ``n_z`` of a normal may be positive off the optical axis, for example on a floor.
    :mod:`mpsfm_core.providers.validation` checks that normals face the camera, because the
    constructor has no camera.

    Examples:
        >>> prior = NormalPrior.from_arrays(np.tile([0.0, 0.0, -2.0], (2, 3, 1)))
        >>> prior.normals[0, 0].tolist()
        [0.0, 0.0, -1.0]
    """

    normals: Float32
    """(h, w, 3) float32 surface normals in the camera frame, unit length where valid."""
    variance: Float32 | None
    """(h, w) float32 angular variance in rad^2 along each tangent direction, > 0 where valid.

    The attribute is None if the network predicts no variance of normals."""
    valid: Bool
    """(h, w) bool, True where the normal is valid."""

    def __post_init__(self) -> None:
        require_array(self, "normals", np.float32, (None, None, 3))
        shape = self.normals.shape[:2]
        require_array(self, "valid", np.bool_, shape)
        require_finite(self, "normals")
        length = np.linalg.norm(self.normals[self.valid], axis=-1)
        if length.size and np.abs(length - 1).max() > UNIT_NORMAL_TOLERANCE:
            raise DataError("normals", "normals must have unit length at valid pixels")
        if self.variance is not None:
            require_array(self, "variance", np.float32, shape)
            require_finite(self, "variance")
            require_positive_where_valid(self.variance, self.valid, "variance")

    @classmethod
    def from_arrays(
        cls,
        normals: NDArray[Any],
        variance: NDArray[Any] | None = None,
        valid: NDArray[Any] | None = None,
        *,
        camera: PinholeCamera | None = None,
    ) -> NormalPrior:
        """Build a normal prior from arrays and normalize the normals.

        Normals that are not finite or have zero length become invalid. With a camera, normals that
        face away from the camera also become invalid.

        Args:
            normals: (h, w, 3) normals in the camera frame, any number type and length.
            variance: (h, w) angular variance of the normals in rad^2, or None.
            valid: (h, w) mask of valid pixels, or None for all True.
            camera: Intrinsics of the view, for the test whether normals face the camera (None omits
                the test).
        """
        raw = np.asarray(normals, dtype=np.float32)
        finite = np.where(np.isfinite(raw).all(axis=-1, keepdims=True), raw, np.float32(0))
        length = np.linalg.norm(finite, axis=-1)
        usable = length > 1e-6
        if camera is not None:
            usable &= dot_with_rays(camera, finite) < 0
        if valid is not None:
            usable &= np.asarray(valid, dtype=np.bool_)
        if variance is not None:
            variance = np.asarray(variance, dtype=np.float32)
            usable &= np.isfinite(variance) & (variance > 0)
            variance = np.where(usable, variance, np.float32(0))
        unit = finite / np.where(usable, length, np.float32(1))[..., None]
        return cls(np.where(usable[..., None], unit, np.float32(0)), variance, usable)

    @property
    def shape(self) -> tuple[int, int]:
        """Number of (rows, columns) of the depth or normal map."""
        return self.normals.shape[0], self.normals.shape[1]


@dataclass(frozen=True, eq=False)
class PairDepth:
    """Depth of both views of a pair from a two-view network such as MASt3R.

    Examples:
        >>> depth = DepthPrior.from_arrays(np.full((2, 3), 4.0), metric=False)
        >>> PairDepth(depth, depth).depth_b.shape
        (2, 3)
    """

    depth_a: DepthPrior
    """Depth prior of the first view."""
    depth_b: DepthPrior
    """Depth prior of the second view."""


@dataclass(frozen=True, eq=False)
class MultiViewPrior:
    """Output of a multi-view network for a group of n views, in a common frame and unit.

    The mapper tests the predicted poses and intrinsics with verified matches before use.
    """

    depth: tuple[DepthPrior, ...]
    """One depth prior for each of the n views, all in the same unit, which is meters if
    ``metric``."""
    poses: Float64 | None = None
    """(n, 3, 4) float64 poses ``cam_from_group`` in the unit of the depth priors, or None."""
    intrinsics: Float64 | None = None
    """(n, 4) float64 intrinsics fx, fy, cx, cy of each view in COLMAP pixels, or None."""

    def __post_init__(self) -> None:
        count = len(self.depth)
        if len({prior.metric for prior in self.depth}) > 1:
            raise DataError(
                "depth", "depth priors must be metric in all views of a group or in none"
            )
        if self.poses is not None:
            require_array(self, "poses", np.float64, (count, 3, 4))
            require_finite(self, "poses")
            rotations = self.poses[:, :, :3]
            if not np.allclose(rotations @ rotations.transpose(0, 2, 1), np.eye(3), atol=1e-3):
                raise DataError("poses", "poses must be rotations and translations (n, 3, 4)")
            if (np.linalg.det(rotations) < 0).any():
                raise DataError("poses", "must not mirror")
        if self.intrinsics is not None:
            require_array(self, "intrinsics", np.float64, (count, 4))
            require_finite(self, "intrinsics")
            if (self.intrinsics[:, :2] <= 0).any():
                raise DataError("intrinsics", "cameras must have positive focal lengths")
