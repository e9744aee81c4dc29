"""Importer of scenes of the 7-Scenes dataset.

The source is a scene (``chess/`` with ``seq-01/``, ...) or one sequence. A frame has
``frame-000000.color.png``, ``.depth.png`` (millimeters, 65535 and 0 unknown) and ``.pose.txt`` (4 x
4 ``world_from_cam``, meters). The authors of 7-Scenes treat depth and color as one camera with a
focal length of 585 pixels; the actual offset between depth and color images is a few pixels.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

import cv2
import numpy as np

from mpsfm_core.data import Float32
from mpsfm_core.data.errors import InputError
from mpsfm_core.evaluation.importers.frames import Frame, invert_pose, photo_size, pinhole_camera

_FOCAL_RATIO = 585 / 640
"""Focal length of 7-Scenes relative to the image width."""
_UNKNOWN = 65535
"""Value of pixels without depth in the depth images of 7-Scenes."""


def read_frames(source: Path) -> list[Frame]:
    """Read the 7-Scenes frames that have a pose, from all sequences below the source."""
    frames = []
    for photo in sorted(source.rglob("frame-*.color.png")):
        stem = photo.name.removesuffix(".color.png")
        pose_file = photo.with_name(f"{stem}.pose.txt")
        depth = photo.with_name(f"{stem}.depth.png")
        if not pose_file.is_file():
            continue
        pose = np.loadtxt(pose_file)
        if pose.shape != (4, 4) or not np.isfinite(pose).all():
            continue  # tracking was lost
        width, height = photo_size(photo)
        focal = _FOCAL_RATIO * width
        camera = pinhole_camera((width, height), focal, focal, width / 2, height / 2)
        name = (photo.relative_to(source).parent / f"{stem}.png").as_posix()
        read = partial(_read, depth) if depth.is_file() else None
        frames.append(Frame(name, photo, camera, invert_pose(pose), read))
    return frames


def _read(path: Path) -> Float32:
    stored = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if stored is None or stored.dtype != np.uint16:
        raise InputError(f"{path}: the file is not a 16-bit depth image")
    return np.where(stored == _UNKNOWN, 0, stored * np.float32(0.001)).astype(np.float32)
