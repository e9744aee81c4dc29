"""Checks of the keypoints of all images of a run for errors of the features provider."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mpsfm_core.data.mapping_problem import MappingImage

_MIN_IMAGES = 3
_MIN_KEYPOINTS = 50
_MAX_EXTENT = 0.8
"""Maximum right and lower end of all keypoints, relative to image size, that causes a warning."""
_MAX_MARGIN = 0.1
"""Maximum left and upper margin of the keypoints, relative to image size, that causes a warning.
An object in the image center has a larger margin, and therefore causes no warning."""


def find_partial_coverage(images: Sequence[MappingImage], provider: str) -> str:
    """Describe keypoints that cover only the upper left part of every image.

    A wrong provider returns keypoints in pixels of a reduced or cropped image, or only of the first
    tile of an image. Keypoints in wrong pixels give wrong poses of all images.

    Args:
        images: Images with their keypoints.
        provider: Name of the features provider, for the text.

    Returns:
        Warning for the user, or an empty text.
    """
    extents = [
        np.stack([image.keypoints.min(axis=0), image.keypoints.max(axis=0)]) / image.camera.size
        for image in images
        if len(image.keypoints) >= _MIN_KEYPOINTS
    ]
    if len(extents) < _MIN_IMAGES:
        return ""
    first, last = np.min(extents, axis=0)[0], np.max(extents, axis=0)[1]
    if first.max() > _MAX_MARGIN or last.max() > _MAX_EXTENT:
        return ""
    return (
        f"the features provider {provider!r} finds keypoints only in the upper left "
        f"{last[0]:.0%} x {last[1]:.0%} of all {len(extents)} images: keypoints may be in pixels "
        f"of a reduced image; test the provider with 'mpsfm plugins check {provider}'"
    )
