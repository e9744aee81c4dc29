"""Focal lengths that a camera provider or the depth provider estimates from the images."""

from __future__ import annotations

import logging
from collections import defaultdict
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from mpsfm_core.config import Config
from mpsfm_core.data import Float64, View
from mpsfm_core.extraction.active_provider import ActiveProvider, thread_count
from mpsfm_core.extraction.context import ExtractionContext
from mpsfm_core.extraction.events import ExtractionEvents, NullExtractionEvents
from mpsfm_core.inputs.images import FOCAL_LOG_STD, ImageSet, SourceImage
from mpsfm_core.providers.kinds.camera import run_camera
from mpsfm_core.providers.kinds.depth import run_focal
from mpsfm_core.providers.registry import Registry

_log = logging.getLogger(__name__)

_MAD_TO_STD = 1.4826
"""Ratio of standard deviation to median absolute deviation of a normal distribution."""
_UNKNOWN = (np.nan, np.nan)


def estimate_focal_lengths(
    images: ImageSet, config: Config, registry: Registry, events: ExtractionEvents | None = None
) -> ImageSet:
    """Replace guessed focal lengths by estimates of the camera provider or the depth provider.

    A camera provider estimates the focal length of all images without given intrinsics. The
    estimates of one camera are combined with its EXIF focal length by their standard deviations.
    Without a camera provider, a depth provider with the capability ``estimates-focal`` replaces
    default focal lengths. The mapper refines the focal lengths. The images are returned unchanged
    if no provider can estimate a focal length.

    Args:
        images: All input images.
        config: Configuration in which each block has one available provider.
        registry: Installed providers.
        events: Receiver of progress.

    Raises:
        InputError: the provider or its weights are missing.
        ProviderRunError: the provider failed.
        ProviderOutputError: the provider's output violates the provider contract.
    """
    replaceable = ("default",) if config.camera is None else ("default", "exif")
    rows = [row for row, image in enumerate(images) if image.focal_source in replaceable]
    if not rows:
        return images
    context = ExtractionContext(images, config, registry, events or NullExtractionEvents())
    if config.camera is not None:
        provider = context.provider("camera", config.camera)
        estimates = _estimate(context, provider, rows, _run_camera)
    else:
        provider = context.provider("depth", config.depth.model_copy(update={"wrap": ()}))
        if not provider.can("estimates-focal"):
            return images
        estimates = _estimate(context, provider, rows, _run_depth)
    by_camera: dict[int, list[tuple[float, float]]] = defaultdict(list)
    for row, estimate in zip(rows, estimates, strict=True):
        if np.isfinite(estimate).all():
            by_camera[images[row].camera.camera_id].append(estimate)
    focals, log_stds = {}, {}
    for image in images:
        number = image.camera.camera_id
        if number in by_camera and number not in focals:
            focals[number], log_stds[number] = combine_focal_lengths(by_camera[number], image)
            text = "camera %d: the %s provider %r estimates a focal length of %.0f px"
            values = (number, provider.kind, provider.spec.name, focals[number])
            _log.warning(f"{text} with a std of %.0f %%", *values, 100 * log_stds[number])
    return images.with_focals(focals, log_stds)


def combine_focal_lengths(
    estimates: Sequence[tuple[float, float]], image: SourceImage
) -> tuple[float, float]:
    """Combine the focal lengths that a network estimates for the images of one camera with EXIF.

    The errors of one network in similar images are correlated. The std of the median is therefore
    the median std, or the scatter of the estimates if larger. A focal length from EXIF is combined
    by inverse variances of the logarithm. If both focal lengths differ by more than their std
    allows, the std of the combination grows by the Birge ratio (Birge 1932).

    Args:
        estimates: Focal length in pixels of the original image and std of its logarithm, for each
            image of the camera.
        image: Image of the camera, with the focal length and std of EXIF or of the default.

    Returns:
        Focal length in pixels of the original image, and the std of its logarithm.
    """
    focals, stds = np.array(estimates).T
    focal_px = float(np.median(focals))
    scatter = _MAD_TO_STD * float(np.median(np.abs(np.log(focals / focal_px))))
    std = max(float(np.median(stds)), scatter)
    if image.focal_source == "exif":
        log_ratio = float(np.log(image.camera.mean_focal_length() / focal_px))
        exif_std = image.focal_log_std
        variance = std**2 + exif_std**2
        birge_ratio = max(1.0, abs(log_ratio) / np.sqrt(variance))
        focal_px *= np.exp(log_ratio * std**2 / variance)
        std = float(birge_ratio * std * exif_std / np.sqrt(variance))
    return float(focal_px), std


def _estimate(
    context: ExtractionContext,
    provider: ActiveProvider,
    rows: Sequence[int],
    run: Callable[[ActiveProvider, Any, View], tuple[float, float]],
) -> list[tuple[float, float]]:
    """Return focal length in pixels of the original image and log std for each image, or NaN."""
    images = context.images

    def estimate(row: int) -> tuple[float, float]:
        view = images.view(row)

        def compute(instance: Any) -> Float64:
            return np.array(run(provider, instance, view))

        key = ["focal length", images.pixel_key(row)]
        focal, log_std = context.result(provider, np.ndarray, key, compute)
        return float(focal * images[row].camera.width / view.camera.width), float(log_std)

    with threadpool_limits(thread_count(context.config.runtime), user_api="blas"):
        return context.each("focal", rows, estimate, provider, local=True)


def _run_camera(provider: ActiveProvider, instance: Any, view: View) -> tuple[float, float]:
    prior = run_camera(provider.spec, instance, view)
    return _UNKNOWN if prior is None else (prior.focal_px, prior.focal_std_px / prior.focal_px)


def _run_depth(provider: ActiveProvider, instance: Any, view: View) -> tuple[float, float]:
    focal_px = run_focal(provider.spec, instance, view)
    return _UNKNOWN if focal_px is None else (focal_px, FOCAL_LOG_STD["provider"])
