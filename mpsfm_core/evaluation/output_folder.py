"""Depth and points of an output folder of ours, compared with the truth."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path, PurePosixPath
from typing import Any

from mpsfm_core.data import Pose
from mpsfm_core.errors import InputError
from mpsfm_core.evaluation.alignment import trajectory_errors
from mpsfm_core.evaluation.cloud_accuracy import cloud_accuracy, read_ply
from mpsfm_core.evaluation.depth_accuracy import depth_accuracy, mean_accuracy
from mpsfm_core.evaluation.prior_quality import read_depth
from mpsfm_core.results.depth_maps import load_depth_map


def evaluate_depth(output: Path, truth: Path) -> dict[str, Any]:
    """Refined depth maps against 16-bit PNG in millimetres named as the photos.

    Returns the means over images, ``raw`` (only for results in metres meaningful) and
    ``median_scaled``. Raises :class:`InputError` when no map has a true one.
    """
    found: dict[bool, list[Any]] = {True: [], False: []}
    for path in sorted((output / "depth").rglob("*.npz")):
        photo = PurePosixPath(path.relative_to(output / "depth").as_posix()).with_suffix("")
        file = truth / photo.with_suffix(".png")
        if not file.is_file():
            continue
        arrays = load_depth_map(path)
        if not {"depth", "valid"} <= arrays.keys():
            raise InputError(f"{path}: is no depth map of a run")
        depth, valid = arrays["depth"], arrays["valid"]
        true = read_depth(file)
        for scaled in found:
            accuracy = depth_accuracy(depth, valid, true, median_scaled=scaled)
            if accuracy is not None:
                found[scaled].append(accuracy)
    if not found[True]:
        raise InputError(f"{output / 'depth'}: no depth map has a true one in {truth}")
    return {"raw": mean_accuracy(found[False]), "median_scaled": mean_accuracy(found[True])}


def evaluate_cloud(
    cloud: Path, scan: Path, estimated: Mapping[str, Pose], truth: Mapping[str, Pose]
) -> dict[str, Any]:
    """A cloud in the frame of ``estimated`` against a scan in that of ``truth``.

    The frames are aligned by the cameras' centres. Raises :class:`InputError` when that is not
    possible, or a file cannot be read or has no points.
    """
    errors = trajectory_errors(estimated, truth)
    if errors is None:
        raise InputError("the cloud cannot be aligned: fewer than three common cameras")
    points, true_points = read_ply(cloud), read_ply(scan)
    for path, found in ((cloud, points), (scan, true_points)):
        if not len(found):
            raise InputError(f"{path} has no points, there is nothing to compare")
    return cloud_accuracy(errors.truth_from_estimate.apply(points), true_points)
