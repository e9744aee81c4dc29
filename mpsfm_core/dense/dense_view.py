"""Views for multi-view stereo, with pose, gray values and the mapper's depth map."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from mpsfm_core.data import Bool, DepthPrior, Float32, Float64, PinholeCamera, View
from mpsfm_core.dense.depth_posterior import UNKNOWN_LOG_STD
from mpsfm_core.geometry import resize_map
from mpsfm_core.mapping.scene.reconstruction import RegisteredImage


def dense_grid_size(size: tuple[int, int], max_size: int) -> tuple[int, int]:
    """Compute the (width, height) of stereo depth maps, whose longer side is `max_size`."""
    factor = min(1.0, max_size / max(size))
    return max(2, round(size[0] * factor)), max(2, round(size[1] * factor))


@dataclass(frozen=True, eq=False)
class PosedGrid:
    """Pixel grid of a stereo depth map, with intrinsics and pose."""

    camera: PinholeCamera
    """Intrinsics in pixels of the stereo depth map."""
    rotation: Float64
    """(3, 3) rotation of the pose ``cam_from_world``."""
    translation: Float64
    """(3,) translation of the pose ``cam_from_world``, world units."""

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, columns)."""
        return self.camera.height, self.camera.width

    def pixels_from(self, source: PosedGrid) -> tuple[Float64, Float64]:
        """Compute the transformation of pixels with depth from another view to this view.

        Args:
            source: Grid of the other view, whose pixels (x, y) have z-depth d.

        Returns:
            Matrix (3, 3) and offset (3,) such that ``d * matrix @ (x, y, 1) + offset`` is a
            homogeneous pixel of this view.
        """
        rotation = self.rotation @ source.rotation.T
        translation = self.translation - rotation @ source.translation
        matrix = self.camera.matrix
        return matrix @ rotation @ np.linalg.inv(source.camera.matrix), matrix @ translation


@dataclass(frozen=True, eq=False)
class DenseView(PosedGrid):
    """Undistorted view and its refined depth map, resampled to the size of stereo depth maps."""

    gray: Float32
    """(h, w) gray values of the view in [0, 1]."""
    usable: Bool
    """(h, w) bool, False at pixels masked by the user or outside the undistorted image."""
    log_depth: Float32
    """(h, w) natural log of the input depth in world units; holes are filled from neighboring
    pixels."""
    log_std: Float32
    """(h, w) std of ``log_depth``, which is ``UNKNOWN_LOG_STD`` in holes."""

    @classmethod
    def from_view(cls, image: RegisteredImage, view: View, max_size: int) -> DenseView:
        """Resize a view and the depth map of its registered image to stereo resolution.

        Args:
            image: Registered image with pose and depth map.
            view: Undistorted view of the registered image.
            max_size: Maximum length of the longer side of stereo depth maps in pixels.
        """
        rows, columns = view.image.shape[:2]
        width, height = dense_grid_size((columns, rows), max_size)
        gray = cv2.cvtColor(view.image, cv2.COLOR_RGB2GRAY)
        usable = np.ones((height, width), np.bool_)
        if view.mask is not None:
            usable = resize_map(view.mask, width, height, linear=False) > 0
        log_depth, log_std = resample_known_depth(image.depth, width, height)
        return cls(
            image.camera.resized(width, height),
            image.rotation,
            image.translation,
            resize_map(gray, width, height) / np.float32(255),
            usable,
            log_depth,
            log_std,
        )

    def downsample(self, factor: int) -> DenseView:
        """Downsample images, depth and intrinsics of the view by a factor."""
        if factor == 1:
            return self
        width, height = (max(2, size // factor) for size in self.camera.size)
        return DenseView(
            self.camera.resized(width, height),
            self.rotation,
            self.translation,
            resize_map(self.gray, width, height),
            resize_map(self.usable, width, height, linear=False) > 0,
            resize_map(self.log_depth, width, height),
            resize_map(self.log_std, width, height),
        )

    @property
    def grid(self) -> PosedGrid:
        """Intrinsics and pose of the view, without gray values and depth."""
        return PosedGrid(self.camera, self.rotation, self.translation)


def resample_known_depth(depth: DepthPrior, width: int, height: int) -> tuple[Float32, Float32]:
    """Resample a depth map and its std of log depth to another resolution.

    Linear interpolation across a depth edge would give a depth on neither surface. Next to holes,
    and where interpolated and nearest depth differ by more than the std, the resampled depth is
    that of the nearest pixel.

    Args:
        depth: Refined depth map with variance.
        width: Number of columns of the resampled depth map.
        height: Number of rows of the resampled depth map.

    Returns:
        Natural log of depth and its std, both (h, w).
    """
    log_depth, log_std = _log_depth_and_std(depth)
    smooth, smooth_std = (resize_map(map_, width, height) for map_ in (log_depth, log_std))
    nearest, nearest_std = (
        resize_map(map_, width, height, linear=False) for map_ in (log_depth, log_std)
    )
    valid_ratio = resize_map(depth.valid.astype(np.float32), width, height)
    at_edge = (np.abs(smooth - nearest) > nearest_std) | ((valid_ratio > 0) & (valid_ratio < 1))
    return np.where(at_edge, nearest, smooth), np.where(at_edge, nearest_std, smooth_std)


def _log_depth_and_std(depth: DepthPrior) -> tuple[Float32, Float32]:
    """Return log depth (h, w) with filled holes, and the std (h, w) of log depth."""
    assert depth.variance is not None  # The mapper's refined depth maps always have a variance.
    valid = depth.valid
    if not valid.any():
        zero = np.zeros(depth.shape, np.float32)
        return zero, zero + np.float32(UNKNOWN_LOG_STD)
    log_depth = _fill_holes(np.log(np.where(valid, depth.depth, 1)).astype(np.float32), valid)
    std = np.sqrt(depth.variance) / np.where(valid, depth.depth, 1)
    return log_depth, np.where(valid, std, UNKNOWN_LOG_STD).astype(np.float32)


def _fill_holes(values: Float32, valid: Bool) -> Float32:
    """Fill invalid pixels by pull-push, with means over valid pixels on coarser grids."""
    if valid.all():
        return values
    width, height = ((size + 1) // 2 for size in values.shape[::-1])
    valid_ratio = resize_map(valid.astype(np.float32), width, height)
    total = resize_map(np.where(valid, values, np.float32(0)), width, height)
    coarse_valid = valid_ratio > 0
    mean = (total / np.where(coarse_valid, valid_ratio, 1)).astype(np.float32)
    coarse = _fill_holes(mean, coarse_valid)
    return np.where(valid, values, resize_map(coarse, *values.shape[::-1]))
