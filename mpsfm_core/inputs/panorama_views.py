"""Cut equirectangular panoramas into perspective views, which form one rig."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Sequence
from pathlib import Path, PurePosixPath
from typing import NamedTuple

import cv2
import numpy as np

from mpsfm_core.data import PinholeCamera, Rig, UInt8
from mpsfm_core.data.errors import InputError
from mpsfm_core.geometry.panorama import (
    make_view_camera,
    make_view_rotations,
    view_pixels_in_panorama,
)
from mpsfm_core.inputs.image_decoding import (
    check_decodable,
    check_size,
    decode_rgb,
    read_bytes,
    upright_size,
)
from mpsfm_core.inputs.image_header import read_header
from mpsfm_core.inputs.panorama import find_projection, has_panorama_size
from mpsfm_core.support.files import write_file

_JPEG_QUALITY = 95
"""Quality of the JPEG files of views, at which compression does not move keypoints. [ours]"""


class PanoramaViews(NamedTuple):
    """Perspective views of panoramas on disk."""

    folder: Path
    """Folder of the views ``camera<number>/<name of the panorama>.jpg``."""
    cameras: dict[str, PinholeCamera]
    """Known camera of each view by name."""
    rig: Rig
    """Rig of the views of a panorama, whose centers coincide. The pose of a frame is the pose of
    the panorama, with x right, y down and z to the middle of the panorama."""


def are_panoramas(folder: Path, names: Sequence[str]) -> bool:
    """Return True if the images of a folder are equirectangular panoramas of 360 x 180 degrees.

    All images must be twice as wide as high, and more than half of them must be recognized as
    panoramas by XMP data or by their pixels, because pixels do not show every panorama.

    Args:
        folder: Folder of the images.
        names: Names of the images below the folder.
    """
    num_recognized = 0
    for name in names:
        path = folder / name
        try:
            data = read_bytes(path)
            header = read_header(data)
            if not has_panorama_size(*upright_size(data, header, path)):
                return False
            num_recognized += find_projection(header, check_decodable(data, path)) is not None
        except InputError:
            return False
    return 2 * num_recognized > len(names)


def cut_panorama(panorama: UInt8) -> list[UInt8]:
    """Cut a panorama into perspective views of 90 degrees around the vertical axis.

    Args:
        panorama: (h, w, 3) uint8 equirectangular image of 360 x 180 degrees.
    """
    height, width = panorama.shape[:2]
    camera = make_view_camera(width)
    views = []
    for rotation in make_view_rotations():
        pixels = view_pixels_in_panorama(camera, rotation, (width, height)) - 0.5
        columns, rows = np.moveaxis(pixels.astype(np.float32), -1, 0)
        views.append(
            cv2.remap(panorama, columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
        )
    return views


def cut_panoramas(
    folder: Path,
    names: Sequence[str],
    output: Path,
    max_pixels: int,
    progress: Callable[[int, int], None] | None = None,
) -> PanoramaViews:
    """Cut all panoramas of a folder into views, and write the views.

    The views of an earlier call are removed, because the panoramas may have changed.

    Args:
        folder: Folder of the panoramas.
        names: Names of the panoramas below the folder.
        output: Folder of the views, which contains nothing else.
        max_pixels: Maximum number of pixels of a panorama.
        progress: Function that receives the number of cut panoramas and their total number.

    Raises:
        InputError: A panorama cannot be decoded, or is not twice as wide as high.
    """
    if output.is_dir():
        shutil.rmtree(output)
    rotations = make_view_rotations()
    cameras: dict[str, PinholeCamera] = {}
    frames = []
    for number, name in enumerate(names, start=1):
        path = folder / name
        data = read_bytes(path)
        check_size(data, path, max_pixels)
        panorama = decode_rgb(data, read_header(data), path)
        height, width = panorama.shape[:2]
        if not has_panorama_size(width, height):
            raise InputError(
                f"image {path} has {width} x {height} pixels, but an equirectangular panorama is "
                "twice as wide as high; remove the image or use --projection perspective"
            )
        views = cut_panorama(panorama)
        stem = PurePosixPath(name).with_suffix("").as_posix()
        frame = tuple(f"camera{view}/{stem}.jpg" for view in range(len(views)))
        for view_name, view in zip(frame, views, strict=True):
            if view_name in cameras:
                raise InputError(f"images of {folder}: two panoramas have the name {stem!r}")
            cameras[view_name] = make_view_camera(width)
            _write_jpeg(output / view_name, view)
        frames.append(frame)
        if progress is not None:
            progress(number, len(names))
    sensors = tuple((rotation, np.zeros(3)) for rotation in rotations)
    return PanoramaViews(output, cameras, Rig(sensors, tuple(frames)))


def _write_jpeg(path: Path, rgb: UInt8) -> None:
    """Write RGB pixels as a JPEG file."""
    path.parent.mkdir(parents=True, exist_ok=True)
    options = [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY]
    bgr = cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR)
    write_file(path, cv2.imencode(".jpg", bgr, options)[1].tobytes())
