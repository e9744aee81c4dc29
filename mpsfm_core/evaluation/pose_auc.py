"""Pose AUC: how many relative poses are right, and how right, in one number a threshold.

Papers differ in three choices that move the number by several points: which pairs count, whether
the sign of the translation counts, and how the area under the recall curve is taken. A
:class:`PoseConvention` names one set of choices; :data:`CONVENTIONS` holds those in use.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from mpsfm_core.data import Float64, Pose
from mpsfm_core.geometry import angle_between_deg, rotation_angle_deg

THRESHOLDS_DEG = (1, 5, 20)
"""The thresholds of the paper's tables."""

UNREGISTERED_DEG = 180.0
"""Error of a pair of which an image has no pose."""


@dataclass(frozen=True)
class PoseConvention:
    """One way to turn poses into a number.

    ``ordered``: (a, b) and (b, a) both count, their translation errors differ. ``folded``: the
    translation's sign is free, its error is at most 90 deg. ``area(errors, threshold)``: area
    under the recall curve from 0 to the threshold, divided by the threshold, in [0, 1].
    ``every_model``: a pair counts as registered if both images are in one model, whichever; else
    only those of the largest model count.
    """

    name: str
    description: str
    ordered: bool
    folded: bool
    area: Callable[[Float64, int], float]
    every_model: bool = False


def exact_area(errors: Float64, threshold: int) -> float:
    """Area under the empirical recall curve, a step function: mean of ``max(0, 1 - e / t)``."""
    return float(np.maximum(0.0, 1.0 - errors / threshold).mean())


def interpolated_area(errors: Float64, threshold: int) -> float:
    """Area under straight lines between (0, 0) and the steps' upper corners.

    What SuperGlue's and COLMAP's benchmarks take; never below :func:`exact_area`.
    """
    ordered = np.sort(errors)
    below = ordered[ordered <= threshold]
    recall = np.arange(len(below) + 1) / len(errors)
    x = np.concatenate([[0.0], below, [threshold]])
    y = np.concatenate([recall, recall[-1:]])
    return float((np.diff(x) * (y[1:] + y[:-1])).sum() / (2 * threshold))


def histogram_area(errors: Float64, threshold: int) -> float:
    """Mean of the recalls at 1, 2, ... ``threshold`` degrees (a whole number).

    What PoseDiffusion and VGGT take; errors equal to a bin's end count for the next bin, in the
    last one for itself.
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
    """Errors of the relative poses of all pairs of the images in ``truth``.

    Args:
        estimated: poses by image name; images of ``truth`` that are not here are unregistered.
        truth: poses by image name, two at least. convention: see :data:`CONVENTIONS`.

    Returns:
        (pairs,) float64, degrees in [0, 180]; in the order of ``truth``, first image slowest.
        Where two true centres coincide the translation has no direction and counts as right.
    """
    names = list(truth)
    count = len(names)
    first, second = np.nonzero(
        ~np.eye(count, dtype=bool) if convention.ordered else np.triu(np.ones((count, count)), 1)
    )
    registered = np.array([name in estimated for name in names])
    known = registered[first] & registered[second]
    errors = np.full(len(first), UNREGISTERED_DEG)
    if known.any():
        poses = [estimated.get(name, truth[name]) for name in names]
        have = _relative(poses, first[known], second[known])
        want = _relative([truth[name] for name in names], first[known], second[known])
        rotation = rotation_angle_deg(have[0] @ want[0].transpose(0, 2, 1))
        translation = angle_between_deg(have[1], want[1])
        if convention.folded:
            translation = np.minimum(translation, 180.0 - translation)
        errors[known] = np.maximum(rotation, translation)
    return errors


def pose_auc(
    errors_deg: Float64,
    convention: PoseConvention,
    thresholds: Sequence[int] = THRESHOLDS_DEG,
) -> dict[int, float]:
    """Threshold in degrees -> area under the recall curve up to it, in [0, 1].

    Errors of several scenes are pooled by concatenating them. Raises ``ValueError`` without any.
    """
    if len(errors_deg) == 0:
        raise ValueError("no pairs to evaluate")
    return {threshold: convention.area(errors_deg, threshold) for threshold in thresholds}


def _relative(poses: Sequence[Pose], first: Float64, second: Float64) -> Pose:
    """``second_from_first`` of pairs: rotations (n, 3, 3) and translations (n, 3)."""
    rotations = np.stack([rotation for rotation, _ in poses])
    translations = np.stack([translation for _, translation in poses])
    relative = rotations[second] @ rotations[first].transpose(0, 2, 1)
    moved = np.einsum("nij,nj->ni", relative, translations[first])
    return relative, translations[second] - moved
