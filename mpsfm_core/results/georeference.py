"""Georeference a reconstruction by alignment with the GPS positions of its images."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass

import cv2
import numpy as np
import pycolmap

from mpsfm_core.data import Bool, Float64, Pose
from mpsfm_core.data.decisions import GpsReason, Reason
from mpsfm_core.geometry import camera_center
from mpsfm_core.inputs.gps import GpsPosition, convert_to_enu
from mpsfm_core.mapping.scene.reconstruction import (
    MetricScale,
    Reconstruction,
    transform_reconstruction,
)
from mpsfm_core.results.gravity import estimate_gravity, rotation_to_z

_MIN_POSITIONS = 4
"""Minimum number of GPS positions; three determine a similarity, a fourth validates it."""
_MIN_SPREAD_STDS = 5.0
"""Minimum spread of the GPS positions in standard deviations of GPS noise."""
_MAX_TILT_STD_DEG = 2.0
"""Std in degrees of gravity from GPS altitudes, above which camera orientations are preferred."""
_NO_TILT_DEG = 90.0
"""Std in degrees of the gravity direction if there are too few GPS altitudes."""
_ALTITUDE_STD_RATIO = 2.0
"""Ratio of vertical to horizontal GPS noise [GPS.gov, 1.5 to 3]."""
_MAX_ERROR_STDS = 3.0
"""Maximum error of an inlier GPS position in standard deviations."""


@dataclass(frozen=True)
class Georeference:
    """Alignment of a reconstruction with GPS positions."""

    origin: GpsPosition
    """Origin of the east-north-up world frame."""
    images: int
    """Number of registered images with a GPS position."""
    inliers: int
    """Number of GPS positions that are inliers of the alignment."""
    rms_m: float
    """Root mean square horizontal error of the inliers in meters."""
    metres_per_unit: float
    """Scale factor that was applied to the reconstruction."""
    up: str
    """Source of the gravity direction, for users."""

    def describe(self) -> dict[str, object]:
        """Return the georeference as plain data for ``summary.json``."""
        return asdict(self)


def georeference(
    reconstruction: Reconstruction, positions: Mapping[str, GpsPosition]
) -> tuple[Reconstruction, Georeference] | Reason:
    """Align a reconstruction with the GPS positions of its images.

    The similarity is estimated with RANSAC. If GPS altitudes do not determine gravity, camera
    orientations determine gravity, and GPS positions determine heading, scale and translation. If
    most GPS positions are outliers with gravity from camera orientations, gravity from GPS
    altitudes is used nevertheless.

    Args:
        reconstruction: reconstruction in an arbitrary world frame and scale.
        positions: GPS positions by image name.

    Returns:
        The reconstruction in meters east, north, up of the median GPS position, and the alignment.
        If the GPS positions are too few, spread too little for their noise, or mostly disagree, the
        reason is returned instead.
    """
    by_name = {image.name: image for image in reconstruction.confirmed_images}
    located = [name for name in by_name if name in positions]
    if len(located) < _MIN_POSITIONS:
        return GpsReason.TOO_FEW_POSITIONS.because(
            num_positions=len(located), min_positions=_MIN_POSITIONS
        )
    origin = _median_position([positions[name] for name in located])
    enu = convert_to_enu([positions[name] for name in located], origin)
    std_m = float(np.median([positions[name].std_m for name in located]))
    deviations = enu[:, :2] - np.median(enu[:, :2], axis=0)
    spread = float(np.sqrt((deviations**2).sum(axis=1).mean()))
    if spread < _MIN_SPREAD_STDS * std_m:
        return GpsReason.TOO_LITTLE_SPREAD.because(spread_m=round(spread, 2), std_m=round(std_m, 2))
    images = [by_name[name] for name in located]
    centers = np.stack([camera_center(image.rotation, image.translation) for image in images])
    poses = [(image.rotation, image.translation) for image in by_name.values()]
    best: tuple[pycolmap.Sim3d, str, Bool, Float64] | None = None
    for enu_from_world, up in _generate_alignments(poses, centers, enu, std_m):
        error_m = np.linalg.norm((enu_from_world * centers)[:, :2] - enu[:, :2], axis=1)
        inliers = error_m < _MAX_ERROR_STDS * std_m
        if best is None or inliers.sum() > best[2].sum():
            best = enu_from_world, up, inliers, error_m
        if 2 * inliers.sum() > len(located):
            break
    if best is None:
        return GpsReason.INCONSISTENT.because()
    enu_from_world, up, inliers, error_m = best
    if 2 * inliers.sum() <= len(located):
        return GpsReason.FEW_INLIERS.because(
            num_inliers=int(inliers.sum()), num_positions=len(located)
        )
    scale = float(enu_from_world.scale)
    rms = float(np.sqrt((error_m[inliers] ** 2).mean()))
    metric = MetricScale(1.0, rms / spread, int(inliers.sum()), True, "GPS positions")
    moved = transform_reconstruction(
        reconstruction, scale, enu_from_world.rotation.matrix(), enu_from_world.translation, metric
    )
    return moved, Georeference(origin, len(located), int(inliers.sum()), rms, scale, up)


def _generate_alignments(
    poses: list[Pose], centers: Float64, enu: Float64, std_m: float
) -> Iterator[tuple[pycolmap.Sim3d, str]]:
    """Yield alignments ``enu_from_world`` with their source of gravity, most reliable first.

    If GPS altitudes do not determine gravity well, the alignment with gravity from camera
    orientations comes first. Gravity from camera orientations is wrong if all cameras look down, as
    in mapping flights.
    """
    tilt_deg = _tilt_deg(enu, std_m)
    if tilt_deg >= _MAX_TILT_STD_DEG:
        level = _fit_level_similarity(poses, centers, enu, std_m)
        if level is not None:
            yield level, "gravity from how cameras are held"
    if tilt_deg < _NO_TILT_DEG:
        similarity = _fit_similarity(centers, enu, std_m)
        if similarity is not None:
            yield similarity, "GPS altitudes"


def _median_position(positions: list[GpsPosition]) -> GpsPosition:
    altitudes = [p.altitude for p in positions if p.altitude is not None]
    return GpsPosition(
        float(np.median([p.latitude for p in positions])),
        float(np.median([p.longitude for p in positions])),
        float(np.median(altitudes)) if altitudes else None,
    )


def _tilt_deg(enu: Float64, std_m: float) -> float:
    """Return the std in degrees of gravity from GPS altitudes, about the axis of least spread."""
    with_altitude = enu[np.isfinite(enu).all(axis=1)]
    if len(with_altitude) < _MIN_POSITIONS:
        return _NO_TILT_DEG
    horizontal = with_altitude[:, :2]
    width = np.linalg.svd(horizontal - horizontal.mean(axis=0), compute_uv=False)[1]
    return float(np.degrees(np.arctan2(_ALTITUDE_STD_RATIO * std_m, width)))


def _fit_similarity(centers: Float64, enu: Float64, std_m: float) -> pycolmap.Sim3d | None:
    """Estimate ``enu_from_world`` from all GPS coordinates with RANSAC."""
    with_altitude = np.isfinite(enu).all(axis=1)
    options = pycolmap.RANSACOptions(
        max_error=_MAX_ERROR_STDS * _ALTITUDE_STD_RATIO * std_m, random_seed=0
    )
    result = pycolmap.estimate_sim3d_robust(centers[with_altitude], enu[with_altitude], options)
    return result["tgt_from_src"] if isinstance(result, dict) else result


def _fit_level_similarity(
    poses: list[Pose], centers: Float64, enu: Float64, std_m: float
) -> pycolmap.Sim3d | None:
    """Estimate ``enu_from_world`` with gravity from camera orientations and the rest from GPS."""
    rotations = np.stack([rotation for rotation, _ in poses])
    gravity = estimate_gravity(rotations, np.zeros((0, 3)))
    level = rotation_to_z(gravity.up, rotations[0, 0])
    leveled = centers @ level.T
    cv2.setRNGSeed(0)
    source, target = (np.ascontiguousarray(places[:, :2]) for places in (leveled, enu))
    affine, _ = cv2.estimateAffinePartial2D(
        source, target, ransacReprojThreshold=_MAX_ERROR_STDS * std_m, maxIters=5000
    )
    if affine is None:
        return None
    scale = float(np.hypot(affine[0, 0], affine[1, 0]))
    heading = np.eye(3)
    heading[:2, :2] = affine[:, :2] / scale
    height = (
        np.nanmedian(enu[:, 2] - scale * leveled[:, 2]) if np.isfinite(enu[:, 2]).any() else 0.0
    )
    translation = np.array([affine[0, 2], affine[1, 2], height])
    return pycolmap.Sim3d(scale, pycolmap.Rotation3d(heading @ level), translation)
