"""Validation of COLMAP's binary model files before pycolmap reads them.

COLMAP's reader does not check record counts: a damaged file can take unlimited time and memory.
This module compares every record count with the size of its file.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path

_COUNT = struct.Struct("<Q")
_SHORT_COUNT = struct.Struct("<I")
_IMAGE_START, _KEYPOINT = 4 + 7 * 8 + 4, 2 * 8 + 8
_POINT_START, _OBSERVATION = 8 + 3 * 8 + 3 + 8, 4 + 4
_CAMERA_START = 4 + 4 + 8 + 8
_FRAME_START, _DATA_ID = 4 + 4 + 7 * 8, 4 + 4 + 8
_RIG_START, _SENSOR = 4, 4 + 4


def check_binary_model(folder: Path) -> None:
    """Check that the record counts in a binary model fit the sizes of its files.

    Raises:
        ValueError: a model file ends before its last record.
    """
    for name, record_end in _RECORDS.items():
        path = folder / f"{name}.bin"
        if path.is_file():
            try:
                _check(path.read_bytes(), record_end)
            except (struct.error, ValueError) as error:
                text = f"{path.name} is damaged: it ends before its last record ({error})"
                raise ValueError(text) from error


def _check(data: bytes, record_end: Callable[[bytes, int], int]) -> None:
    (count,) = _COUNT.unpack_from(data)
    position = _COUNT.size
    for _ in range(count):
        position = record_end(data, position)
        if position > len(data):
            raise ValueError(f"at byte {len(data)}")


def _camera_end(data: bytes, start: int) -> int:
    return start + _CAMERA_START + 8  # a camera has at least one parameter


def _image_end(data: bytes, start: int) -> int:
    end = data.index(b"\0", start + _IMAGE_START) + 1
    return end + _COUNT.size + _KEYPOINT * int(_COUNT.unpack_from(data, end)[0])


def _point_end(data: bytes, start: int) -> int:
    end = start + _POINT_START
    return end + _COUNT.size + _OBSERVATION * int(_COUNT.unpack_from(data, end)[0])


def _frame_end(data: bytes, start: int) -> int:
    end = start + _FRAME_START
    return end + _SHORT_COUNT.size + _DATA_ID * int(_SHORT_COUNT.unpack_from(data, end)[0])


def _rig_end(data: bytes, start: int) -> int:
    end = start + _RIG_START
    return end + _SHORT_COUNT.size + _SENSOR * int(_SHORT_COUNT.unpack_from(data, end)[0])


_RECORDS = {
    "cameras": _camera_end,
    "images": _image_end,
    "points3D": _point_end,
    "frames": _frame_end,
    "rigs": _rig_end,
}
"""Functions that compute the minimum end offset of a record from its start offset, by file stem."""
