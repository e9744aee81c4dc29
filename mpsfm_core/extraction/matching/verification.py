"""Two-view geometric verification: inliers and relative pose of an image pair."""

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
_MIN_INLIER_RATIO = 0.1
"""Assumed minimum inlier ratio, which limits the number of RANSAC trials. [reference]"""
_MAX_TRIALS = 20_000
"""Maximum number of RANSAC trials. [reference]"""
_CONFIDENCE = 0.999
"""Probability that RANSAC draws an outlier-free sample. [COLMAP confidence]"""
_MIN_E_F_RATIO = 0.95
"""Minimum ratio of essential-matrix inliers to fundamental-matrix inliers of a calibrated pair.
[COLMAP min_E_F_inlier_ratio]"""
_SAMPLE_SIZE = 5
"""Number of matches in a minimal sample for an essential matrix."""
_MAX_H_RATIO = 0.8
"""Ratio of homography inliers to epipolar inliers above which a pair is planar or panoramic.
[COLMAP max_H_inlier_ratio]"""


@dataclass(frozen=True, eq=False)
class TwoViewGeometry:
    """Two-view geometry of an image pair, or the reason why the pair is dropped."""

    dropped: str
    """Value of a :class:`~mpsfm_core.data.decisions.PairReason`; empty for a verified pair."""
    configuration: str
    """COLMAP's two-view configuration in words, for example "planar"."""
    num_inliers: int
    """Number of inliers of the estimated geometry, also for a dropped pair."""
    inliers: Int64
    """(k,) rows of the inlier matches; empty for a dropped pair."""
    rotation: Float64
    """(3, 3) rotation of ``cam_b_from_cam_a``."""
    translation: Float64
    """(3,) translation of ``cam_b_from_cam_a``, of unit or zero length."""

    def drop_reason(self, num_matches: int, min_matches: int) -> Reason:
        """Return the reason why the pair is dropped, with numbers of matches and inliers."""
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
    """Estimate the two-view geometry of matches with COLMAP's calibrated LO-RANSAC.

    Args:
        camera_a: Camera of the first view.
        camera_b: Camera of the second view.
        xy_a: (m, 2) matched keypoints of the first view, pixels.
        xy_b: (m, 2) matched keypoints of the second view, pixels; row i matches row i of ``xy_a``.
        options: Inlier threshold, and minimum number of inliers of a verified pair.
        std_px: Standard deviation of the keypoints, pixels; scales the inlier threshold.
        seed: Seed of RANSAC; the same input and seed give the same result.

    Returns:
        The two-view geometry, or the reason why the pair is dropped.
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
    chance = _chance_of_inliers(
        len(inliers), len(xy_a), camera_b, options.max_error_px * max(1.0, std_px)
    )
    if chance > options.max_chance:
        return _dropped(PairReason.EXPLAINED_BY_CHANCE, configuration, len(inliers))
    pose = geometry.cam2_from_cam1
    if pose is None:
        return _dropped(PairReason.NO_RELATIVE_POSE, configuration, len(inliers))
    rotation = np.asarray(pose.rotation.matrix(), dtype=np.float64)
    translation = np.asarray(pose.translation, dtype=np.float64)
    return TwoViewGeometry("", configuration, len(inliers), inliers, rotation, translation)


def _chance_of_inliers(inliers: int, matches: int, camera: PinholeCamera, error_px: float) -> float:
    """Return the probability that a given epipolar geometry has the inliers by chance.

    A random match is an inlier if its second point falls into the error band around the epipolar
    line. The epipolar line is at most as long as the image diagonal. The Sampson error combines the
    distances in both images, so the width of the band has the factor ``sqrt(2)``. The matches of
    the minimal sample are not counted (a-contrario test, Moisan and Stival, IJCV 2004).
    """
    area = camera.width * camera.height
    band = 2 * math.sqrt(2) * error_px * math.hypot(camera.width, camera.height) / area
    return float(bdtrc(inliers - _SAMPLE_SIZE - 1, matches - _SAMPLE_SIZE, min(band, 1.0)))


def _dropped(reason: PairReason, configuration: str = "", num_inliers: int = 0) -> TwoViewGeometry:
    """Return a two-view geometry without inliers for a dropped image pair."""
    none = np.empty(0, np.int64)
    return TwoViewGeometry(reason.value, configuration, num_inliers, none, np.eye(3), np.zeros(3))


def _colmap_options(
    options: VerificationOptions, std_px: float, seed: int
) -> pycolmap.TwoViewGeometryOptions:
    colmap = pycolmap.TwoViewGeometryOptions()
    colmap.min_num_inliers = options.min_inliers
    colmap.min_E_F_inlier_ratio = _MIN_E_F_RATIO
    colmap.max_H_inlier_ratio = _MAX_H_RATIO
    colmap.compute_relative_pose = True
    # COLMAP detects watermarks only for photos from the internet.
    colmap.detect_watermark = False
    ransac = colmap.ransac
    ransac.max_error = options.max_error_px * max(1.0, std_px)
    ransac.min_inlier_ratio = _MIN_INLIER_RATIO
    ransac.max_num_trials = _MAX_TRIALS
    ransac.confidence = _CONFIDENCE
    ransac.random_seed = seed
    return colmap
