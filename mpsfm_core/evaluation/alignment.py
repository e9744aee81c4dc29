"""Trajectory errors after the best similarity transform."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from mpsfm_core.data import Float64
from mpsfm_core.evaluation.pose_auc import Pose
from mpsfm_core.geometry import camera_center, rotation_angle_deg


@dataclass(frozen=True, eq=False)
class Similarity:
    """``x_b = scale * rotation @ x_a + translation``; (3, 3), (3,), > 0."""

    scale: float
    rotation: Float64
    translation: Float64

    def apply(self, points: Float64) -> Float64:
        """Points (n, 3) of frame a in frame b."""
        moved: Float64 = self.scale * points @ self.rotation.T + self.translation
        return moved


@dataclass(frozen=True, eq=False)
class TrajectoryErrors:
    """Errors of camera centres and orientations after alignment, in the truth's unit and degrees.

    ``centers``: (n,), after ``truth_from_estimate``, which has the least squared error over the
    centres. ``rotations_deg``: (n,), after the best common rotation of the orientations alone, so
    that centres on a line do no harm.
    """

    truth_from_estimate: Similarity
    centers: Float64
    rotations_deg: Float64

    @property
    def ate_rmse(self) -> float:
        """Absolute trajectory error: root of the mean squared centre error."""
        return float(np.sqrt((self.centers**2).mean()))


def umeyama(a: Float64, b: Float64) -> Similarity:
    """The similarity from points a (n, 3) to points b (n, 3) with the least squared error.

    Umeyama, PAMI 1991. Raises ``ValueError`` when all points of either set coincide, where the
    scale has no meaning.
    """
    mean_a, mean_b = a.mean(axis=0), b.mean(axis=0)
    spread_a, spread_b = a - mean_a, b - mean_b
    if not (spread_a.any() and spread_b.any()):
        raise ValueError("all points coincide")
    u, singular, vt = np.linalg.svd(spread_b.T @ spread_a)
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(u) * np.linalg.det(vt))])
    rotation = (u * signs) @ vt
    scale = float((singular * signs).sum() / (spread_a**2).sum())
    return Similarity(scale, rotation, mean_b - scale * rotation @ mean_a)


def trajectory_errors(
    estimated: Mapping[str, Pose], truth: Mapping[str, Pose]
) -> TrajectoryErrors | None:
    """Errors of the images that both have, in the order of ``truth``.

    None with fewer than three common images or coinciding centres: nothing can be aligned.
    """
    names = [name for name in truth if name in estimated]
    if len(names) < 3:
        return None
    centers = np.stack([camera_center(*estimated[name]) for name in names])
    true_centers = np.stack([camera_center(*truth[name]) for name in names])
    try:
        similarity = umeyama(centers, true_centers)
    except ValueError:
        return None
    offsets = np.linalg.norm(similarity.apply(centers) - true_centers, axis=1)
    # R_est = R_true @ G for a common G; its chordal mean is the projection of the sum.
    turns = np.stack([truth[name][0].T @ estimated[name][0] for name in names])
    u, _, vt = np.linalg.svd(turns.sum(axis=0))
    common = (u * [1.0, 1.0, np.linalg.det(u) * np.linalg.det(vt)]) @ vt
    return TrajectoryErrors(similarity, offsets, rotation_angle_deg(turns @ common.T))
