"""Two-view geometry of matches: which are inliers, and how the cameras lie."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import pycolmap
from scipy.special import bdtrc

from mpsfm_core.data import Float64, Int64, PinholeCamera
from mpsfm_core.extraction.options import VerificationOptions

_Configuration = pycolmap.TwoViewGeometryConfiguration
CALIBRATED = "calibrated"
_USABLE = {
    _Configuration.CALIBRATED: CALIBRATED,
    _Configuration.UNCALIBRATED: "uncalibrated",
    _Configuration.PLANAR: "planar",
    _Configuration.PANORAMIC: "panoramic",
    _Configuration.PLANAR_OR_PANORAMIC: "planar or panoramic",
}


@dataclass(frozen=True, eq=False)
class TwoView:
    """Outcome of verification.

    ``reason``: why the pair is dropped, empty if it is kept. ``configuration``: COLMAP's, in
    words. ``inliers``: (k,) int64, rows of the matches. ``rotation`` (3, 3), ``translation`` (3,)
    float64: ``cam_b_from_cam_a``, a unit or zero translation.
    """

    reason: str
    configuration: str
    inliers: Int64
    rotation: Float64
    translation: Float64


def verify(
    camera_a: PinholeCamera,
    camera_b: PinholeCamera,
    xy_a: Float64,
    xy_b: Float64,
    options: VerificationOptions,
    *,
    std_px: float = 1.0,
    seed: int = 0,
) -> TwoView:
    """Verify matches, row by row of ``xy_a``, ``xy_b`` (m, 2), by COLMAP's calibrated estimation.

    The same input and seed give the same outcome. ``std_px``: localisation noise of the matches.
    """
    if len(xy_a) < options.min_inliers:
        return _dropped(f"{len(xy_a)} matches, at least {options.min_inliers} are needed")
    matches = np.repeat(np.arange(len(xy_a), dtype=np.uint32)[:, None], 2, axis=1)
    geometry = pycolmap.estimate_calibrated_two_view_geometry(
        _colmap_camera(camera_a),
        xy_a,
        _colmap_camera(camera_b),
        xy_b,
        matches,
        _colmap_options(options, std_px, seed),
    )
    inliers = np.asarray(geometry.inlier_matches)[:, 0].astype(np.int64)
    if geometry.config not in _USABLE:
        name = _Configuration(geometry.config).name.lower()
        return _dropped(f"{len(inliers)} inliers of {len(xy_a)} matches ({name})", name)
    configuration = _USABLE[geometry.config]
    if len(inliers) < options.min_inliers:
        return _dropped(f"{len(inliers)} inliers of {len(xy_a)} matches", configuration)
    chance = _chance(len(inliers), len(xy_a), camera_b, options.max_error_px * max(1.0, std_px))
    if chance > options.max_chance:
        return _dropped(
            f"{len(inliers)} inliers of {len(xy_a)} matches fit by chance", configuration
        )
    pose = geometry.cam2_from_cam1
    if pose is None:
        return _dropped("no relative pose", configuration)
    rotation = np.asarray(pose.rotation.matrix(), dtype=np.float64)
    translation = np.asarray(pose.translation, dtype=np.float64)
    return TwoView("", configuration, inliers, rotation, translation)


def _chance(inliers: int, matches: int, camera: PinholeCamera, error_px: float) -> float:
    """Probability that a given epipolar geometry has that many inliers among random matches.

    Those beyond the minimal sample fall into the band of the error around their epipolar line
    (the Sampson error is the distance in both images together, hence the root of 2), which is at
    most as long as the image's diagonal.
    """
    area = camera.width * camera.height
    band = 2 * math.sqrt(2) * error_px * math.hypot(camera.width, camera.height) / area
    sample = 5
    return float(bdtrc(inliers - sample - 1, matches - sample, min(band, 1.0)))


def _dropped(reason: str, configuration: str = "") -> TwoView:
    return TwoView(reason, configuration, np.empty(0, np.int64), np.eye(3), np.zeros(3))


def _colmap_camera(camera: PinholeCamera) -> pycolmap.Camera:
    return pycolmap.Camera(
        model="PINHOLE", width=camera.width, height=camera.height, params=camera.params
    )


def _colmap_options(
    options: VerificationOptions, std_px: float, seed: int
) -> pycolmap.TwoViewGeometryOptions:
    colmap = pycolmap.TwoViewGeometryOptions()
    colmap.min_num_inliers = options.min_inliers
    colmap.min_E_F_inlier_ratio = options.min_e_f_ratio
    colmap.max_H_inlier_ratio = options.max_h_ratio
    colmap.compute_relative_pose = True
    colmap.detect_watermark = False  # photos of this pipeline are the user's own
    ransac = colmap.ransac
    ransac.max_error = options.max_error_px * max(1.0, std_px)
    ransac.min_inlier_ratio = options.min_inlier_ratio
    ransac.max_num_trials = options.max_trials
    ransac.confidence = options.confidence
    ransac.random_seed = seed
    return colmap
