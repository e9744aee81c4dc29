"""One posed photo as the dense stage sees it: grey values and depth on one grid."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from mpsfm_core.data import Bool, DepthPrior, Float32, Float64, PinholeCamera, View
from mpsfm_core.dense.depth_posterior import UNKNOWN_LOG_STD
from mpsfm_core.geometry import resize_map
from mpsfm_core.mapping.scene.reconstruction import RegisteredImage


def dense_grid_size(size: tuple[int, int], longer_side: int) -> tuple[int, int]:
    """(width, height) of the grid for a photo of this size."""
    factor = min(1.0, longer_side / max(size))
    return max(2, round(size[0] * factor)), max(2, round(size[1] * factor))


@dataclass(frozen=True, eq=False)
class PosedGrid:
    """Where the pixels of a photo look: ``camera`` on its grid, ``rotation`` (3, 3) and
    ``translation`` (3,), ``cam_from_world``."""

    camera: PinholeCamera
    rotation: Float64
    translation: Float64

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return self.camera.height, self.camera.width

    def pixels_from(self, other: PosedGrid) -> tuple[Float64, Float64]:
        """``(turned, shift)``: pixel (x, y, 1) of ``other`` with depth d is here at the homogeneous
        pixel ``d * turned @ (x, y, 1) + shift``."""
        rotation = self.rotation @ other.rotation.T
        translation = self.translation - rotation @ other.translation
        matrix = self.camera.matrix
        return matrix @ rotation @ np.linalg.inv(other.camera.matrix), matrix @ translation


@dataclass(frozen=True, eq=False)
class DenseView(PosedGrid):
    """A photo on its grid.

    ``grey``: (h, w) float32 in [0, 1]. ``usable``: (h, w) bool, False where the photo is masked.
    ``log_depth``, ``log_std``: (h, w) float32, depth known before and its std, natural logarithm of
    world units; where nothing was known what was known around, with a std that says so.
    """

    grey: Float32
    usable: Bool
    log_depth: Float32
    log_std: Float32

    @classmethod
    def of(cls, image: RegisteredImage, view: View, max_size: int) -> DenseView:
        """A registered image with its photo, the longer side ``max_size`` at most."""
        rows, columns = view.image.shape[:2]
        width, height = dense_grid_size((columns, rows), max_size)
        grey = cv2.cvtColor(view.image, cv2.COLOR_RGB2GRAY)
        usable = np.ones((height, width), np.bool_)
        if view.mask is not None:
            usable = resize_map(view.mask, width, height, linear=False) > 0
        log_depth, log_std = resample_known_depth(image.depth, width, height)
        return cls(
            image.camera.resized(width, height),
            image.rotation,
            image.translation,
            resize_map(grey, width, height) / np.float32(255),
            usable,
            log_depth,
            log_std,
        )

    def reduced(self, factor: int) -> DenseView:
        """On a grid with so many times fewer rows and columns."""
        if factor == 1:
            return self
        width, height = (max(2, size // factor) for size in self.camera.size)
        return DenseView(
            self.camera.resized(width, height),
            self.rotation,
            self.translation,
            resize_map(self.grey, width, height),
            resize_map(self.usable, width, height, linear=False) > 0,
            resize_map(self.log_depth, width, height),
            resize_map(self.log_std, width, height),
        )

    @property
    def grid(self) -> PosedGrid:
        """Without the photo and what is known of its depth."""
        return PosedGrid(self.camera, self.rotation, self.translation)


def resample_known_depth(depth: DepthPrior, width: int, height: int) -> tuple[Float32, Float32]:
    """:attr:`DenseView.log_depth` and its std of a refined map, on a grid of this size.

    What lies between two samples of different surfaces is on neither: where the mean is further
    from the nearest sample than that may be off, the sample counts; beside holes it does too.
    """
    log_depth, log_std = _known(depth)
    smooth, smooth_std = (resize_map(each, width, height) for each in (log_depth, log_std))
    nearest, std = (resize_map(each, width, height, linear=False) for each in (log_depth, log_std))
    valid = resize_map(depth.valid.astype(np.float32), width, height)
    between = (np.abs(smooth - nearest) > std) | ((valid > 0) & (valid < 1))
    return np.where(between, nearest, smooth), np.where(between, std, smooth_std)


def _known(depth: DepthPrior) -> tuple[Float32, Float32]:
    assert depth.variance is not None  # a refined map always has one
    valid = depth.valid
    if not valid.any():
        zero = np.zeros(depth.shape, np.float32)
        return zero, zero + np.float32(UNKNOWN_LOG_STD)
    known = _without_holes(np.log(np.where(valid, depth.depth, 1)).astype(np.float32), valid)
    std = np.sqrt(depth.variance) / np.where(valid, depth.depth, 1)
    return known, np.where(valid, std, UNKNOWN_LOG_STD).astype(np.float32)


def _without_holes(values: Float32, valid: Bool) -> Float32:
    """The values (h, w), and where they are not valid the mean of what is valid around, taken as
    wide as the hole is."""
    if valid.all():
        return values
    width, height = ((size + 1) // 2 for size in values.shape[::-1])
    share = resize_map(valid.astype(np.float32), width, height)
    total = resize_map(np.where(valid, values, np.float32(0)), width, height)
    around = share > 0
    mean = (total / np.where(around, share, 1)).astype(np.float32)
    coarse = _without_holes(mean, around)
    return np.where(valid, values, resize_map(coarse, *values.shape[::-1]))
