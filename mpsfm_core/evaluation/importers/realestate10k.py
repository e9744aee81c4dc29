"""Importer of videos of the RealEstate10K dataset.

The source is a folder of extracted video frames, ``TIMESTAMP.png`` or ``.jpg``. The text file
``ID.txt`` of the video is in the folder, or next to the folder under the same name. A line of the
text file has the timestamp, ``fx fy cx cy`` relative to width and height, two zeros, and the
row-major 3 x 4 ``cam_from_world``. Translations of RealEstate10K have no metric scale.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from mpsfm_core.data.errors import InputError
from mpsfm_core.evaluation.importers.frames import PHOTOS, Frame, photo_size, pinhole_camera

_VALUES = 19
"""Number of values in a line of the camera text file."""


def read_frames(source: Path) -> list[Frame]:
    """Read the extracted frames of a RealEstate10K video; frames without image file are skipped."""
    file = next((f for f in _candidates(source) if f.is_file()), None)
    if file is None:
        raise InputError(f"{source}: no text file with cameras in or next to the folder")
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
    """Return the candidate paths of the camera text file of a video."""
    return [
        source / f"{source.name}.txt",
        source.with_suffix(".txt"),
        *sorted(source.glob("*.txt")),
    ]
