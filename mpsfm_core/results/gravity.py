"""Which way is up in a reconstruction, from how cameras are held and how surfaces lie."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mpsfm_core.data import Float64
from mpsfm_core.geometry import angle_between_deg

_ROLL_DEG = 10.0
"""How far from level people hold a camera."""
_PITCH_DEG = 30.0
"""How far from level they point it, on average over the photos; up to twice that far surfaces are
believed against the cameras."""
_SURFACE_DEG = 5.0
"""Within this angle floors and walls count as level and upright: the std of a normal of the better
networks of the paper's appendix C is about twice that, averaged over many it is far smaller."""
_CANDIDATES = 500
_REFINEMENTS = 5


@dataclass(frozen=True, eq=False)
class Gravity:
    """``up``: (3,) float64, unit, away from the ground, in world coordinates. ``surfaces``: share
    of surface normals that lie along it or across it, None if there were none to ask."""

    up: Float64
    surfaces: float | None

    def __str__(self) -> str:
        """For people."""
        if self.surfaces is None:
            return "gravity from how the cameras are held"
        return (
            f"gravity from cameras and surfaces, {self.surfaces:.0%} of which are level or upright"
        )


def estimate_gravity(rotations: Float64, normals: Float64) -> Gravity:
    """Up, from cameras that are held about level and surfaces that are level or upright.

    ``rotations``: (n, 3, 3) ``cam_from_world``. ``normals``: (m, 3) unit vectors in the world, may
    be none. Photos that all look steeply down or up need surfaces.
    """
    level = _up_of_cameras(rotations)
    if not len(normals):
        return Gravity(level, None)
    rights = rotations[:, 0]
    step = max(1, len(normals) // _CANDIDATES)
    candidates = np.vstack([level, normals[::step], -normals[::step]])
    candidates = candidates[angle_between_deg(candidates, level) < 2 * _PITCH_DEG]
    roll = np.sin(np.radians(_ROLL_DEG))
    doubt = 0.5 * (angle_between_deg(candidates, level) / _PITCH_DEG) ** 2
    doubt += 0.5 * ((candidates @ rights.T / roll) ** 2).mean(axis=1)
    cosines = np.abs(normals[::step] @ candidates.T)
    support = (_near_level(cosines) + _near_upright(cosines)).mean(axis=0)
    up = candidates[np.argmax(np.log(support + 1e-6) - doubt)]
    for _ in range(_REFINEMENTS):
        up = _refined(up, normals)
    cosines = np.abs(normals @ up)
    limit = np.radians(_SURFACE_DEG)
    agreeing = (cosines > np.cos(limit)) | (cosines < np.sin(limit))
    return Gravity(up, float(agreeing.mean()))


def rotation_to_z(up: Float64, right: Float64) -> Float64:
    """Rotation (3, 3) float64 of the world that turns ``up`` to +z, and ``right``, as far as it is
    level, to +x."""
    x = right - (right @ up) * up
    if np.linalg.norm(x) < 1e-6:
        x = np.eye(3)[np.argmin(np.abs(up))]
        x = x - (x @ up) * up
    x = x / np.linalg.norm(x)
    return np.stack([x, np.cross(up, x), up])


def _up_of_cameras(rotations: Float64) -> Float64:
    """Across the right axes of all cameras; where these say too little, the mean of their ups."""
    rights, ups = rotations[:, 0], -rotations[:, 1]
    mean = ups.mean(axis=0)
    mean = mean / max(float(np.linalg.norm(mean)), 1e-12)
    ratio = (np.sin(np.radians(_ROLL_DEG)) / np.sin(np.radians(_PITCH_DEG))) ** 2
    scatter = rights.T @ rights / len(rights) + ratio * (np.eye(3) - np.outer(mean, mean))
    up: Float64 = np.linalg.eigh(scatter)[1][:, 0]
    return up if up @ mean >= 0 else -up


def _refined(up: Float64, normals: Float64) -> Float64:
    """The direction that level normals lie along and upright ones across, by least squares."""
    cosines = np.abs(normals @ up)
    along, across = _near_level(cosines), _near_upright(cosines)
    scatter = (normals * (across - along)[:, None]).T @ normals
    better: Float64 = np.linalg.eigh(scatter)[1][:, 0]
    better = better if better @ up >= 0 else -better
    return better if angle_between_deg(better, up) < 2 * _SURFACE_DEG else up


def _near_level(cosines: Float64) -> Float64:
    angle = np.degrees(np.arccos(np.clip(cosines, 0, 1)))
    weight: Float64 = np.exp(-0.5 * (angle / _SURFACE_DEG) ** 2)
    return weight


def _near_upright(cosines: Float64) -> Float64:
    angle = np.degrees(np.arcsin(np.clip(cosines, 0, 1)))
    weight: Float64 = np.exp(-0.5 * (angle / _SURFACE_DEG) ** 2)
    return weight
