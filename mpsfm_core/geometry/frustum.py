"""View frusta of pinhole cameras."""

# mypy: allow-untyped-decorators

from __future__ import annotations

import math

import numpy as np

from mpsfm_core.data import Float64
from mpsfm_core.support.jit import kernel


@kernel()
def frustum_planes(
    rotations: Float64, translations: Float64, intrinsics: Float64, sizes: Float64
) -> Float64:
    """Compute the planes of the view frusta of n cameras in the world frame.

    The product of a plane with a homogeneous point is its signed distance from the plane, positive
    on the side of the frustum. A sphere that is behind one plane by more than its radius is
    invisible.

    Args:
        rotations: (n, 3, 3) rotations ``cam_from_world``.
        translations: (n, 3) ``cam_from_world``.
        intrinsics: (n, 4) intrinsics fx, fy, cx, cy in pixels.
        sizes: (n, 2) width and height of the images in pixels.

    Returns:
        (n, 5, 4) the plane z = 0 of the camera frame, then the planes through the camera center and
        the left, right, top and bottom border of the image.
    """
    planes = np.zeros((len(rotations), 5, 4))
    for image in range(len(rotations)):
        fx, fy, cx, cy = intrinsics[image]
        width, height = sizes[image]
        normals = (
            (0.0, 0.0, 1.0),
            (fx, 0.0, cx),
            (-fx, 0.0, width - cx),
            (0.0, fy, cy),
            (0.0, -fy, height - cy),
        )
        for k, (x, y, z) in enumerate(normals):
            norm = math.sqrt(x * x + y * y + z * z)
            for a in range(3):
                rotation = rotations[image, :, a]
                planes[image, k, a] = (x * rotation[0] + y * rotation[1] + z * rotation[2]) / norm
            translation = translations[image]
            planes[image, k, 3] = (
                x * translation[0] + y * translation[1] + z * translation[2]
            ) / norm
    return planes
