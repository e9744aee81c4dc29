"""Evaluation of densification: compare dense depth maps and point cloud with true depth."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from mpsfm_core.data import Float64, MappingProblem, PinholeCamera
from mpsfm_core.dense.densify import densify
from mpsfm_core.dense.fusion import fuse_depth_maps
from mpsfm_core.dense.options import DenseOptions
from mpsfm_core.evaluation.alignment import trajectory_errors
from mpsfm_core.evaluation.cloud_accuracy import cloud_accuracy
from mpsfm_core.evaluation.depth_accuracy import depth_accuracy, mean_accuracy
from mpsfm_core.evaluation.prior_quality import read_depth
from mpsfm_core.evaluation.scene_folder import SceneFolder
from mpsfm_core.evaluation.true_surface import build_true_surface, true_depth_file
from mpsfm_core.geometry.rendering import Geometry
from mpsfm_core.inputs.images import ImageSet
from mpsfm_core.mapping.scene.reconstruction import Reconstruction, hold_out_images
from mpsfm_core.results.held_out import evaluate_geometry, reduce_view
from mpsfm_core.results.original_images import OriginalImages

HELD_OUT_METRICS = ("covered", "psnr", "ssim")
"""Metrics of renderings of held-out images."""


@dataclass(frozen=True, eq=False)
class DenseEvaluation:
    """Settings to densify and evaluate the reconstruction of a test set.

    The cloud is compared with true depth, and rendered at the poses of held-out images
    (``dense.hold_out_every``).
    """

    images: ImageSet
    """Image set that contains all images of the test set."""
    dense: DenseOptions
    """Options of densification."""
    max_points: int
    """Maximum number of points of the fused cloud."""
    scene: SceneFolder
    """Scene folder, with or without true depth maps."""
    distances: tuple[float, ...]
    """Distance thresholds in meters for the accuracy of the point cloud."""

    def evaluate(self, model: Reconstruction, problem: MappingProblem) -> dict[str, Any] | None:
        """Densify a reconstruction; compare with true depth and with held-out images.

        Returns:
            Result of :func:`evaluate_dense_geometry`, with the key ``held_out`` if images are held
            out: the means of :func:`~mpsfm_core.results.held_out.evaluate_geometry`.
        """
        if self.dense.hold_out_every is not None:
            model = hold_out_images(model, self.dense.hold_out_every)
        photos = OriginalImages(self.images, problem)
        dense, _ = densify(model, photos.view, self.dense)
        cloud = fuse_depth_maps(dense, photos.view, self.max_points)
        cameras = {image.name: image.pinhole for image in self.images}
        found = evaluate_dense_geometry(dense, cloud.points, self.scene, cameras, self.distances)
        held_out = {image.name: image for image in dense.images if image.held_out}
        if not held_out:
            return found
        geometry = Geometry(cloud.points, cloud.colors, np.zeros((0, 3), np.int64))
        views = {name: reduce_view(photos.view(name)) for name in held_out}
        depths = {name: image.depth for name, image in held_out.items()}
        rendered = evaluate_geometry(geometry, views, dense.poses, depths)
        return {**(found or {}), "held_out": {key: rendered[key] for key in HELD_OUT_METRICS}}


def evaluate_dense_geometry(
    model: Reconstruction,
    cloud: Float64,
    scene: SceneFolder,
    cameras: Mapping[str, PinholeCamera],
    distances: Sequence[float],
) -> dict[str, Any] | None:
    """Compare depth maps and cloud of a reconstruction with the true depth of a scene.

    A similarity transform of the camera centers aligns the reconstruction. The cloud is compared
    with the points of the true depth maps of the reconstructed images.

    Args:
        model: Reconstruction of the test set with depth maps.
        cloud: (n, 3) points of the dense cloud, world frame of the reconstruction.
        scene: Scene folder.
        cameras: Undistorted cameras of the true depth maps by image name.
        distances: Distance thresholds of the point cloud in meters.

    Returns:
        Plain data: Accuracy by key. The key ``depth`` has the mean depth accuracy over the images.
        The key ``cloud`` has the result of
        :func:`~mpsfm_core.evaluation.cloud_accuracy.cloud_accuracy`. The result is None without
        true depth or with fewer than three cameras.

    Raises:
        InputError: The point cloud is empty, or a true depth map is damaged.
    """
    errors = trajectory_errors(model.poses, scene.truth)
    if errors is None or scene.depth is None:
        return None
    alignment, accuracies = errors.truth_from_estimate, []
    for image in model.images:
        file = true_depth_file(scene.depth, image.name)
        if file.is_file():
            depth = image.depth
            truth = read_depth(file)
            accuracy = depth_accuracy(depth.depth, depth.valid, truth, scale=alignment.scale)
            accuracies += [] if accuracy is None else [accuracy]
    if not accuracies:
        return None
    surface = build_true_surface(
        scene.depth, tuple(model.poses), cameras, scene.truth, min(distances) / 2
    )
    return {
        "depth": mean_accuracy(accuracies),
        "cloud": cloud_accuracy(alignment.apply(cloud), surface, distances),
    }
