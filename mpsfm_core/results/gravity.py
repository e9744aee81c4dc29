"""Estimate the gravity direction from camera orientations and surface normals."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mpsfm_core.data import Float64
from mpsfm_core.geometry import angle_between_deg

_ROLL_DEG = 10.0
"""Standard deviation in degrees of the roll of hand-held cameras."""
_PITCH_DEG = 30.0
"""Standard deviation in degrees of the mean pitch of hand-held cameras. Gravity candidates from
surface normals may deviate from the camera orientations by twice the pitch std."""
_SURFACE_DEG = 5.0
"""Maximum deviation in degrees of a surface that counts as horizontal or vertical."""
_CANDIDATES = 500
"""Number of surface normals that are tested as gravity direction."""
_REFINEMENTS = 5
"""Number of least-squares iterations that refine the gravity direction."""


@dataclass(frozen=True, eq=False)
class Gravity:
    """Gravity direction of a reconstruction."""

    up: Float64
    """(3,) float64 unit vector opposite to gravity in world coordinates."""
    surfaces: float | None
    """Share of surface normals parallel or perpendicular to ``up``, None without normals."""

    def __str__(self) -> str:
        """Describe the source of the gravity direction for users."""
        if self.surfaces is None:
            return "gravity from how the cameras are held"
        return (
            f"gravity from cameras and surfaces, {self.surfaces:.0%} of which are level or upright"
        )


def estimate_gravity(rotations: Float64, normals: Float64) -> Gravity:
    """Estimate gravity from nearly level cameras and horizontal or vertical surfaces.

    Candidate directions are scored by a Gaussian prior on camera roll and pitch and by supporting
    surface normals. The best candidate is refined by least squares. Without surface normals, the
    gravity direction is wrong if all cameras look steeply down or up.

    Args:
        rotations: (n, 3, 3) camera rotations ``cam_from_world``.
        normals: (m, 3) unit surface normals in the world frame, may be empty.
    """
    level = _estimate_up_from_cameras(rotations)
    if not len(normals):
        return Gravity(level, None)
    rights = rotations[:, 0]
    step = max(1, len(normals) // _CANDIDATES)
    candidates = np.vstack([level, normals[::step], -normals[::step]])
    candidates = candidates[angle_between_deg(candidates, level) < 2 * _PITCH_DEG]
    roll = np.sin(np.radians(_ROLL_DEG))
    cost = 0.5 * (angle_between_deg(candidates, level) / _PITCH_DEG) ** 2
    cost += 0.5 * ((candidates @ rights.T / roll) ** 2).mean(axis=1)
    cosines = np.abs(normals[::step] @ candidates.T)
    support = (_weigh_horizontal(cosines) + _weigh_vertical(cosines)).mean(axis=0)
    up = candidates[np.argmax(np.log(support + 1e-6) - cost)]
    for _ in range(_REFINEMENTS):
        up = _refine_up(up, normals)
    cosines = np.abs(normals @ up)
    limit = np.radians(_SURFACE_DEG)
    agreeing = (cosines > np.cos(limit)) | (cosines < np.sin(limit))
    return Gravity(up, float(agreeing.mean()))


def rotation_to_z(up: Float64, right: Float64) -> Float64:
    """Return the rotation (3, 3) that maps ``up`` to +z and the level part of ``right`` to +x."""
    x = right - (right @ up) * up
    if np.linalg.norm(x) < 1e-6:
        x = np.eye(3)[np.argmin(np.abs(up))]
        x = x - (x @ up) * up
    x = x / np.linalg.norm(x)
    return np.stack([x, np.cross(up, x), up])


def _estimate_up_from_cameras(rotations: Float64) -> Float64:
    """Return the direction that is most perpendicular to the x axes of all cameras, regularized."""
    rights, ups = rotations[:, 0], -rotations[:, 1]
    mean = ups.mean(axis=0)
    mean = mean / max(float(np.linalg.norm(mean)), 1e-12)
    ratio = (np.sin(np.radians(_ROLL_DEG)) / np.sin(np.radians(_PITCH_DEG))) ** 2
    scatter = rights.T @ rights / len(rights) + ratio * (np.eye(3) - np.outer(mean, mean))
    up: Float64 = np.linalg.eigh(scatter)[1][:, 0]
    return up if up @ mean >= 0 else -up


def _refine_up(up: Float64, normals: Float64) -> Float64:
    """Refine the up direction by least squares over normals of level and vertical surfaces."""
    cosines = np.abs(normals @ up)
    along, across = _weigh_horizontal(cosines), _weigh_vertical(cosines)
    scatter = (normals * (across - along)[:, None]).T @ normals
    refined: Float64 = np.linalg.eigh(scatter)[1][:, 0]
    refined = refined if refined @ up >= 0 else -refined
    return refined if angle_between_deg(refined, up) < 2 * _SURFACE_DEG else up


def _weigh_horizontal(cosines: Float64) -> Float64:
    """Return Gaussian weights of surface normals that are parallel to a direction."""
    angle = np.degrees(np.arccos(np.clip(cosines, 0, 1)))
    weight: Float64 = np.exp(-0.5 * (angle / _SURFACE_DEG) ** 2)
    return weight


def _weigh_vertical(cosines: Float64) -> Float64:
    """Return Gaussian weights of surface normals that are perpendicular to a direction."""
    angle = np.degrees(np.arcsin(np.clip(cosines, 0, 1)))
    weight: Float64 = np.exp(-0.5 * (angle / _SURFACE_DEG) ** 2)
    return weight
