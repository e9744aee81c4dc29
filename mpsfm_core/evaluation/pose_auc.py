"""Pose AUC: area under the recall curve of relative pose errors.

Papers differ in three choices that change the pose AUC by several percentage points, namely the
counted pairs, the sign of the translation, and the integration of the recall curve. A
:class:`PoseConvention` specifies these choices, and :data:`CONVENTIONS` lists common conventions.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from mpsfm_core.data import Float64, Int64, Pose
from mpsfm_core.geometry import angle_between_deg, rotation_angle_deg

THRESHOLDS_DEG = (1, 5, 20)
"""Thresholds of the pose AUC in degrees [paper, tables]."""
UNREGISTERED_DEG = 180.0
"""Pose error in degrees of an image pair with an unregistered image."""
_BLOCK_PAIRS = 1_000_000
"""Number of image pairs whose errors are computed at once, which limits the memory."""


@dataclass(frozen=True)
class PoseConvention:
    """Convention of the pose AUC for image pairs, translation sign and integration."""

    name: str
    """Name of the convention on the command line."""
    description: str
    """Description for reports."""
    ordered: bool
    """Count both orders (a, b) and (b, a) of a pair, whose translation errors differ."""
    folded: bool
    """Ignore the sign of the translation, so that its error is at most 90 degrees."""
    area: Callable[[Float64, int], float]
    """``area(errors, threshold)``: normalized area under the recall curve, in [0, 1]."""
    every_model: bool = False
    """Evaluate image pairs within each model; if False, only pairs within the largest model."""


def exact_area(errors: Float64, threshold: int) -> float:
    """Integrate the empirical recall curve exactly: mean of ``max(0, 1 - error / threshold)``."""
    return float(np.maximum(0.0, 1.0 - errors / threshold).mean())


def interpolated_area(errors: Float64, threshold: float) -> float:
    """Integrate the linearly interpolated recall curve, as SuperGlue and COLMAP's benchmark do.

    The interpolated area is never below :func:`exact_area`.
    """
    ordered = np.sort(errors)
    below = ordered[ordered <= threshold]
    recall = np.arange(len(below) + 1) / len(errors)
    x = np.concatenate([[0.0], below, [threshold]])
    y = np.concatenate([recall, recall[-1:]])
    return float((np.diff(x) * (y[1:] + y[:-1])).sum() / (2 * threshold))


def histogram_area(errors: Float64, threshold: int) -> float:
    """Average the recalls at all integer errors up to `threshold` degrees, as VGGT does.

    An error that is an integer counts for the next one-degree bin, except in the last bin.
    """
    counts, _ = np.histogram(errors, bins=np.arange(threshold + 1))
    return float(np.cumsum(counts).mean() / len(errors))


CONVENTIONS: Mapping[str, PoseConvention] = MappingProxyType(
    {
        convention.name: convention
        for convention in (
            PoseConvention(
                "paper",
                "ordered pairs, error = max(rotation, translation direction folded to 90 deg), "
                "unregistered = 180 deg, exact area under the recall curve",
                ordered=True,
                folded=True,
                area=exact_area,
            ),
            PoseConvention(
                "models",
                "as `paper`, but pairs within any one model count, not only within the largest",
                ordered=True,
                folded=True,
                area=exact_area,
                every_model=True,
            ),
            PoseConvention(
                "colmap",
                "COLMAP benchmark: ordered pairs, error = max(rotation, translation direction), "
                "unregistered = 180 deg, area under the interpolated recall curve",
                ordered=True,
                folded=False,
                area=interpolated_area,
            ),
            PoseConvention(
                "vggt",
                "VGGT: unordered pairs, error = max(rotation, translation direction folded to "
                "90 deg), unregistered = 180 deg, mean recall at whole degrees",
                ordered=False,
                folded=True,
                area=histogram_area,
            ),
        )
    }
)


def pose_errors_deg(
    estimated: Mapping[str, Pose], truth: Mapping[str, Pose], convention: PoseConvention
) -> Float64:
    """Compute the errors of the relative poses of all pairs of images.

    The translation error of a pair with coinciding true centers is 0.

    Args:
        estimated: Estimated poses ``cam_from_world`` by image name; missing images are
            unregistered.
        truth: True poses ``cam_from_world`` by image name, at least two.
        convention: Convention, see :data:`CONVENTIONS`.

    Returns:
        (pairs,) float64 pose errors in [0, 180] degrees, sorted by first, then second image in
        `truth`.
    """
    names = list(truth)
    count = len(names)
    first, second = np.nonzero(
        ~np.eye(count, dtype=bool) if convention.ordered else np.triu(np.ones((count, count)), 1)
    )
    registered = np.array([name in estimated for name in names])
    known = np.flatnonzero(registered[first] & registered[second])
    errors = np.full(len(first), UNREGISTERED_DEG)
    poses = _stack([estimated.get(name, truth[name]) for name in names])
    true_poses = _stack([truth[name] for name in names])
    for start in range(0, len(known), _BLOCK_PAIRS):
        pairs = known[start : start + _BLOCK_PAIRS]
        relative = _relative_poses(poses, first[pairs], second[pairs])
        true_relative = _relative_poses(true_poses, first[pairs], second[pairs])
        rotation = rotation_angle_deg(relative[0] @ true_relative[0].transpose(0, 2, 1))
        translation = angle_between_deg(relative[1], true_relative[1])
        if convention.folded:
            translation = np.minimum(translation, 180.0 - translation)
        errors[pairs] = np.maximum(rotation, translation)
    return errors


def pose_auc(
    errors_deg: Float64,
    convention: PoseConvention,
    thresholds: Sequence[int] = THRESHOLDS_DEG,
) -> dict[int, float]:
    """Compute the pose AUC at each threshold.

    Args:
        errors_deg: (pairs,) pose errors in degrees; concatenate the errors of several scenes to
            pool scenes.
        convention: Convention that defines the integration of the recall curve.
        thresholds: Thresholds in degrees.

    Returns:
        Pose AUC in [0, 1] by threshold in degrees.

    Raises:
        ValueError: The array `errors` is empty.
    """
    if len(errors_deg) == 0:
        raise ValueError("no image pairs to evaluate")
    return {threshold: convention.area(errors_deg, threshold) for threshold in thresholds}


def _stack(poses: Sequence[Pose]) -> Pose:
    """Stack poses to rotations (n, 3, 3) and translations (n, 3)."""
    return np.stack([pose[0] for pose in poses]), np.stack([pose[1] for pose in poses])


def _relative_poses(poses: Pose, first: Int64, second: Int64) -> Pose:
    """Compute relative poses ``second_from_first``: rotations (n, 3, 3), translations (n, 3)."""
    rotations, translations = poses
    relative = rotations[second] @ rotations[first].transpose(0, 2, 1)
    moved = np.einsum("nij,nj->ni", relative, translations[first])
    return relative, translations[second] - moved
