"""Two-view geometry of matches: which are inliers, and how the cameras lie."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import pycolmap
from scipy.special import bdtrc

from mpsfm_core.data import Float64, Int64, PinholeCamera
from mpsfm_core.data.decisions import PairReason, Reason
from mpsfm_core.extraction.options import VerificationOptions
from mpsfm_core.geometry.pycolmap_conversion import colmap_from_pinhole

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
class TwoViewGeometry:
    """Two-view geometry of an image pair, or the code of the reason why the pair is dropped."""

    dropped: str
    """Value of a :class:`~mpsfm_core.data.decisions.PairReason`; empty for a verified pair."""
    configuration: str
    """COLMAP's configuration of the two-view geometry, in words."""
    num_inliers: int
    """Inliers of the estimated geometry, also of a dropped pair."""
    inliers: Int64
    """(k,) rows of the inlier matches; none of a dropped pair."""
    rotation: Float64
    """(3, 3) rotation of ``cam_b_from_cam_a``."""
    translation: Float64
    """(3,) translation of ``cam_b_from_cam_a``, of unit or zero length."""

    def drop_reason(self, num_matches: int, min_matches: int) -> Reason:
        """Return the reason why the pair is dropped, with its numbers."""
        code = PairReason(self.dropped)
        values: dict[str, str | int] = {
            "num_matches": num_matches,
            "min_matches": min_matches,
            "num_inliers": self.num_inliers,
            "geometry": self.configuration,
        }
        return code.because(**{name: values[name] for name in code.fields})


def verify_matches(
    camera_a: PinholeCamera,
    camera_b: PinholeCamera,
    xy_a: Float64,
    xy_b: Float64,
    options: VerificationOptions,
    *,
    std_px: float = 1.0,
    seed: int = 0,
) -> TwoViewGeometry:
    """Verify matches, row by row of ``xy_a``, ``xy_b`` (m, 2), by COLMAP's calibrated estimation.

    The same input and seed give the same outcome. ``std_px``: localisation noise of the matches.
    """
    if len(xy_a) < options.min_inliers:
        return _dropped(PairReason.TOO_FEW_MATCHES)
    matches = np.repeat(np.arange(len(xy_a), dtype=np.uint32)[:, None], 2, axis=1)
    geometry = pycolmap.estimate_calibrated_two_view_geometry(
        colmap_from_pinhole(camera_a),
        xy_a,
        colmap_from_pinhole(camera_b),
        xy_b,
        matches,
        _colmap_options(options, std_px, seed),
    )
    inliers = np.asarray(geometry.inlier_matches)[:, 0].astype(np.int64)
    if geometry.config not in _USABLE:
        name = _Configuration(geometry.config).name.lower()
        return _dropped(PairReason.DEGENERATE, name, len(inliers))
    configuration = _USABLE[geometry.config]
    if len(inliers) < options.min_inliers:
        return _dropped(PairReason.TOO_FEW_INLIERS, configuration, len(inliers))
    chance = _chance(len(inliers), len(xy_a), camera_b, options.max_error_px * max(1.0, std_px))
    if chance > options.max_chance:
        return _dropped(PairReason.EXPLAINED_BY_CHANCE, configuration, len(inliers))
    pose = geometry.cam2_from_cam1
    if pose is None:
        return _dropped(PairReason.NO_RELATIVE_POSE, configuration, len(inliers))
    rotation = np.asarray(pose.rotation.matrix(), dtype=np.float64)
    translation = np.asarray(pose.translation, dtype=np.float64)
    return TwoViewGeometry("", configuration, len(inliers), inliers, rotation, translation)


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


def _dropped(reason: PairReason, configuration: str = "", num_inliers: int = 0) -> TwoViewGeometry:
    """Return the result for a dropped pair."""
    none = np.empty(0, np.int64)
    return TwoViewGeometry(reason.value, configuration, num_inliers, none, np.eye(3), np.zeros(3))


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
