"""Read rigs from COLMAP's ``rig_config.json``, a COLMAP model or a COLMAP database."""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Collection, Iterable, Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap

from mpsfm_core.data import Pose, Rig
from mpsfm_core.data.errors import DataError, InputError
from mpsfm_core.inputs.images import SourceImage
from mpsfm_core.inputs.models import describe_name_difference, match_names, read_model
from mpsfm_core.inputs.text_files import read_text_file

FOLDERS = Path("folders")
"""Value of the option ``rigs`` for cameras whose images are in different folders."""
_CAMERA = int(pycolmap.SensorType.CAMERA)
_POSE_BYTES = 7 * 8
"""Size in bytes of a pose in a COLMAP database, 4 + 3 numbers of a quaternion and translation."""
_QUERY = """SELECT frames.rig_id, frame_data.frame_id, frame_data.sensor_id, images.name
    FROM frames JOIN frame_data ON frame_data.frame_id = frames.frame_id
    JOIN images ON images.image_id = frame_data.data_id
    WHERE frame_data.sensor_type = ? ORDER BY frames.rig_id, frame_data.frame_id"""

_HAS_RIGS = "SELECT 1 FROM sqlite_master WHERE type = 'table' AND name = 'rigs'"

_Sensors = Mapping[int, Pose | None]
"""Pose ``sensor_from_rig`` by sensor id, None if unknown."""


def read_rigs(
    path: Path, names: Collection[str], images_folder: Path | None, *, required: bool = True
) -> tuple[Rig, ...]:
    """Read the rigs of images; a frame is the images that one rig takes at one moment.

    Args:
        path: COLMAP's ``rig_config.json``, a COLMAP model folder, a COLMAP database (``.db``), or
            ``folders`` if the images of each camera are in a folder, with equal names for the
            images of one moment.
        names: Names of the images of the run.
        images_folder: Folder of the images, for models of images before EXIF rotation.
        required: Raise an error if the file has no rig for two images of the run.

    Raises:
        InputError: The file cannot be read, a relative pose is no rotation, or no frame has two
            images of the run although rigs are ``required``.
    """
    try:
        if path == FOLDERS:
            rigs = rig_from_folders(names)
        elif path.suffix == ".json":
            rigs = _read_config(path, names)
        elif path.suffix == ".db":
            rigs = _read_database(path, names)
        else:
            rigs = rigs_from_model(read_model(path, images_folder), names, str(path))
    except DataError as error:
        raise InputError(f"rigs {path}: {error}") from error
    if required and not rigs:
        raise InputError(
            f"rigs {path}: no frame has two images of {images_folder or 'the run'}; check that the "
            "names of the images of one moment are equal after the image_prefix or the folder of "
            "their camera, or in the model"
        )
    return rigs


def require_upright(rigs: Sequence[Rig], images: Iterable[SourceImage]) -> None:
    """Check that no image of a rig has an EXIF orientation, which would turn its relative pose.

    Raises:
        InputError: An image of a rig has an EXIF orientation.
    """
    for image in find_turned(rigs, images):
        raise InputError(
            f"rigs: image {image.name} has EXIF orientation {image.orientation}, but the relative "
            "poses of a rig need images without EXIF orientation; rotate the pixels and remove the "
            "EXIF orientation"
        )


def find_turned(rigs: Sequence[Rig], images: Iterable[SourceImage]) -> list[SourceImage]:
    """Return the images of rigs that have an EXIF orientation."""
    in_rig = {name for rig in rigs for name in rig.image_names}
    return [image for image in images if image.name in in_rig and image.orientation != 1]


def rig_from_folders(names: Collection[str]) -> tuple[Rig, ...]:
    """Return the rig of cameras whose images are in different folders, with unknown poses.

    Args:
        names: Names of the images. The first folder of a name is the camera, and images with equal
            names below it form a frame.

    Raises:
        InputError: The images are in fewer than two folders.
    """
    folders = sorted({name.split("/")[0] for name in names if "/" in name})
    if len(folders) < 2:
        raise InputError(
            f"rigs {FOLDERS}: the photos must be in at least two folders, one per camera, below "
            "the input folder"
        )
    prefixes = [f"{folder}/" for folder in folders]
    return _group_by_name(names, prefixes, [None] * len(folders), f"rigs {FOLDERS}")


