"""Trajectory errors after the best similarity transform."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from mpsfm_core.data import Float64, Pose
from mpsfm_core.geometry import camera_center, rotation_angle_deg


@dataclass(frozen=True, eq=False)
class SimilarityTransform:
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
    that centres on a line do no harm. ``steps``: (n - 1,), error of the motion from each image to
    the next, in the order of the truth, after the scale of the alignment; ``step_turns_deg``: of
    its rotation. These two are the relative pose error.
    """

    truth_from_estimate: SimilarityTransform
    centers: Float64
    rotations_deg: Float64
    steps: Float64
    step_turns_deg: Float64

    @property
    def ate_rmse(self) -> float:
        """Absolute trajectory error: root of the mean squared centre error."""
        return _rms(self.centers)

    @property
    def rpe_rmse(self) -> float:
        """Relative pose error: root of the mean squared error of the steps."""
        return _rms(self.steps)

    @property
    def rpe_rmse_deg(self) -> float:
        """The same of their rotations."""
        return _rms(self.step_turns_deg)


def umeyama(a: Float64, b: Float64) -> SimilarityTransform:
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
    return SimilarityTransform(scale, rotation, mean_b - scale * rotation @ mean_a)


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
    have = _steps([estimated[name] for name in names], similarity.scale)
    want = _steps([truth[name] for name in names], 1.0)
    return TrajectoryErrors(
        similarity,
        offsets,
        rotation_angle_deg(turns @ common.T),
        np.linalg.norm(have[1] - want[1], axis=1),
        rotation_angle_deg(have[0] @ want[0].transpose(0, 2, 1)),
    )


def _steps(poses: Sequence[Pose], scale: float) -> Pose:
    """``b_from_a`` of each image and the next: rotations (n - 1, 3, 3), translations (n - 1, 3)."""
    rotations = np.stack([rotation for rotation, _ in poses])
    translations = scale * np.stack([translation for _, translation in poses])
    relative = rotations[1:] @ rotations[:-1].transpose(0, 2, 1)
    return relative, translations[1:] - np.einsum("nij,nj->ni", relative, translations[:-1])


def _rms(values: Float64) -> float:
    return float(np.sqrt((values**2).mean()))
