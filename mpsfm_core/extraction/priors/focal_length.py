"""Focal length estimation by the depth provider, for images without EXIF focal length."""

from __future__ import annotations

import logging
from collections import defaultdict
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from mpsfm_core.config import Config
from mpsfm_core.data import Float64
from mpsfm_core.extraction.active_provider import thread_count
from mpsfm_core.extraction.context import ExtractionContext
from mpsfm_core.extraction.events import ExtractionEvents, NullExtractionEvents
from mpsfm_core.inputs.images import ImageSet
from mpsfm_core.providers import validation
from mpsfm_core.providers.registry import Registry

_log = logging.getLogger(__name__)


def estimate_focal_lengths(
    images: ImageSet, config: Config, registry: Registry, events: ExtractionEvents | None = None
) -> ImageSet:
    """Replace default focal lengths by estimates of the depth provider.

    Images of one camera get the median of their estimates, which the mapper refines. The images are
    returned unchanged if no focal length is a default, or if the depth provider lacks the
    capability ``estimates-focal``.

    Args:
        images: All input images.
        config: Configuration in which each block has one available provider.
        registry: Installed providers.
        events: Receiver of progress.

    Raises:
        InputError: the depth provider or its weights are missing.
        ProviderRunError: the depth provider failed.
        ProviderOutputError: the provider's output violates the provider contract.
    """
    unknown = [index for index, image in enumerate(images) if image.focal_source == "default"]
    if not unknown:
        return images
    context = ExtractionContext(images, config, registry, events or NullExtractionEvents())
    provider = context.provider("depth", config.depth.model_copy(update={"wrap": ()}))
    if not provider.can("estimates-focal"):
        return images

    def estimate(index: int) -> float:
        view = images.view(index)

        def compute(instance: Any) -> Float64:
            focal_px = validation.run_focal(provider.spec, instance, view)
            return np.array(np.nan if focal_px is None else focal_px)

        focal = context.result(provider, np.ndarray, ["focal", images.pixel_key(index)], compute)
        return float(focal * images[index].camera.width / view.camera.width)

    with threadpool_limits(thread_count(config.runtime), user_api="blas"):
        estimates = context.each("focal", unknown, estimate, provider, local=True)
    by_camera: dict[int, list[float]] = defaultdict(list)
    for index, focal in zip(unknown, estimates, strict=True):
        if np.isfinite(focal):
            by_camera[images[index].camera.camera_id].append(focal)
    medians = {number: float(np.median(focals)) for number, focals in by_camera.items()}
    for number, focal in medians.items():
        text = "camera %d: the depth provider %r estimates a focal length of %.0f px"
        _log.warning(text, number, provider.spec.name, focal)
    return images.with_focals(medians)