def rigs_from_model(
    model: pycolmap.Reconstruction, names: Collection[str], source: str
) -> tuple[Rig, ...]:
    """Return the rigs of a COLMAP model with several cameras.

    Args:
        model: The COLMAP model.
        names: Names of the images of the run.
        source: Path of the model, for error messages.

    Raises:
        InputError: The model and the run have no image name in common.
    """
    rigs = {number: rig for number, rig in model.rigs.items() if rig.num_sensors() > 1}
    members: dict[int, dict[int, dict[int, str]]] = {}
    for frame_id, frame in model.frames.items():
        if frame.rig_id in rigs:
            members.setdefault(frame.rig_id, {})[frame_id] = {
                data.sensor_id.id: str(model.images[data.id].name) for data in frame.image_ids
            }
    sensors = {}
    for number, rig in rigs.items():
        sensors[number] = {
            sensor.id: None if pose is None else _split(np.asarray(pose.matrix()))
            for sensor, pose in rig.non_ref_sensors.items()
            if sensor.type == pycolmap.SensorType.CAMERA
        }
        if rig.ref_sensor_id.type == pycolmap.SensorType.CAMERA:
            sensors[number][rig.ref_sensor_id.id] = (np.eye(3), np.zeros(3))
    return _build_rigs(sensors, members, names, source)


def _read_database(path: Path, names: Collection[str]) -> tuple[Rig, ...]:
    """Read the rigs of a COLMAP database (COLMAP 3.12 and later)."""
    if not path.is_file():
        raise InputError(f"COLMAP database {path} does not exist; check the path")
    sensors: dict[int, dict[int, Pose | None]] = {}
    members: dict[int, dict[int, dict[int, str]]] = {}
    uri = f"{path.resolve().as_uri()}?mode=ro&immutable=1"
    try:
        with closing(sqlite3.connect(uri, uri=True)) as database:
            if not database.execute(_HAS_RIGS).fetchone():
                return ()  # a database of COLMAP 3.11 or earlier
            query = "SELECT rig_id, ref_sensor_id FROM rigs WHERE ref_sensor_type = ?"
            for rig, sensor in database.execute(query, (_CAMERA,)):
                sensors[rig] = {sensor: (np.eye(3), np.zeros(3))}
            query = "SELECT rig_id, sensor_id, sensor_from_rig FROM rig_sensors WHERE sensor_type=?"
            for rig, sensor, data in database.execute(query, (_CAMERA,)):
                sensors.setdefault(rig, {})[sensor] = _read_pose(data)
            for rig, frame, sensor, name in database.execute(_QUERY, (_CAMERA,)):
                members.setdefault(rig, {}).setdefault(frame, {})[sensor] = str(name)
    except sqlite3.Error as error:
        raise InputError(f"rigs {path}: not a COLMAP database with rigs: {error}") from error
    sensors = {rig: poses for rig, poses in sensors.items() if len(poses) > 1}
    members = {rig: frames for rig, frames in members.items() if rig in sensors}
    return _build_rigs(sensors, members, names, str(path))


def _read_pose(data: object) -> Pose | None:
    """Convert a pose of a COLMAP database, None if the pose is unknown."""
    if not isinstance(data, bytes) or len(data) != _POSE_BYTES:
        return None
    values = np.frombuffer(data, "<f8")
    return None if not np.isfinite(values).all() else _pose(values[:4], values[4:])


def _build_rigs(
    sensors: Mapping[int, _Sensors],
    members: Mapping[int, Mapping[int, Mapping[int, str]]],
    names: Collection[str],
    source: str,
) -> tuple[Rig, ...]:
    """Build rigs from sensors, and names of images by rig, frame and sensor."""
    theirs = [
        name for f in members.values() for of_frame in f.values() for name in of_frame.values()
    ]
    ours_of = {their: ours for ours, their in match_names(names, theirs).items()}
    if theirs and not ours_of:
        raise InputError(f"rigs {source}: {describe_name_difference(names, theirs)}")
    rigs: list[Rig] = []
    for number, frames in members.items():
        order = sorted(sensors[number])
        poses = [sensors[number][sensor] for sensor in order]
        named = [
            tuple(ours_of.get(frames[frame].get(sensor, "")) for sensor in order)
            for frame in sorted(frames)
        ]
        rigs += _with_frames(poses, named)
    return tuple(rigs)


