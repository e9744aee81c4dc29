"""Surface normals computed from measured depth on smooth surfaces."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

_RADIUS = 4
_FLAT = 0.03
"""Maximum rms deviation of inverse depth from a plane, relative to inverse depth."""
_ENOUGH = 0.7


def normals_of_depth(
    depth: NDArray[np.float32], camera: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Compute unit normals (h, w, 3) in the camera frame from depth, 0 where it is not smooth.

    Inverse depth is linear on a plane, ``1 / z = (n . ray) / d``. Planes are fitted to inverse
    depth by least squares in windows of 9 x 9 pixels. The returned normals face the camera.
    ``depth`` (h, w) is in meters, 0 if unknown, and ``camera`` is (fx, fy, cx, cy) in pixels.
    """
    height, width = depth.shape
    known = depth > 0
    inverse = np.where(known, 1 / np.maximum(depth, 1e-3), 0).astype(np.float64)
    x = (np.arange(width) + 0.5 - camera[2]) / camera[0]
    y = (np.arange(height) + 0.5 - camera[3]) / camera[1]
    x, y = np.broadcast_to(x, depth.shape), np.broadcast_to(y[:, None], depth.shape)
    side = 2 * _RADIUS + 1

    def total(field: NDArray[np.float64]) -> NDArray[np.float64]:
        return cv2.boxFilter(np.where(known, field, 0.0), cv2.CV_64F, (side, side), normalize=False)

    ones = np.ones_like(inverse)
    basis = (x, y, ones)
    matrix = np.stack([np.stack([total(a * b) for b in basis], -1) for a in basis], -2)
    right = np.stack([total(a * inverse) for a in basis], -1)
    count = matrix[..., 2, 2]
    enough = known & (count > _ENOUGH * side**2)
    matrix[~enough] = np.eye(3)
    plane = np.linalg.solve(matrix, right[..., None])[..., 0]
    squares = total(inverse**2) - np.einsum("hwi,hwi->hw", plane, right)
    rms = np.sqrt(np.maximum(squares, 0) / np.maximum(count, 1))
    flat = enough & (rms < _FLAT * inverse)
    length = np.linalg.norm(plane, axis=-1)
    normals = -plane / np.maximum(length, 1e-9)[..., None]
    return np.where(flat[..., None], normals, 0).astype(np.float32)
