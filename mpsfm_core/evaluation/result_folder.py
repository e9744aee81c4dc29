"""Depth and points of an output folder of ours, compared with the truth."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

from mpsfm_core.data import Float64, Pose
from mpsfm_core.data.errors import InputError
from mpsfm_core.evaluation.alignment import trajectory_errors
from mpsfm_core.evaluation.cloud_accuracy import TOLERANCES, cloud_accuracy
from mpsfm_core.evaluation.depth_accuracy import DepthAccuracy, depth_accuracy, mean_accuracy
from mpsfm_core.evaluation.prior_quality import read_depth
from mpsfm_core.evaluation.read_true_surface import build_true_surface, true_depth_file
from mpsfm_core.inputs.models import read_model, reconstruction_poses
from mpsfm_core.inputs.undistortion import undistort_camera
from mpsfm_core.results.depth_maps import load_depth_map
from mpsfm_core.results.ply import read_ply


def evaluate_depth(output: Path, truth: Path) -> dict[str, Any]:
    """Refined depth maps against 16-bit PNG in millimetres named as the photos.

    Returns the means over images, ``raw`` (only for results in metres meaningful) and
    ``median_scaled``. Raises :class:`InputError` when no map has a true one.
    """
    scales = {"raw": 1.0, "median_scaled": None}
    found: dict[str, list[DepthAccuracy]] = {name: [] for name in scales}
    for path in sorted((output / "depth").rglob("*.npz")):
        file = true_depth_file(truth, path.relative_to(output / "depth").with_suffix("").as_posix())
        if not file.is_file():
            continue
        arrays = load_depth_map(path)
        if not {"depth", "valid"} <= arrays.keys():
            raise InputError(f"{path}: is no depth map of a run")
        depth, valid = arrays["depth"], arrays["valid"]
        true = read_depth(file)
        for name, scale in scales.items():
            accuracy = depth_accuracy(depth, valid, true, scale=scale)
            if accuracy is not None:
                found[name].append(accuracy)
    if not found["raw"]:
        raise InputError(f"{output / 'depth'}: no depth map has a true one in {truth}")
    return {name: mean_accuracy(each) for name, each in found.items()}


def evaluate_cloud(
    cloud: Path,
    truth: Float64,
    estimated: Mapping[str, Pose],
    true_poses: Mapping[str, Pose],
    tolerances: Sequence[float] = TOLERANCES,
) -> dict[str, Any]:
    """A cloud in the frame of ``estimated`` against points (n, 3) in that of ``true_poses``.

    The frames are aligned by the cameras' centres. ``tolerances``: in the unit of the truth.
    Raises :class:`InputError` when that is not possible, or the cloud has no points.
    """
    errors = trajectory_errors(estimated, true_poses)
    if errors is None:
        raise InputError("the cloud cannot be aligned: fewer than three common cameras")
    points = read_points(cloud)
    return cloud_accuracy(errors.truth_from_estimate.apply(points), truth, tolerances)


def read_points(path: Path) -> Float64:
    """Points (n, 3) of a PLY file; raises :class:`InputError` when it has none."""
    points, _ = read_ply(path)
    if not len(points):
        raise InputError(f"{path} has no points, there is nothing to compare")
    return points


def read_true_surface(
    model: Path, depth: Path, images: Collection[str], tolerances: Sequence[float] = TOLERANCES
) -> Float64:
    """What :func:`build_true_surface` says with the cameras and poses of a true model."""
    true = read_model(model)
    cameras = {
        str(image.name): undistort_camera(true.cameras[image.camera_id], 0.0)
        for image in true.images.values()
    }
    return build_true_surface(
        depth, images, cameras, reconstruction_poses(true), min(tolerances) / 2
    )
