"""Encode images, depth maps and normal maps as data URIs for the report page."""

from __future__ import annotations

import base64
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from mpsfm_core.data import Bool, Float32, UInt8

_QUALITY = 76
"""WebP quality."""
_EMPTY_BGR = (40, 36, 34)
"""Color of pixels without a value in pictures of maps."""


def photo(picture: UInt8, side: int) -> str:
    """Encode a BGR image as a data URI with a longer side of at most ``side`` pixels."""
    return _encode(_reduced(picture, side, cv2.INTER_AREA))


def depth_map(depth: Float32, valid: Bool, near_far: tuple[float, float], side: int) -> str:
    """Encode a depth map in colors from red (near) to blue (far), linear in inverse depth."""
    near, far = near_far
    inverse = 1 / np.where(valid, depth, 1)
    share = (inverse - 1 / far) / max(1 / near - 1 / far, 1e-12)
    return _coloured(share, valid, cv2.COLORMAP_TURBO, side)


def std_map(relative_std: Float32, valid: Bool, max_std: float, side: int) -> str:
    """Encode a map of relative depth std in colors from dark (0) to bright (``max_std``)."""
    return _coloured(relative_std / max(max_std, 1e-12), valid, cv2.COLORMAP_INFERNO, side)


def normal_map(normals: Float32, valid: Bool, side: int) -> str:
    """Encode a normal map in colors, with right red, up green, and toward the camera blue."""
    rgb = (normals * np.array([1, -1, -1], np.float32) + 1) * 127.5
    bgr = np.clip(rgb[..., ::-1], 0, 255).astype(np.uint8)
    bgr[~valid] = _EMPTY_BGR
    return _encode(_reduced(bgr, side, cv2.INTER_AREA))


def range_of(depth: Float32, valid: Bool) -> tuple[float, float]:
    """Return the 2nd and 98th percentiles of valid depth, (1, 1) without valid pixels."""
    if not valid.any():
        return 1.0, 1.0
    near, far = np.percentile(depth[valid], [2, 98])
    return float(near), float(far)


def _coloured(share: NDArray[Any], valid: Bool, colormap: int, side: int) -> str:
    grey = (255 * np.clip(np.where(valid, share, 0), 0, 1)).astype(np.uint8)
    bgr = np.asarray(cv2.applyColorMap(grey, colormap), np.uint8)
    bgr[~valid] = _EMPTY_BGR
    return _encode(_reduced(bgr, side, cv2.INTER_AREA))


def _reduced(picture: UInt8, side: int, how: int) -> UInt8:
    height, width = picture.shape[:2]
    factor = side / max(width, height)
    if factor >= 1:
        return picture
    size = max(1, round(width * factor)), max(1, round(height * factor))
    return np.asarray(cv2.resize(picture, size, interpolation=how), np.uint8)


def _encode(bgr: UInt8) -> str:
    data = cv2.imencode(".webp", bgr, [cv2.IMWRITE_WEBP_QUALITY, _QUALITY])[1].tobytes()
    return "data:image/webp;base64," + base64.b64encode(data).decode("ascii")
