"""Conversion of the mapper's scene to a reconstruction, in meters if depth is metric."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from mpsfm_core.data import PosedImage, SceneState
from mpsfm_core.data.camera_models import IntrinsicParameter
from mpsfm_core.data.decisions import CameraReason, Reason
from mpsfm_core.geometry.focal_length import compute_equivalent_mm
from mpsfm_core.geometry.statistics import MAD_TO_STD
from mpsfm_core.mapping.scene.depth_map import LazyDepth
from mpsfm_core.mapping.scene.estimated_intrinsics import (
    MIN_FOCAL_IMAGES,
    CalibrationOutcome,
    IntrinsicEstimate,
    PredictedErrors,
)
from mpsfm_core.mapping.scene.reconstruction import (
    CalibratedParameter,
    MetricScale,
    Reconstruction,
    RegisteredImage,
)
from mpsfm_core.mapping.scene.scene import Scene

MAX_METRIC_SPREAD = 0.15
"""Largest relative spread of the metric scales estimated by the images, for which the
reconstruction is scaled to meters. [ours]"""
MIN_METRIC_IMAGES = 3
"""Smallest number of images with a metric scale, for which the reconstruction is scaled to meters.
[ours]"""


def estimate_metric_scale(scene: Scene, *, keep_units: bool) -> MetricScale | None:
    """Estimate meters per world unit from baselines of rigs, else from metric depth priors.

    Args:
        scene: The scene.
        keep_units: Do not apply the estimated metric scale, because known poses define the unit of
            the world.

    Returns:
        Estimated metric scale, ``trusted`` if the scale is to be applied, or None without metric
        depth priors and known baselines.
    """
    images = [int(i) for i in scene.registered_images()]
    by_rigs = _measure_rig_metric(scene)
    if by_rigs is not None:
        return replace(by_rigs, trusted=not keep_units)
    log_scales = [
        _measure_log_scale(scene, i)
        for i in images
        if scene.maps[i].active and scene.maps[i].prior.metric
    ]
    if not log_scales:
        return None
    center = float(np.median(log_scales))
    spread = MAD_TO_STD * float(np.median(np.abs(np.array(log_scales) - center)))
    trusted = len(log_scales) >= MIN_METRIC_IMAGES and spread <= MAX_METRIC_SPREAD
    trusted = trusted and not keep_units
    return MetricScale(float(np.exp(-center)), spread, len(log_scales), trusted)


def _measure_log_scale(scene: Scene, image: int) -> float:
    """Return the log of world units per meter of metric depth, for the refined focal length."""
    log_scale = float(np.log(scene.maps[image].scale))
    focal_px = scene.problem.images[image].depth_focal_px
    if focal_px is not None:
        log_scale -= float(np.log(scene.intrinsics[image, 0] / focal_px))
    return log_scale


def _measure_rig_metric(scene: Scene) -> MetricScale | None:
    """Return the metric scale of rigs, or None if no baseline determines the scale."""
    spread = scene.rigs.scale_std / scene.rigs.scale
    if not spread <= MAX_METRIC_SPREAD:
        return None
    num_frames = len(np.unique(scene.rigs.frame_of[scene.registered]))
    return MetricScale(1 / scene.rigs.scale, spread, num_frames, True, by="rig baselines")


def convert_scene(
    scene: Scene, errors: PredictedErrors | None = None, *, keep_units: bool = False
) -> Reconstruction:
    """Convert the scene to a reconstruction, in meters if the metric scale is reliable.

    Args:
        scene: The scene, from whose tracks the rows of deleted points are removed.
        errors: Predicted errors of all images, or None without a prediction.
        keep_units: Keep the unit of the world instead of scaling the reconstruction to meters.
    """
    scene.tracks.compact()
    metric = estimate_metric_scale(scene, keep_units=keep_units)
    in_metres = metric is not None and metric.trusted
    factor = metric.metres_per_unit if metric and in_metres else 1.0
    tracks = scene.tracks
    observations = tracks.observations()
    points = tracks.point_of[observations]
    errors_px, _ = scene.project(observations, tracks.xyz[points])
    num_points = len(tracks.xyz)
    lengths = np.bincount(points, minlength=num_points)
    mean_errors = np.bincount(points, errors_px, minlength=num_points) / np.maximum(lengths, 1)
    images = tuple(
        convert_image(scene, int(i), factor, in_metres, errors) for i in scene.registered_images()
    )
    names = {image.name for image in images}
    rigs = tuple(rig.subset(names).scaled(factor) for rig in scene.rigs.rigs())
    return Reconstruction(images, tracks.xyz * factor, mean_errors, metric, rigs)


def capture_scene_state(scene: Scene) -> SceneState:
    """Copy poses, points and depth maps of the scene, in world units."""
    images = (convert_image(scene, int(i), 1.0, False) for i in scene.registered_images())
    tracks = scene.tracks
    observed = np.unique(tracks.point_of[tracks.observations()])
    return SceneState(
        tuple(PosedImage(i.name, i.camera, i.rotation, i.translation, i.depth) for i in images),
        tracks.xyz[observed].copy(),
    )


def convert_image(
    scene: Scene,
    index: int,
    factor: float,
    in_metres: bool,
    errors: PredictedErrors | None = None,
) -> RegisteredImage:
    """Convert a registered image of the scene to an image of the reconstruction.

    Args:
        scene: The scene.
        index: Index of the image in the mapping problem.
        factor: Factor from world units to the unit of the reconstruction.
        in_metres: Whether the unit of the reconstruction is the meter.
        errors: Predicted errors of all images, or None without a prediction.
    """
    errors = PredictedErrors.unknown(scene.num_images) if errors is None else errors
    pose_error_deg = float(errors.pose_deg[index])
    image, depth_map = scene.problem.images[index], scene.maps[index]
    return RegisteredImage(
        index=index,
        name=image.name,
        camera=scene.camera(index),
        rotation=scene.rotations[index].copy(),
        translation=scene.translations[index] * factor,
        point_ids=scene.tracks.point_of[scene.graph.keypoints_of(index)].copy(),
        depth=LazyDepth(
            depth_map.prior, depth_map.refinement, depth_map.scale * factor, metric=in_metres
        ),
        scale=depth_map.scale * factor,
        camera_model=image.camera_model,
        distortion=scene.distortion[index].copy(),
        pose_error_deg=pose_error_deg if np.isfinite(pose_error_deg) else None,
        calibration={
            p: _describe_calibration(scene, index, p, float(errors.stds[index, p]))
            for p in IntrinsicParameter
        },
    )


def _describe_calibration(
    scene: Scene, index: int, parameter: IntrinsicParameter, predicted_std: float
) -> CalibratedParameter:
    """Return estimate and std of a parameter, and the reason why the parameter is not refined.

    The predicted standard deviation includes systematic errors of the camera model, and replaces
    the posterior standard deviation of bundle adjustment. The focal length also has a predicted
    standard deviation if bundle adjustment did not estimate the focal length.
    """
    estimate = scene.estimated_intrinsics.get(index, parameter)
    is_stated = parameter == IntrinsicParameter.FOCAL_LENGTH or np.isfinite(estimate.std)
    if is_stated and np.isfinite(predicted_std) and not scene.problem.images[index].focal_known:
        estimate = estimate._replace(std=predicted_std)
    if parameter == IntrinsicParameter.FOCAL_LENGTH:
        return CalibratedParameter(estimate, _get_focal_reason(scene, index))
    if parameter == IntrinsicParameter.RADIAL_DISTORTION:
        return CalibratedParameter(estimate, _get_radial_reason(scene, index))
    return CalibratedParameter(estimate, _get_reason(parameter, estimate))


def _get_reason(parameter: IntrinsicParameter, estimate: IntrinsicEstimate) -> Reason | None:
    """Return why an estimated parameter is not refined, or None if refined or not estimated."""
    outcome, value, std = estimate
    name = parameter.name.lower()
    if outcome == CalibrationOutcome.NOT_OBSERVABLE:
        return CameraReason.PARAMETER_NOT_OBSERVABLE.because(parameter=name, std=round(std, 4))
    if outcome == CalibrationOutcome.OUT_OF_RANGE:
        return CameraReason.PARAMETER_OUT_OF_RANGE.because(parameter=name, value=round(value, 4))
    return None


def _get_focal_reason(scene: Scene, index: int) -> Reason | None:
    """Return the reason why a camera's focal length is not refined, or None if it is refined."""
    if scene.problem.images[index].focal_known:
        return CameraReason.KNOWN.because()
    outcome, focal_px, std = scene.estimated_intrinsics.get(index, IntrinsicParameter.FOCAL_LENGTH)
    if outcome == CalibrationOutcome.REFINED:
        return None
    if outcome == CalibrationOutcome.NOT_OBSERVABLE:
        return CameraReason.NOT_OBSERVABLE.because(focal_length_std_ratio=round(std, 4))
    if outcome == CalibrationOutcome.OUT_OF_RANGE:
        equivalent_mm = compute_equivalent_mm(focal_px, *scene.problem.images[index].camera.size)
        return CameraReason.OUT_OF_RANGE.because(equivalent_mm=round(equivalent_mm, 2))
    num_images = int(scene.registered.sum())
    if num_images < MIN_FOCAL_IMAGES:
        return CameraReason.TOO_FEW_IMAGES.because(
            num_images=num_images, min_images=MIN_FOCAL_IMAGES
        )
    return CameraReason.NOT_ESTIMATED.because()


def _get_radial_reason(scene: Scene, index: int) -> Reason | None:
    """Return why a camera's radial distortion is not refined, or None if refined or known."""
    outcome, radial, std = scene.estimated_intrinsics.get(
        index, IntrinsicParameter.RADIAL_DISTORTION
    )
    if scene.problem.images[index].focal_known or outcome == CalibrationOutcome.REFINED:
        return None
    if outcome == CalibrationOutcome.NOT_OBSERVABLE:
        return CameraReason.DISTORTION_NOT_OBSERVABLE.because(radial_std=round(std, 4))
    if outcome == CalibrationOutcome.OUT_OF_RANGE:
        return CameraReason.DISTORTION_OUT_OF_RANGE.because(radial=round(radial, 4))
    return CameraReason.DISTORTION_NOT_ESTIMATED.because()
