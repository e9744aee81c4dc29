"""Encode images as JPEG."""

from __future__ import annotations

import cv2

from mpsfm_core.data import UInt8

_QUALITY = 95
"""JPEG quality from 0 to 100, at which compression does not move keypoints. [ours]"""


def encode_jpeg(bgr: UInt8) -> bytes:
    """Encode BGR pixels (h, w, 3) as a JPEG file."""
    return cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])[1].tobytes()
