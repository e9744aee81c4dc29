"""Reader of COLMAP's database of cameras, keypoints and matches.

The SQLite file is read directly because pycolmap aborts the process on a damaged database.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from numpy.typing import NDArray

from mpsfm_core.data import Float64, Int64
from mpsfm_core.data.errors import InputError

_MAX_IMAGES = 2**31 - 1
"""Factor of the smaller image id in COLMAP's ``pair_id`` [COLMAP kMaxNumImages]."""


@dataclass(frozen=True, eq=False)
class ColmapDatabase:
    """Cameras, images, keypoints and matches of a COLMAP database."""

    path: Path
    """Path of the database file, for error messages."""
    cameras: dict[int, pycolmap.Camera]
    """Mapping of camera ids to cameras."""
    images: dict[str, int]
    """Mapping of image names to image ids."""
    camera_of: dict[int, int]
    """Mapping of image ids to camera ids."""
    keypoints: dict[int, Float64]
    """Keypoints by image id, (n, 2) float64 in pixels before EXIF rotation."""
    matches: dict[tuple[int, int], Int64]
    """Matches by pair (smaller, larger image id) as (m, 2) int64 keypoint indices. Raw matches of a
    pair are preferred to its verified matches.
    """


def read_database(path: Path) -> ColmapDatabase:
    """Read a COLMAP database without changing it.

    Raises:
        InputError: the database is missing or damaged; the message names the damaged record.
    """
    if not path.is_file():
        raise InputError(f"COLMAP database {path} does not exist; check the path")
    uri = f"{path.resolve().as_uri()}?mode=ro&immutable=1"
    try:
        with closing(sqlite3.connect(uri, uri=True)) as database:
            return _read(path, database)
    except sqlite3.Error as error:
        raise InputError(f"{path} is not a COLMAP database, or is damaged: {error}") from error


def _read(path: Path, database: sqlite3.Connection) -> ColmapDatabase:
    cameras = {}
    rows = database.execute("SELECT camera_id, model, width, height, params FROM cameras")
    for number, model, width, height, params in rows:
        cameras[number] = _camera(f"{path}, camera {number}", model, width, height, params)
    images, camera_of = {}, {}
    for number, name, camera_id in database.execute("SELECT image_id, name, camera_id FROM images"):
        if not isinstance(name, str) or camera_id not in cameras:
            raise InputError(
                f"{path}: image {number} of the COLMAP database has no name or no camera"
            )
        images[name.replace("\\", "/")] = number
        camera_of[number] = camera_id
    keypoints = {}
    for number, count, columns, data in database.execute(
        "SELECT image_id, rows, cols, data FROM keypoints"
    ):
        where = f"{path}, keypoints of image {number}"
        values = _array(where, count, columns, data, np.dtype("<f4"))
        if values.shape[1] < 2 or not np.isfinite(values[:, :2]).all():
            raise InputError(f"{where}: keypoint coordinates x and y are missing or not finite")
        keypoints[number] = values[:, :2].astype(np.float64)
    matches = dict(_matches(path, database, "two_view_geometries"))
    matches |= {pair: rows for pair, rows in _matches(path, database, "matches") if len(rows)}
    return ColmapDatabase(path, cameras, images, camera_of, keypoints, matches)


def _matches(
    path: Path, database: sqlite3.Connection, table: str
) -> Iterator[tuple[tuple[int, int], Int64]]:
    for pair_id, count, columns, data in database.execute(
        f"SELECT pair_id, rows, cols, data FROM {table}"
    ):
        if not isinstance(pair_id, int):
            raise InputError(f"{path}, {table}: {pair_id!r} is not a pair id of COLMAP")
        second = pair_id % _MAX_IMAGES
        pair = (pair_id - second) // _MAX_IMAGES, second
        where = f"{path}, {table} of images {pair[0]} and {pair[1]}"
        values = _array(where, count, columns, data, np.dtype("<u4"))
        if len(values) and values.shape[1] != 2:
            raise InputError(f"{where}: a match must be two keypoint indices")
        yield pair, values.reshape(-1, 2).astype(np.int64)


def _array(
    where: str, rows: object, columns: object, data: object, dtype: np.dtype[Any]
) -> NDArray[Any]:
    if not isinstance(rows, int) or not isinstance(columns, int) or min(rows, columns) < 0:
        raise InputError(f"{where}: the array has no valid numbers of rows and columns")
    content = data if isinstance(data, bytes) else b""
    if rows * columns * dtype.itemsize != len(content):
        raise InputError(
            f"{where}: the array has {len(content)} bytes for {rows} x {columns} values"
        )
    return np.frombuffer(content, dtype).reshape(rows, columns)


def _camera(
    where: str, model: object, width: object, height: object, params: object
) -> pycolmap.Camera:
    known = {int(value): name for name, value in pycolmap.CameraModelId.__members__.items()}
    sized = isinstance(width, int) and isinstance(height, int) and min(width, height) > 0
    if model not in known or model == -1 or not sized or not isinstance(params, bytes):
        raise InputError(
            f"{where}: the camera model ({model}) is unknown, or size or parameters are missing"
        )
    values = np.frombuffer(params, "<f8") if len(params) % 8 == 0 else np.zeros(0)
    camera = pycolmap.Camera(model=known[model], width=width, height=height, params=values)
    if not camera.verify_params() or not np.isfinite(values).all():
        raise InputError(
            f"{where}: invalid parameters of the camera model {known[model]}: {values.tolist()}"
        )
    return camera
