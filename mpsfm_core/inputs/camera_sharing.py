"""Decide which images share a camera, and guess the focal length of each camera.

By default images share a camera if EXIF names the same camera and lens with the same focal length,
and if their sizes agree. Images without a camera name in EXIF share a camera if they have the same
size and folder. The mapper gives images that contradict the focal length of a shared camera their
own camera (:mod:`mpsfm_core.mapping.initialization.camera_splitting`).
"""

from __future__ import annotations

import logging
from collections.abc import Hashable, Mapping
from pathlib import PurePosixPath
from statistics import median
from typing import Literal, NamedTuple

from mpsfm_core.inputs.image_header import ImageHeader
from mpsfm_core.inputs.options import InputOptions

_log = logging.getLogger(__name__)

FocalSource = Literal["intrinsics", "exif", "provider", "default"]


class CameraGuess(NamedTuple):
    """Camera of an image without given intrinsics."""

    number: int
    """Number of the camera from 1, equal for images that share the camera."""
    focal_px: float
    """Guessed focal length in pixels of the original image."""
    source: FocalSource
    """Source of the focal length, ``exif`` or ``default``."""


def guess_cameras(
    headers: Mapping[str, ImageHeader],
    sizes: Mapping[str, tuple[int, int]],
    options: InputOptions,
) -> dict[str, CameraGuess]:
    """Group images that share a camera, and guess the focal length of each camera.

    Args:
        headers: image headers with size, EXIF tags and camera name, by image name.
        sizes: (width, height) of the upright images in pixels, by image name.
        options: options with ``camera_per`` and ``default_focal_ratio``.

    Returns:
        The camera of each image by image name. The focal length of a camera is the median of the
        EXIF focal lengths of its images, or the default focal length if EXIF has none.
    """
    groups: dict[Hashable, list[str]] = {}
    for name, header in headers.items():
        key = _camera_key(name, header, sizes[name], options)
        groups.setdefault(key, []).append(name)
    if options.camera_per == "set" and len(groups) > 1:
        _log.warning(
            "inputs.camera_per=set: the images have %d sizes, so each size has its own camera",
            len(groups),
        )
    cameras = {}
    for number, names in enumerate(groups.values(), 1):
        size = sizes[names[0]]
        known = [f for f in (headers[name].focal_px(*size) for name in names) if f is not None]
        focal_px = median(known) if known else options.default_focal_ratio * max(size)
        guess = CameraGuess(number, focal_px, "exif" if known else "default")
        cameras.update(dict.fromkeys(names, guess))
    return cameras


def _camera_key(
    name: str, header: ImageHeader, size: tuple[int, int], options: InputOptions
) -> Hashable:
    """Return a dictionary key that is equal for images that share a camera."""
    folder = PurePosixPath(name).parent
    if options.camera_per == "image":
        return name
    if options.camera_per == "folder":
        return folder, size
    if options.camera_per == "set":
        return size
    return header.camera or folder, size, header.recorded_size, header.focal_px(*size)
