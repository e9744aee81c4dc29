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
from mpsfm_core.geometry.two_view import estimate_two_view_geometry

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
_SAMPLE_SIZE = 5
"""Number of matches in a minimal sample for an essential matrix."""


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
    max_error_px = options.max_error_px * max(1.0, std_px)
    geometry = estimate_two_view_geometry(
        camera_a,
        camera_b,
        xy_a,
        xy_b,
        max_error_px=max_error_px,
        min_inlier_ratio=_MIN_INLIER_RATIO,
        min_inliers=options.min_inliers,
        seed=seed,
    )
    inliers = np.asarray(geometry.inlier_matches)[:, 0].astype(np.int64)
    if geometry.config not in _USABLE:
        name = _Configuration(geometry.config).name.lower()
        return _dropped(PairReason.DEGENERATE, name, len(inliers))
    configuration = _USABLE[geometry.config]
    if len(inliers) < options.min_inliers:
        return _dropped(PairReason.TOO_FEW_INLIERS, configuration, len(inliers))
    chance = _chance_of_inliers(len(inliers), len(xy_a), camera_b, max_error_px)
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
