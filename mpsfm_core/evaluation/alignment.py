"""Trajectory errors of a reconstruction after similarity alignment with the true poses."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from mpsfm_core.data import Float64, Pose
from mpsfm_core.geometry import camera_center, rotation_angle_deg
from mpsfm_core.geometry.similarity import SimilarityTransform, umeyama


@dataclass(frozen=True, eq=False)
class TrajectoryErrors:
    """Errors of camera centers and orientations after alignment, in the unit of the true poses."""

    truth_from_estimate: SimilarityTransform
    """Similarity transform that aligns the camera centers in the least-squares sense."""
    centers: Float64
    """(n,) distances between aligned and true camera centers."""
    rotations_deg: Float64
    """(n,) orientation errors after the best common rotation.

    Only orientations determine the common rotation, so collinear camera centers cause no error."""
    steps: Float64
    """(n - 1,) translation errors of the relative poses of successive images."""
    step_turns_deg: Float64
    """(n - 1,) rotation errors of the relative poses of successive images."""

    @property
    def ate_rmse(self) -> float:
        """Absolute trajectory error: RMSE between aligned and true camera centers."""
        return _rms(self.centers)

    @property
    def rpe_rmse(self) -> float:
        """Relative pose error: RMSE of the relative translations between successive images."""
        return _rms(self.steps)

    @property
    def rpe_rmse_deg(self) -> float:
        """Relative pose error: RMSE of the relative rotations between successive images."""
        return _rms(self.step_turns_deg)

    def summarize(self) -> dict[str, float]:
        """Compute RMSE, median and maximum of the errors for a report."""
        return {
            "ate_rmse": self.ate_rmse,
            "ate_median": float(np.median(self.centers)),
            "ate_max": float(self.centers.max()),
            "rpe_rmse": self.rpe_rmse,
            "rpe_rmse_deg": self.rpe_rmse_deg,
            "rotation_median_deg": float(np.median(self.rotations_deg)),
            "rotation_max_deg": float(self.rotations_deg.max()),
            "scale": self.truth_from_estimate.scale,
        }


def trajectory_errors(
    estimated: Mapping[str, Pose], truth: Mapping[str, Pose]
) -> TrajectoryErrors | None:
    """Compute the trajectory errors of the images with estimated and true pose.

    Returns:
        The trajectory errors, or None if fewer than three images have both poses, or if camera
        centers coincide.
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
    # The model is R_est = R_true @ G with a common rotation G; projecting the sum of R_true.T @
    # R_est to SO(3) gives the chordal mean of G.
    turns = np.stack([truth[name][0].T @ estimated[name][0] for name in names])
    u, _, vt = np.linalg.svd(turns.sum(axis=0))
    common = (u * [1.0, 1.0, np.linalg.det(u) * np.linalg.det(vt)]) @ vt
    steps = _steps([estimated[name] for name in names], similarity.scale)
    true_steps = _steps([truth[name] for name in names], 1.0)
    return TrajectoryErrors(
        similarity,
        offsets,
        rotation_angle_deg(turns @ common.T),
        np.linalg.norm(steps[1] - true_steps[1], axis=1),
        rotation_angle_deg(steps[0] @ true_steps[0].transpose(0, 2, 1)),
    )


def _steps(poses: Sequence[Pose], scale: float) -> Pose:
    """Compute rotations (n - 1, 3, 3) and translations ``a_from_b`` of successive images a, b."""
    rotations = np.stack([rotation for rotation, _ in poses])
    translations = scale * np.stack([translation for _, translation in poses])
    relative = rotations[:-1] @ rotations[1:].transpose(0, 2, 1)
    return relative, translations[:-1] - np.einsum("nij,nj->ni", relative, translations[1:])


def _rms(values: Float64) -> float:
    return float(np.sqrt((values**2).mean()))
