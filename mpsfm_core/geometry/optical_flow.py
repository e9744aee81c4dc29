"""Tracking of points between two images by pyramidal Lucas-Kanade optical flow.

Source: Bouguet, Pyramidal Implementation of the Lucas Kanade Feature Tracker, 2000.
"""

from __future__ import annotations

import cv2
import numpy as np

from mpsfm_core.data import Bool, Float32, UInt8

_MAX_BACKWARD_ERROR_PX = 1.0
"""Maximum distance in pixels between a point and its position after tracking to the second image
and back. [ours]"""


def track_points(
    first: UInt8, second: UInt8, xy: Float32, predicted: Float32 | None = None
) -> tuple[Float32, Bool]:
    """Track points from the first gray image into the second, and back as a check.

    Args:
        first: Gray image (h, w) with the points.
        second: Gray image (h, w) in which the points are found.
        xy: Positions (n, 1, 2) in pixels of the first image, with the center of the first pixel at
            (0, 0).
        predicted: Positions (n, 1, 2) in the second image at which tracking starts; by default
            those in the first image.

    Returns:
        Positions (n, 1, 2) in the second image, and a mask (n,) of the tracked points. Tracked
        points may be outside of the second image.
    """
    flags = 0 if predicted is None else cv2.OPTFLOW_USE_INITIAL_FLOW
    there, found, _ = cv2.calcOpticalFlowPyrLK(first, second, xy, predicted, flags=flags)
    start = None if predicted is None else xy.copy()
    back, found_back, _ = cv2.calcOpticalFlowPyrLK(second, first, there, start, flags=flags)
    tracked: Bool = (found.ravel() > 0) & (found_back.ravel() > 0)
    tracked &= np.linalg.norm(back - xy, axis=2).ravel() < _MAX_BACKWARD_ERROR_PX
    return np.asarray(there, np.float32), tracked
