"""Evaluation of estimated poses: pose AUC and trajectory errors in one report."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from mpsfm_core.data import Pose
from mpsfm_core.data.errors import InputError
from mpsfm_core.evaluation.alignment import trajectory_errors
from mpsfm_core.evaluation.pose_auc import (
    CONVENTIONS,
    PoseConvention,
    pose_auc,
    pose_errors_deg,
)
from mpsfm_core.inputs.models import match_names


def evaluate(
    estimated: Mapping[str, Pose],
    truth: Mapping[str, Pose],
    images: Sequence[str] | None = None,
    convention: PoseConvention = CONVENTIONS["paper"],
) -> dict[str, Any]:
    """Compare estimated poses with true poses.

    Args:
        estimated: Estimated poses ``cam_from_world`` by image name.
        truth: True poses ``cam_from_world`` by image name.
        images: Names of the images to evaluate, extension optional; all images of `truth` by
            default.
        convention: Convention of the pose AUC for image pairs, translation sign and integration.

    Returns:
        Report of pose AUC and trajectory errors as plain data for JSON.

    Raises:
        InputError: An image has no true pose, or fewer than two images remain.
    """
    names = list(truth) if images is None else _match_images(images, truth)
    if len(names) < 2:
        raise InputError(f"ground truth: at least two images are needed, got {len(names)}")
    reference = {name: truth[name] for name in names}
    poses = {name: estimated[found] for name, found in match_names(names, estimated).items()}
    errors = pose_errors_deg(poses, reference, convention)
    trajectory = trajectory_errors(poses, reference)
    areas = pose_auc(errors, convention)
    return {
        "convention": convention.name,
        "convention_description": convention.description,
        "images": len(names),
        "registered": len(poses),
        "registered_share": len(poses) / len(names),
        "unregistered": [name for name in names if name not in poses],
        "pairs": len(errors),
        "auc_unit": "percent",
        "auc": {str(threshold): 100 * area for threshold, area in areas.items()},
        "trajectory": None if trajectory is None else trajectory.summarize(),
    }


def _match_images(images: Sequence[str], truth: Mapping[str, Pose]) -> list[str]:
    """Return the unique names in `truth` that match the given names."""
    matched = match_names(images, truth)
    missing = [name for name in images if name not in matched]
    if missing:
        raise InputError(
            f"ground truth: no image (or several images) with the name {', '.join(missing)}"
        )
    return list(dict.fromkeys(matched.values()))
