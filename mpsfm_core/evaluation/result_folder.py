"""Evaluation of the depth maps and the dense cloud of a result folder."""

from __future__ import annotations

import json
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

from mpsfm_core.data import Float64, Pose
from mpsfm_core.data.errors import InputError
from mpsfm_core.data.result_layout import SUMMARY
from mpsfm_core.evaluation.alignment import trajectory_errors
from mpsfm_core.evaluation.cloud_accuracy import TOLERANCES, cloud_accuracy
from mpsfm_core.evaluation.depth_accuracy import DepthAccuracy, depth_accuracy, mean_accuracy
from mpsfm_core.evaluation.true_surface import build_true_surface, read_true_depth, true_depth_file
from mpsfm_core.inputs.models import read_model, reconstruction_poses
from mpsfm_core.inputs.undistortion import undistort_camera
from mpsfm_core.results.depth_maps import load_depth_map
from mpsfm_core.results.ply import read_ply


def find_photos(output: Path) -> Path | None:
    """Return the photo folder that ``summary.json`` records, or None if the folder is missing."""
    try:
        recorded = json.loads((output / SUMMARY).read_text(encoding="utf-8")).get("photos")
    except (OSError, ValueError, AttributeError, RecursionError):
        return None
    return Path(recorded) if isinstance(recorded, str) and Path(recorded).is_dir() else None


def evaluate_depth(output: Path, truth: Path, photos: Path | None = None) -> dict[str, Any]:
    """Compare the depth maps of a result folder with true depth.

    Args:
        output: Result folder.
        truth: Folder of true depth maps as 16-bit PNG files in millimeters, named like the images.
        photos: Folder of the photos. If the photo folder is given, true depth maps of EXIF-rotated
            photos are rotated upright.

    Returns:
        Means over images: Depth accuracy without scaling (``raw``, only for results in meters) and
        after scaling each map to the true median (``median_scaled``).

    Raises:
        InputError: No depth map of the results has a true depth map.
    """
    scales = {"raw": 1.0, "median_scaled": None}
    accuracies: dict[str, list[DepthAccuracy]] = {name: [] for name in scales}
    for path in sorted((output / "depth").rglob("*.npz")):
        image = path.relative_to(output / "depth").with_suffix("").as_posix()
        if not true_depth_file(truth, image).is_file():
            continue
        arrays = load_depth_map(path)
        if not {"depth", "valid"} <= arrays.keys():
            raise InputError(f"{path}: the file is not a depth map of mpsfm")
        depth, valid = arrays["depth"], arrays["valid"]
        true = read_true_depth(truth, image, (depth.shape[1], depth.shape[0]), photos)
        if true is None:
            continue
        for name, scale in scales.items():
            accuracy = depth_accuracy(depth, valid, true, scale=scale)
            if accuracy is not None:
                accuracies[name].append(accuracy)
    if not accuracies["raw"]:
        raise InputError(
            f"{output / 'depth'}: no depth map of the results has a true depth map in {truth}"
        )
    return {name: mean_accuracy(images) for name, images in accuracies.items()}


def evaluate_cloud(
    cloud: Path,
    truth: Float64,
    estimated: Mapping[str, Pose],
    true_poses: Mapping[str, Pose],
    tolerances: Sequence[float] = TOLERANCES,
) -> dict[str, Any]:
    """Align a point cloud by the camera centers and compare the cloud with a scan.

    Args:
        cloud: PLY file in the frame of the estimated poses.
        truth: (n, 3) points of the scan in the frame of the true poses.
        estimated: Estimated poses ``cam_from_world`` by image name.
        true_poses: True poses ``cam_from_world`` by image name.
        tolerances: Distance thresholds in the unit of the true poses.

    Raises:
        InputError: Fewer than three images have an estimated and a true pose, or the cloud is
            empty.
    """
    errors = trajectory_errors(estimated, true_poses)
    if errors is None:
        raise InputError("the cloud cannot be aligned: fewer than three common cameras")
    points = read_points(cloud)
    return cloud_accuracy(errors.truth_from_estimate.apply(points), truth, tolerances)


def read_points(path: Path) -> Float64:
    """Read the points (n, 3) of a PLY file.

    Raises:
        InputError: The PLY file has no points.
    """
    points, _ = read_ply(path)
    if not len(points):
        raise InputError(f"{path}: the file has no points to compare")
    return points


def read_true_surface(
    model: Path,
    depth: Path,
    images: Collection[str],
    tolerances: Sequence[float] = TOLERANCES,
    photos: Path | None = None,
) -> Float64:
    """Sample the true surface of a scene with the cameras and poses of the true model."""
    true = read_model(model, photos)
    cameras = {
        str(image.name): undistort_camera(true.cameras[image.camera_id])
        for image in true.images.values()
    }
    return build_true_surface(
        depth, images, cameras, reconstruction_poses(true), min(tolerances) / 2, photos
    )
