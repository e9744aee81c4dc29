"""Importer of sequences of EuRoC MAV and TUM-VI, whose layout is called ASL format.

The source is a sequence with ``mav0/``, or the folder ``mav0`` itself. Images are those of
``cam0``: ``cam0/data.csv`` (lines ``timestamp,file``, nanoseconds), ``cam0/data/`` and
``cam0/sensor.yaml`` (intrinsics, distortion, and ``T_BS``, the pose of the camera in the body
frame). True poses of the body are in ``state_groundtruth_estimate0/data.csv`` (EuRoC) or
``mocap0/data.csv`` (TUM-VI).
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import yaml

from mpsfm_core.data import Float64
from mpsfm_core.data.errors import InputError
from mpsfm_core.evaluation.importers.frames import (
    Frame,
    invert_pose,
    read_image_list,
    require_path,
)
from mpsfm_core.evaluation.importers.tum_rgbd import MAX_GAP_S
from mpsfm_core.evaluation.trajectories import read_trajectory
from mpsfm_core.geometry import compose
from mpsfm_core.inputs.text_files import read_text_file

_TRUTH = ("state_groundtruth_estimate0", "mocap0")
_MODELS = {
    ("pinhole", "radial-tangential"): "OPENCV",
    ("pinhole", "equidistant"): "OPENCV_FISHEYE",
}
"""COLMAP's camera model by camera and distortion model of the sensor file."""


def read_frames(source: Path) -> list[Frame]:
    """Read the images of the first camera that have a true pose, in temporal order."""
    root = source / "mav0" if (source / "mav0").is_dir() else source
    folder = require_path(root / "cam0", "folder of the first camera")
    truth = next((f for name in _TRUTH if (f := root / name / "data.csv").is_file()), None)
    if truth is None:
        raise InputError(f"{root}: true poses are missing: {' or '.join(_TRUTH)}/data.csv")
    camera, cam_from_body = _read_sensor(require_path(folder / "sensor.yaml", "calibration"))
    times, names = read_image_list(
        require_path(folder / "data.csv", "list of images"), separator=",", unit_s=1e-9
    )
    frames = []
    body_poses = read_trajectory(truth).interpolate(times, MAX_GAP_S)
    for name, body_from_world in zip(names, body_poses, strict=True):
        photo = folder / "data" / name
        if body_from_world is not None and photo.is_file():
            pose = compose((cam_from_body[:, :3], cam_from_body[:, 3]), body_from_world)
            frames.append(Frame(name, photo, camera, np.column_stack(pose)))
    return frames


def _read_sensor(path: Path) -> tuple[pycolmap.Camera, Float64]:
    """Read the camera and ``cam_from_body`` (3, 4) from ``sensor.yaml``."""
    try:
        content: dict[str, Any] = yaml.safe_load(read_text_file(path))
        body_from_cam = np.array(content["T_BS"]["data"], dtype=np.float64).reshape(4, 4)
        fx, fy, cx, cy = map(float, content["intrinsics"])
        width, height = map(int, content["resolution"])
        distortion = [float(value) for value in content["distortion_coefficients"]]
        models = (content["camera_model"], content["distortion_model"])
    except (yaml.YAMLError, KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path}: the calibration cannot be read: {error}") from error
    if models not in _MODELS or len(distortion) != 4:
        raise InputError(f"{path}: the camera model {' '.join(models)} is not supported")
    camera = pycolmap.Camera(
        model=_MODELS[models],
        width=width,
        height=height,
        params=[fx, fy, cx + 0.5, cy + 0.5, *distortion],
    )
    return camera, invert_pose(body_from_cam)
