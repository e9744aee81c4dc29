"""Holes of a depth map that its unmeasured depth closes.

Multi-view stereo measures no depth on plain surfaces, where the depth map only contains the
corrected depth prior. A narrow part of a hole is closed if another image confirms most of its
outline, and the depth continues from the outline without a depth edge. Sky and background behind
the outline of an object stay open, and so do pixels whose depth std is unknown, because nothing in
other images matches them.
"""

from __future__ import annotations

import math

import cv2
import numpy as np

from mpsfm_core.data import Bool, DepthPrior
from mpsfm_core.dense.depth_edges import depth_steps
from mpsfm_core.dense.depth_posterior import UNKNOWN_LOG_STD

MAX_STEP = 0.02
"""Maximum relative step of inverse depth in a closed hole [tuned: benchmarks.street]."""
_STEP_RADIUS = 3
"""Radius in pixels of the window in which a closed hole has no depth edge, as of stereo windows."""
_MIN_MEASURED_OUTLINE = 0.5
"""Minimum ratio of measured pixels next to the outline of a hole [tuned: benchmarks.street]."""
_NEIGHBORHOOD = np.ones((3, 3), np.uint8)


def find_closable_holes(depth: DepthPrior, measured: Bool, max_width_px: float) -> Bool:
    """Find the pixels of narrow holes in which the depth map continues the measured surface.

    Args:
        depth: Depth map (h, w).
        measured: (h, w) mask of the pixels whose depth another image confirms.
        max_width_px: Maximum width of a closed part of a hole, in pixels of the depth map.

    Returns:
        Mask (h, w) of the pixels in closed holes.
    """
    log_depth = np.log(np.where(depth.valid, depth.depth, 1)).astype(np.float32)
    assert depth.variance is not None  # The mapper's refined depth maps always have a variance.
    smooth = depth.valid & (depth_steps(log_depth, _STEP_RADIUS) <= MAX_STEP)
    known = depth.variance < (UNKNOWN_LOG_STD * depth.depth) ** 2
    hole = _close(measured, max_width_px / 2) & ~measured & smooth & known
    count, labels = cv2.connectedComponents(hole.astype(np.uint8), connectivity=4)
    border = hole & (cv2.erode(hole.astype(np.uint8), _NEIGHBORHOOD, borderValue=0) == 0)
    outline = cv2.dilate((measured & smooth).astype(np.uint8), _NEIGHBORHOOD) > 0
    border_length = np.bincount(labels[border], minlength=count)
    measured_length = np.bincount(labels[border & outline], minlength=count)
    closed: Bool = hole & (measured_length > _MIN_MEASURED_OUTLINE * border_length)[labels]
    return closed


def _close(mask: Bool, radius: float) -> Bool:
    """Return the morphological closing of a mask by a disk; the mask is False outside the image."""
    border = math.ceil(radius) + 2
    padded = np.pad(mask, border).astype(np.uint8)
    dilated = cv2.distanceTransform(1 - padded, cv2.DIST_L2, 5) <= radius
    distance = cv2.distanceTransform(dilated.astype(np.uint8), cv2.DIST_L2, 5)
    return np.asarray((distance > radius)[border:-border, border:-border], np.bool_)
