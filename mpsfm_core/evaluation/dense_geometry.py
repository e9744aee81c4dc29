"""Depth and surface that are measured in the photos of a mapped set, against its true depth."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from mpsfm_core.data import Float64, MappingProblem, PinholeCamera
from mpsfm_core.dense.densify import densify
from mpsfm_core.dense.fusion import fuse_depth_maps
from mpsfm_core.dense.options import DenseOptions
from mpsfm_core.evaluation.alignment import trajectory_errors
from mpsfm_core.evaluation.cloud_accuracy import cloud_accuracy
from mpsfm_core.evaluation.depth_accuracy import depth_accuracy, mean_accuracy
from mpsfm_core.evaluation.prior_quality import read_depth
from mpsfm_core.evaluation.read_true_surface import build_true_surface, true_depth_file
from mpsfm_core.evaluation.scene_folder import SceneFolder
from mpsfm_core.inputs.images import ImageSet
from mpsfm_core.mapping.scene.reconstruction import Reconstruction
from mpsfm_core.results.options import ResultOptions
from mpsfm_core.results.original_images import OriginalImages


@dataclass(frozen=True, eq=False)
class DenseEvaluation:
    """What a mapped set takes to be measured and compared.

    ``images``: the photos of the set, maybe among others. ``dense``, ``results``: settings of the
    stage and of its cloud. ``scene``: has true depth. ``distances``: metres, at which the cloud is
    judged.
    """

    images: ImageSet
    dense: DenseOptions
    results: ResultOptions
    scene: SceneFolder
    distances: tuple[float, ...]

    def measure(self, model: Reconstruction, problem: MappingProblem) -> dict[str, Any] | None:
        """Run the dense stage on a model of the problem; what :func:`evaluate_dense_geometry` says of it."""
        photos = OriginalImages(self.images, problem)
        dense, _ = densify(model, photos.view, self.dense)
        cloud = fuse_depth_maps(dense, photos.view, self.results).points
        cameras = {image.name: image.pinhole for image in self.images}
        return evaluate_dense_geometry(dense, cloud, self.scene, cameras, self.distances)


def evaluate_dense_geometry(
    model: Reconstruction,
    cloud: Float64,
    scene: SceneFolder,
    cameras: Mapping[str, PinholeCamera],
    distances: Sequence[float],
) -> dict[str, Any] | None:
    """Depth maps of a model and its cloud (n, 3) in world units, beside the true depth of a scene.

    ``cameras``: of the true maps, by image name. ``distances``: metres. Returns plain data:
    ``depth``, means over the maps (:func:`~mpsfm_core.evaluation.depth_accuracy.depth_accuracy`)
    in the scale of the cameras, and ``cloud``
    (:func:`~mpsfm_core.evaluation.cloud_accuracy.cloud_accuracy`), laid over the truth by the
    centres of the cameras, with the true maps of the model's images as the scan. None where the
    model has no true depth or fewer than three cameras, which tell no scale.

    Raises :class:`InputError` when the cloud is empty or a true map is damaged.
    """
    errors = trajectory_errors(model.poses, scene.truth)
    if errors is None or scene.depth is None:
        return None
    aligned, found = errors.truth_from_estimate, []
    for image in model.images:
        file = true_depth_file(scene.depth, image.name)
        if file.is_file():
            depth = image.depth
            true = depth_accuracy(depth.depth, depth.valid, read_depth(file), scale=aligned.scale)
            found += [] if true is None else [true]
    if not found:
        return None
    surface = build_true_surface(
        scene.depth, tuple(model.poses), cameras, scene.truth, min(distances) / 2
    )
    return {
        "depth": mean_accuracy(found),
        "cloud": cloud_accuracy(aligned.apply(cloud), surface, distances),
    }
