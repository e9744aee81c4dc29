"""From the working scene to the convert_scene reconstruction, in metres when that can be trusted."""

from __future__ import annotations

import numpy as np

from mpsfm_core.data import DepthPrior, PosedImage, SceneState
from mpsfm_core.geometry.statistics import MAD_TO_STD
from mpsfm_core.mapping.scene.reconstruction import MetricScale, Reconstruction, RegisteredImage
from mpsfm_core.mapping.scene.scene import Scene

MAX_METRIC_SPREAD = 0.15
"""Above this relative spread of the per-image scales the priors do not agree on a metre (ours)."""
MIN_METRIC_IMAGES = 3
"""Fewer images cannot show a spread (ours)."""


def estimate_metric_scale(scene: Scene, *, keep_units: bool) -> MetricScale | None:
    """Metres per world unit, from the scales of the registered images' metric priors.

    ``keep_units``: the world is the user's; the scale is told, but not trusted to be applied.
    """
    images = [int(i) for i in scene.registered_images()]
    maps = [scene.maps[i] for i in images if scene.maps[i].active and scene.maps[i].prior.metric]
    log_scales = [np.log(depth_map.scale) for depth_map in maps]
    if not log_scales:
        return None
    center = float(np.median(log_scales))
    spread = MAD_TO_STD * float(np.median(np.abs(np.array(log_scales) - center)))
    trusted = len(log_scales) >= MIN_METRIC_IMAGES and spread <= MAX_METRIC_SPREAD
    trusted = trusted and not keep_units
    return MetricScale(float(np.exp(-center)), spread, len(log_scales), trusted)


def convert_scene(scene: Scene, *, keep_units: bool = False) -> Reconstruction:
    """The reconstruction as results are written from it; metres if the scale is trusted."""
    scene.tracks.compact()
    metric = estimate_metric_scale(scene, keep_units=keep_units)
    in_metres = metric is not None and metric.trusted
    factor = metric.metres_per_unit if metric and in_metres else 1.0
    tracks = scene.tracks
    observations = tracks.observations()
    points = tracks.point_of[observations]
    errors, _ = scene.project(observations, tracks.xyz[points])
    count = len(tracks.xyz)
    lengths = np.bincount(points, minlength=count)
    mean_errors = np.bincount(points, errors, minlength=count) / np.maximum(lengths, 1)
    images = tuple(
        convert_image(scene, int(i), factor, in_metres) for i in scene.registered_images()
    )
    return Reconstruction(images, tracks.xyz * factor, mean_errors, metric)


def capture_scene_state(scene: Scene) -> SceneState:
    """The scene as it is now, in its own units."""
    images = (convert_image(scene, int(i), 1.0, False) for i in scene.registered_images())
    tracks = scene.tracks
    used = np.unique(tracks.point_of[tracks.observations()])
    return SceneState(
        tuple(PosedImage(i.name, i.camera, i.rotation, i.translation, i.depth) for i in images),
        tracks.xyz[used].copy(),
    )


def convert_image(scene: Scene, index: int, factor: float, in_metres: bool) -> RegisteredImage:
    """An image as the scene has it, in units that are ``factor`` times smaller than the scene's."""
    image, depth_map = scene.problem.images[index], scene.maps[index]
    depth = depth_map.depth * np.float32(factor)
    variance = (depth_map.log_std * depth) ** 2
    return RegisteredImage(
        index=index,
        name=image.name,
        camera=scene.camera(index),
        rotation=scene.rotations[index].copy(),
        translation=scene.translations[index] * factor,
        point_ids=scene.tracks.point_of[scene.graph.keypoints_of(index)].copy(),
        depth=DepthPrior.from_arrays(depth, variance, depth_map.valid, metric=in_metres),
        scale=depth_map.scale * factor,
    )
