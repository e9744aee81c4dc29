"""Reads COLMAP models and compares two of them by image name."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
import pycolmap

from mpsfm_core.errors import InputError
from mpsfm_core.evaluation.alignment import TrajectoryErrors, trajectory_errors
from mpsfm_core.evaluation.pose_auc import (
    CONVENTIONS,
    Pose,
    PoseConvention,
    pose_auc,
    pose_errors_deg,
)


def read_poses(folder: Path) -> dict[str, Pose]:
    """``cam_from_world`` of the registered images of a COLMAP model, by image name.

    Raises what :func:`model_folder` and :func:`read_model` raise.
    """
    return reconstruction_poses(read_model(model_folder(folder)))


def model_folder(folder: Path) -> Path:
    """Where a COLMAP model (binary or text) lies: here, in ``sparse`` or in ``sparse/0``.

    Raises :class:`~mpsfm_core.errors.InputError` when there is none.
    """
    for candidate in (folder, folder / "sparse", folder / "sparse" / "0"):
        if any((candidate / f"images.{suffix}").is_file() for suffix in ("bin", "txt")):
            return candidate
    raise InputError(f"{folder}: no COLMAP model here (images.bin or images.txt)")


def read_model(folder: Path) -> pycolmap.Reconstruction:
    """A COLMAP model; raises :class:`~mpsfm_core.errors.InputError` when it cannot be read."""
    try:
        return pycolmap.Reconstruction(str(folder))
    except (RuntimeError, ValueError, IndexError) as error:
        raise InputError(f"{folder}: not a readable COLMAP model: {error}") from error


def reconstruction_poses(model: pycolmap.Reconstruction) -> dict[str, Pose]:
    """``cam_from_world`` of the registered images, by name, in the order of their names."""
    poses = {}
    for image in sorted(model.images.values(), key=lambda image: str(image.name)):
        if image.has_pose:
            matrix = np.asarray(image.cam_from_world().matrix(), dtype=np.float64)
            poses[str(image.name)] = (matrix[:, :3], matrix[:, 3])
    return poses


def match_names(wanted: Iterable[str], available: Iterable[str]) -> dict[str, str]:
    """Wanted name -> the one available name that equals it, with or without the extension.

    Lists of images in the wild hold stems. Names that nothing or more than one thing answers to
    are left out, and an available name that is itself wanted answers to no other.
    """
    asked, names = list(wanted), set(available)
    by_stem: dict[str, list[str]] = {}
    for name in names - set(asked):
        by_stem.setdefault(_stem(name), []).append(name)
    matched = {}
    for name in asked:
        loose = by_stem.get(name) or by_stem.get(_stem(name), [])
        candidates = [name] if name in names else loose
        if len(candidates) == 1:
            matched[name] = candidates[0]
    return matched


def evaluate(
    estimated: Mapping[str, Pose],
    truth: Mapping[str, Pose],
    images: Sequence[str] | None = None,
    convention: PoseConvention = CONVENTIONS["paper"],
) -> dict[str, Any]:
    """Compare poses with the truth; plain data, ready for JSON.

    Args:
        estimated: poses by image name. truth: poses by image name. images: the names to evaluate
            (extension optional), all of ``truth`` by default. convention: of the pose AUC.

    Raises:
        InputError: an image is not in the truth, or fewer than two images are left.
    """
    names = list(truth) if images is None else _choose(images, truth)
    if len(names) < 2:
        raise InputError(f"ground truth: at least two images are needed, got {len(names)}")
    reference = {name: truth[name] for name in names}
    poses = {name: estimated[found] for name, found in match_names(names, estimated).items()}
    errors = pose_errors_deg(poses, reference, convention)
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
        "trajectory": _describe(trajectory_errors(poses, reference)),
    }


def _choose(images: Sequence[str], truth: Mapping[str, Pose]) -> list[str]:
    """The names in ``truth`` that ``images`` means, each once."""
    matched = match_names(images, truth)
    missing = [name for name in images if name not in matched]
    if missing:
        raise InputError(f"ground truth: no image (or more than one) called {', '.join(missing)}")
    return list(dict.fromkeys(matched.values()))


def _describe(errors: TrajectoryErrors | None) -> dict[str, float] | None:
    if errors is None:
        return None
    return {
        "ate_rmse": errors.ate_rmse,
        "ate_median": float(np.median(errors.centers)),
        "ate_max": float(errors.centers.max()),
        "rpe_rmse": errors.rpe_rmse,
        "rpe_rmse_deg": errors.rpe_rmse_deg,
        "rotation_median_deg": float(np.median(errors.rotations_deg)),
        "rotation_max_deg": float(errors.rotations_deg.max()),
        "scale": errors.truth_from_estimate.scale,
    }


def _stem(name: str) -> str:
    return str(PurePosixPath(name).with_suffix(""))
