"""Rigid transforms, camera centers and angles."""

from __future__ import annotations

import numpy as np

from mpsfm_core.data import Float64


def rotation_angle_deg(rotation: Float64) -> Float64:
    """Compute the rotation angle of matrices (..., 3, 3) in degrees, accurate near 0 and 180."""
    sine = 0.5 * np.linalg.norm(
        np.stack(
            [
                rotation[..., 2, 1] - rotation[..., 1, 2],
                rotation[..., 0, 2] - rotation[..., 2, 0],
                rotation[..., 1, 0] - rotation[..., 0, 1],
            ],
            axis=-1,
        ),
        axis=-1,
    )
    cosine = 0.5 * (np.trace(rotation, axis1=-2, axis2=-1) - 1)
    angle: Float64 = np.degrees(np.arctan2(sine, cosine))
    return angle


def angle_between_deg(a: Float64, b: Float64) -> Float64:
    """Compute the angle between vectors (..., 3) in [0, 180] degrees, accurate near 0."""
    (ax, ay, az), (bx, by, bz) = np.moveaxis(a, -1, 0), np.moveaxis(b, -1, 0)
    sine = np.sqrt((ay * bz - az * by) ** 2 + (az * bx - ax * bz) ** 2 + (ax * by - ay * bx) ** 2)
    cosine = ax * bx + ay * by + az * bz
    angle: Float64 = np.degrees(np.arctan2(sine, cosine))
    return angle


def triangulation_angle_deg(center_a: Float64, center_b: Float64, points: Float64) -> Float64:
    """Compute the triangulation angle of points (..., 3) to two camera centers (..., 3).

    Angles above 90 degrees are folded as in COLMAP, because opposite rays are as ill-conditioned as
    parallel rays.

    Returns:
        Triangulation angles (...) in degrees, in [0, 90].
    """
    angle = angle_between_deg(points - center_a, points - center_b)
    folded: Float64 = np.minimum(angle, 180.0 - angle)
    return folded


def camera_center(rotation: Float64, translation: Float64) -> Float64:
    """Compute camera centers (..., 3) from ``cam_from_world`` rotations and translations."""
    center: Float64 = -np.einsum("...ji,...j->...i", rotation, translation)
    return center


def transform(rotation: Float64, translation: Float64, points: Float64) -> Float64:
    """Transform points (n, 3) by ``R x + t``."""
    moved: Float64 = points @ rotation.T + translation
    return moved


def invert(rotation: Float64, translation: Float64) -> tuple[Float64, Float64]:
    """Invert a rigid transform (3, 3), (3,)."""
    return rotation.T, -rotation.T @ translation


def compose(
    b_from_a: tuple[Float64, Float64], a_from_world: tuple[Float64, Float64]
) -> tuple[Float64, Float64]:
    """Compose the rigid transforms ``b_from_a`` and ``a_from_world`` to ``b_from_world``."""
    return b_from_a[0] @ a_from_world[0], b_from_a[0] @ a_from_world[1] + b_from_a[1]