def _with_frames(
    poses: Sequence[Pose | None], frames: Sequence[tuple[str | None, ...]]
) -> tuple[Rig, ...]:
    """Return a rig with the frames that have images, empty if no frame has two images."""
    counts = [sum(name is not None for name in frame) for frame in frames]
    if max(counts, default=0) < 2:
        return ()
    used = [frame for frame, count in zip(frames, counts, strict=True) if count]
    return (Rig(tuple(poses), tuple(used)),)


def _read_config(path: Path, names: Collection[str]) -> tuple[Rig, ...]:
    """Read COLMAP's ``rig_config.json``: images with equal names below prefixes form a frame."""
    try:
        content = json.loads(read_text_file(path))
    except (OSError, ValueError) as error:
        raise InputError(f"rigs {path}: the file cannot be read as JSON: {error}") from error
    if not isinstance(content, list) or not all(isinstance(rig, dict) for rig in content):
        raise InputError(
            f"rigs {path}: the file must be a list of rigs, as COLMAP's rig_config.json"
        )
    rigs: list[Rig] = []
    for number, rig in enumerate(content, start=1):
        where = f"rigs {path}, rig {number}"
        cameras = rig.get("cameras")
        if not isinstance(cameras, list) or len(cameras) < 2:
            raise InputError(f"{where}: 'cameras' must be a list of at least two cameras")
        prefixes = [_prefix(where, camera) for camera in cameras]
        poses = [
            _config_pose(f"{where}, camera {prefix!r}", camera)
            for prefix, camera in zip(prefixes, cameras, strict=True)
        ]
        rigs += _group_by_name(names, prefixes, poses, where)
    return tuple(rigs)


def _group_by_name(
    names: Collection[str], prefixes: Sequence[str], poses: Sequence[Pose | None], where: str
) -> tuple[Rig, ...]:
    """Return the rig whose frames are images with equal names after the prefix of their camera."""
    by_suffix: dict[str, list[str | None]] = {}
    for name in sorted(names):
        matching = [k for k, prefix in enumerate(prefixes) if name.startswith(prefix)]
        if len(matching) > 1:
            raise InputError(f"{where}: image {name!r} starts with two of the image_prefixes")
        for k in matching:
            suffix = name[len(prefixes[k]) :]
            by_suffix.setdefault(_stem(suffix), [None] * len(prefixes))[k] = name
    return _with_frames(poses, [tuple(frame) for frame in by_suffix.values()])


def _stem(name: str) -> str:
    """Return a name without its extension, because cameras may write different formats."""
    return name.rsplit(".", 1)[0]


def _prefix(where: str, camera: Any) -> str:
    """Return the ``image_prefix`` of a camera of a rig configuration."""
    prefix = camera.get("image_prefix") if isinstance(camera, dict) else None
    if not isinstance(prefix, str) or not prefix:
        raise InputError(f"{where}: every camera needs an 'image_prefix', such as 'left/'")
    return prefix


def _config_pose(where: str, camera: Mapping[str, Any]) -> Pose | None:
    """Return ``sensor_from_rig`` of a camera of a rig configuration, None if unknown."""
    if camera.get("ref_sensor"):
        return np.eye(3), np.zeros(3)
    rotation = camera.get("cam_from_rig_rotation")
    translation = camera.get("cam_from_rig_translation")
    if rotation is None and translation is None:
        return None
    if rotation is None or translation is None:
        raise InputError(
            f"{where}: 'cam_from_rig_rotation' or 'cam_from_rig_translation' is missing; give "
            "both, or none if the pose is unknown"
        )
    try:
        values = np.array([*rotation, *translation], dtype=np.float64)
    except (TypeError, ValueError):
        values = np.full(7, np.nan)
    if len(values) != 7 or not np.isfinite(values).all() or not values[:4].any():
        raise InputError(
            f"{where}: 'cam_from_rig_rotation' must be a quaternion [w, x, y, z], and "
            "'cam_from_rig_translation' three numbers"
        )
    return _pose(values[:4], values[4:])


def _pose(wxyz: np.ndarray, translation: np.ndarray) -> Pose:
    """Convert a quaternion of any length and a translation to a pose."""
    xyzw = np.array([*wxyz[1:], wxyz[0]]) / np.linalg.norm(wxyz)
    return np.asarray(pycolmap.Rotation3d(xyzw).matrix()), np.array(translation)


def _split(matrix: np.ndarray) -> Pose:
    """Split a pose matrix (3, 4) into rotation and translation."""
    return matrix[:, :3].copy(), matrix[:, 3].copy()
