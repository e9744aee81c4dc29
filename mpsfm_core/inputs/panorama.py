"""Detection of panoramas by XMP data, and of equirectangular panoramas by their pixels."""

from __future__ import annotations

import numpy as np

from mpsfm_core.data import UInt8
from mpsfm_core.inputs.image_header import ImageHeader

_MAX_SEAM_RATIO = 2.0
"""Largest ratio of the difference across the seam to the difference of adjacent columns [ours]."""
_MAX_POLE_RATIO = 0.5
"""Largest ratio of the contrast in the rows at the poles to the median contrast of a row [ours]."""
_MIN_COLUMN_RATIO = 0.25
"""Smallest ratio of the contrast along the seam to the contrast of the image, which excludes
objects in front of a uniform background [ours]."""


def find_projection(header: ImageHeader, gray: UInt8 | None) -> str | None:
    """Return the projection of a panorama, or None for other images.

    Args:
        header: Header of the image.
        gray: (h, w) uint8 gray image, which may be reduced, or None if unknown.
    """
    if header.projection is None and gray is not None and is_equirectangular(gray):
        return "equirectangular, by its pixels"
    return header.projection


def has_panorama_size(width: int, height: int) -> bool:
    """Return True if an image is twice as wide as high, up to one pixel."""
    return abs(width - 2 * height) <= 1


def is_equirectangular(gray: UInt8) -> bool:
    """Return True if an image is an equirectangular panorama of 360 x 180 degrees.

    An equirectangular panorama is twice as wide as high, its left and right columns are adjacent on
    the sphere, and its first and last rows are the poles, which have little contrast.

    Args:
        gray: (h, w) uint8 gray image, which may be reduced.
    """
    height, width = gray.shape
    if height < 8 or not has_panorama_size(width, height):
        return False
    pixels = gray.astype(np.float64)
    inner = np.mean(np.abs(np.diff(pixels[:, [0, 1, -2, -1]], axis=1)[:, [0, 2]]))
    seam = np.mean(np.abs(pixels[:, 0] - pixels[:, -1]))
    row_contrast = pixels.std(axis=1)
    poles = max(row_contrast[0], row_contrast[-1])
    has_contrast = pixels[:, 0].std() >= _MIN_COLUMN_RATIO * pixels.std() > 0
    return bool(
        has_contrast
        and seam <= _MAX_SEAM_RATIO * inner
        and poles <= _MAX_POLE_RATIO * np.median(row_contrast)
    )
