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
"""Allowed deviation of a normal's length from 1 (float16 storage keeps about 5e-4)."""


@dataclass(frozen=True, eq=False)
class DepthPrior:
    """A depth map with its uncertainty on a grid of any size that covers the whole view.

    ``depth``: (h, w) float32, z along the optical axis, > 0 where valid; metres if ``metric``,
    else in an unknown unit. ``variance``: (h, w) float32 in depth units squared, > 0 where valid,
    or None when the network gives none (a calibration then declares it). ``valid``: (h, w) bool.
    Values at invalid pixels are finite and meaningless.
    """

    depth: Float32
    variance: Float32 | None
    valid: Bool
    metric: bool = True

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
        """Build from raw arrays: pixels that are not finite and positive become invalid (0)."""
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
        """``(rows, columns)`` of the map's grid."""
        return self.depth.shape[0], self.depth.shape[1]


@dataclass(frozen=True, eq=False)
class NormalPrior:
    """A surface normal map with its uncertainty on a grid of any size that covers the view.

    ``normals``: (h, w, 3) float32, unit, camera frame, where valid. They face the camera: their
    dot product with the ray through the pixel is negative (off the axis ``n_z`` may be positive,
    as on a floor at the lower border). The constructor knows no camera, so the validator checks
    that. ``variance``: (h, w) float32, rad^2, the angular variance along each of the two tangent
    directions, > 0 where valid, or None when the network gives none. ``valid``: (h, w) bool.
    """

    normals: Float32
    variance: Float32 | None
    valid: Bool

    def __post_init__(self) -> None:
        require_array(self, "normals", np.float32, (None, None, 3))
        shape = self.normals.shape[:2]
        require_array(self, "valid", np.bool_, shape)
        require_finite(self, "normals")
        length = np.linalg.norm(self.normals[self.valid], axis=-1)
        if length.size and np.abs(length - 1).max() > UNIT_NORMAL_TOLERANCE:
            raise DataError("normals", "must have unit length where valid")
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
        """Build from raw arrays: normalises lengths; pixels that are not finite or have no length
        become invalid (0), and with the view's ``camera`` those that do not face it."""
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
        """``(rows, columns)`` of the map's grid."""
        return self.normals.shape[0], self.normals.shape[1]


@dataclass(frozen=True, eq=False)
class PairDepth:
    """Depth of both views of a pair as a two-view network sees it (MASt3R-style)."""

    depth_a: DepthPrior
    depth_b: DepthPrior


@dataclass(frozen=True, eq=False)
class MultiViewPrior:
    """What a multi-view network sees in a group of n views: all of it in one frame and one unit.

    ``depth``: one prior a view, in the order of the views. They share one unit: metres if
    ``metric``, else an unknown one. ``poses``: (n, 3, 4) float64, ``cam_from_group`` of each view
    for a frame of the group's own, lengths in the unit of depth; or None. ``intrinsics``: (n, 4)
    float64, fx, fy, cx, cy in COLMAP pixels of each view, or None. Both are proposals, which
    matches judge.
    """

    depth: tuple[DepthPrior, ...]
    poses: Float64 | None = None
    intrinsics: Float64 | None = None

    def __post_init__(self) -> None:
        count = len(self.depth)
        if len({prior.metric for prior in self.depth}) > 1:
            raise DataError("depth", "must be metric in all views of a group or in none")
        if self.poses is not None:
            require_array(self, "poses", np.float64, (count, 3, 4))
            require_finite(self, "poses")
            rotations = self.poses[:, :, :3]
            if not np.allclose(rotations @ rotations.transpose(0, 2, 1), np.eye(3), atol=1e-3):
                raise DataError("poses", "must be rotations and translations (n, 3, 4)")
            if (np.linalg.det(rotations) < 0).any():
                raise DataError("poses", "must not mirror")
        if self.intrinsics is not None:
            require_array(self, "intrinsics", np.float64, (count, 4))
            require_finite(self, "intrinsics")
            if (self.intrinsics[:, :2] <= 0).any():
                raise DataError("intrinsics", "must have positive focal lengths")
