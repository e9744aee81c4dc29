"""Signs in the extracted data that a provider is wrong for every image of a run."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mpsfm_core.data.mapping_problem import MappingImage

_MIN_IMAGES = 3
_MIN_KEYPOINTS = 50
_MAX_EXTENT = 0.8
"""Extent of all keypoints, as a ratio of the image size, below which the rest is not covered."""
_MAX_MARGIN = 0.1
"""Distance of the first keypoint from the left and upper border, as a ratio of the image size.
Objects in the image center leave a larger margin."""


def find_partial_coverage(images: Sequence[MappingImage], provider: str) -> str:
    """Describe keypoints that cover only the upper left part of every image.

    Keypoints in pixels of a reduced or cropped image, and those of the first tile, have this
    distribution. The mapper would place all images wrongly with such keypoints.

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
