"""RealEstate10K.

Reads the text file of a video (``ID.txt``: its address, then for each frame the time stamp,
``fx fy cx cy`` as shares of width and height, two zeros, and the 3 x 4 ``cam_from_world`` row by
row) and the frames that were cut from it, ``TIMESTAMP.png`` or ``.jpg``. The source is the folder
of the frames, with the text file in it or beside it under the folder's name. Translations have no
metric scale.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from mpsfm_core.data.errors import InputError
from mpsfm_core.evaluation.importers.frames import PHOTOS, Frame, photo_size, pinhole_camera

_VALUES = 19
"""Numbers of a frame's line."""


def read_frames(source: Path) -> list[Frame]:
    """Frames of one video that were cut out; others of the text file are left out."""
    file = next((f for f in _candidates(source) if f.is_file()), None)
    if file is None:
        raise InputError(f"{source}: no text file with cameras in it or beside it")
    photos = {path.stem: path for path in source.iterdir() if path.suffix.lower() in PHOTOS}
    frames = []
    for line in file.read_text(encoding="utf-8").splitlines()[1:]:
        values = line.split()
        if not values:
            continue
        if len(values) != _VALUES:
            raise InputError(f"{file}: a frame has {len(values)} values, not {_VALUES}")
        photo = photos.get(values[0])
        if photo is None:
            continue
        fx, fy, cx, cy = map(float, values[1:5])
        size = photo_size(photo)
        camera = pinhole_camera(size, fx * size[0], fy * size[1], cx * size[0], cy * size[1])
        pose = np.array(values[7:], dtype=np.float64).reshape(3, 4)
        frames.append(Frame(photo.name, photo, camera, pose))
    return frames


def _candidates(source: Path) -> list[Path]:
    return [
        source / f"{source.name}.txt",
        source.with_suffix(".txt"),
        *sorted(source.glob("*.txt")),
    ]
