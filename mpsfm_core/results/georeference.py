"""A reconstruction in metres east, north and up, from where its photos were taken."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass

import cv2
import numpy as np
import pycolmap

from mpsfm_core.data import Float64, Pose
from mpsfm_core.geometry import camera_center
from mpsfm_core.inputs.gps import GpsPosition, convert_to_enu
from mpsfm_core.mapping.scene.reconstruction import MetricScale, Reconstruction, transformed
from mpsfm_core.results.gravity import estimate_gravity, rotation_to_z

_FEWEST = 4
"""Positions: three fix a similarity, one more can deny it."""
_SPREAD = 5.0
"""Standard deviations of the noise over which the positions have to spread."""
_TILT_DEG = 2.0
"""Altitudes that fix gravity less well than this leave it to cameras and surfaces."""
_ALTITUDE = 2.0
"""Noise of altitudes over that of positions (GPS.gov's user ranges: 1.5 to 3)."""
_OUTLIER = 3.0
"""Standard deviations."""


@dataclass(frozen=True)
class Georeference:
    """How a reconstruction was laid over the positions of its photos.

    ``origin``: of east, north, up. ``images``: photos with a position, ``inliers`` of which fit.
    ``rms_m``: horizontal distance of those. ``metres_per_unit``: what was applied. ``up``: what
    fixed gravity.
    """

    origin: GpsPosition
    images: int
    inliers: int
    rms_m: float
    metres_per_unit: float
    up: str

    def describe(self) -> dict[str, object]:
        """Plain data for the summary."""
        return asdict(self)


def georeference(
    reconstruction: Reconstruction, positions: Mapping[str, GpsPosition]
) -> tuple[Reconstruction, Georeference] | str:
    """The reconstruction in metres east, north and up of the photos' middle.

    ``positions``: by image name. Returns why not, in words, where too few photos have one, they
    spread too little for their noise, or most of them deny each other.
    """
    named = {image.name: image for image in reconstruction.confirmed_images}
    known = [name for name in named if name in positions]
    if len(known) < _FEWEST:
        return f"{len(known)} registered photos have a GPS position, {_FEWEST} are needed"
    origin = _middle([positions[name] for name in known])
    enu = convert_to_enu([positions[name] for name in known], origin)
    std_m = float(np.median([positions[name].std_m for name in known]))
    deviations = enu[:, :2] - np.median(enu[:, :2], axis=0)
    spread = float(np.sqrt((deviations**2).sum(axis=1).mean()))
    if spread < _SPREAD * std_m:
        return f"GPS positions spread over {spread:.1f} m, their noise is {std_m:.1f} m"
    centers = np.stack([camera_center(named[n].rotation, named[n].translation) for n in known])
    tilt = _tilt_deg(enu, std_m)
    if tilt < _TILT_DEG:
        fitted, up = _fit_all(centers, enu, std_m), "GPS altitudes"
    else:
        poses = [(image.rotation, image.translation) for image in named.values()]
        fitted, up = _fit_level(poses, centers, enu, std_m), "gravity from how cameras are held"
    if fitted is None:
        return "GPS positions deny each other"
    off = np.linalg.norm((fitted * centers)[:, :2] - enu[:, :2], axis=1)
    inliers = off < _OUTLIER * std_m
    if 2 * inliers.sum() <= len(known):
        return f"only {inliers.sum()} of {len(known)} GPS positions fit the reconstruction"
    scale = float(fitted.scale)
    rms = float(np.sqrt((off[inliers] ** 2).mean()))
    metric = MetricScale(1.0, rms / spread, int(inliers.sum()), True, "GPS positions")
    moved = transformed(reconstruction, scale, fitted.rotation.matrix(), fitted.translation, metric)
    return moved, Georeference(origin, len(known), int(inliers.sum()), rms, scale, up)


def _middle(positions: list[GpsPosition]) -> GpsPosition:
    altitudes = [p.altitude for p in positions if p.altitude is not None]
    return GpsPosition(
        float(np.median([p.latitude for p in positions])),
        float(np.median([p.longitude for p in positions])),
        float(np.median(altitudes)) if altitudes else None,
    )


def _tilt_deg(enu: Float64, std_m: float) -> float:
    """How well altitudes fix the vertical: across the direction in which positions spread less."""
    whole = enu[np.isfinite(enu).all(axis=1)]
    if len(whole) < _FEWEST:
        return 90.0
    width = np.linalg.svd(whole[:, :2] - whole[:, :2].mean(axis=0), compute_uv=False)[1]
    return float(np.degrees(np.arctan2(_ALTITUDE * std_m, width)))


def _fit_all(centers: Float64, enu: Float64, std_m: float) -> pycolmap.Sim3d | None:
    whole = np.isfinite(enu).all(axis=1)
    options = pycolmap.RANSACOptions(max_error=_OUTLIER * _ALTITUDE * std_m, random_seed=0)
    fitted = pycolmap.estimate_sim3d_robust(centers[whole], enu[whole], options)
    return (
        None if fitted is None else fitted["tgt_from_src"] if isinstance(fitted, dict) else fitted
    )


def _fit_level(
    poses: list[Pose], centers: Float64, enu: Float64, std_m: float
) -> pycolmap.Sim3d | None:
    """Gravity from the cameras; heading, scale and place from positions; height from altitudes."""
    rotations = np.stack([rotation for rotation, _ in poses])
    gravity = estimate_gravity(rotations, np.zeros((0, 3)))
    level = rotation_to_z(gravity.up, rotations[0, 0])
    turned = centers @ level.T
    cv2.setRNGSeed(0)
    source, target = (np.ascontiguousarray(places[:, :2]) for places in (turned, enu))
    found, _ = cv2.estimateAffinePartial2D(
        source, target, ransacReprojThreshold=_OUTLIER * std_m, maxIters=5000
    )
    if found is None:
        return None
    scale = float(np.hypot(found[0, 0], found[1, 0]))
    heading = np.eye(3)
    heading[:2, :2] = found[:, :2] / scale
    height = np.nanmedian(enu[:, 2] - scale * turned[:, 2]) if np.isfinite(enu[:, 2]).any() else 0.0
    translation = np.array([found[0, 2], found[1, 2], height])
    return pycolmap.Sim3d(scale, pycolmap.Rotation3d(heading @ level), translation)
