"""``transforms.json``, the camera file of nerfstudio and of tools that read its format."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap

_COEFFICIENTS: Mapping[str, tuple[str, ...]] = {
    "SIMPLE_PINHOLE": (),
    "PINHOLE": (),
    "SIMPLE_RADIAL": ("k1",),
    "RADIAL": ("k1", "k2"),
    "OPENCV": ("k1", "k2", "p1", "p2"),
    "OPENCV_FISHEYE": ("k1", "k2", "k3", "k4"),
}
"""COLMAP models the format can hold, and its names for the parameters behind the intrinsics."""


def can_hold(camera: pycolmap.Camera) -> bool:
    """Whether the format has this camera model; others have to be undistorted first."""
    return camera.model_name in _COEFFICIENTS


def write_transforms(path: Path, model: pycolmap.Reconstruction, files: Mapping[str, str]) -> None:
    """Write poses and cameras of a model.

    ``files``: image name -> path of its picture, relative to the folder of ``path``. Poses are
    ``world_from_cam`` with OpenGL's axes (x right, y up, z backward); the world is the model's.
    """
    frames = []
    for image in sorted(model.images.values(), key=lambda image: str(image.name)):
        pose = np.eye(4)
        pose[:3] = image.cam_from_world().inverse().matrix()
        pose[:3, 1:3] *= -1
        frames.append(
            {
                "file_path": files[image.name],
                "transform_matrix": pose.tolist(),
                **_intrinsics(model.cameras[image.camera_id]),
            }
        )
    path.write_text(json.dumps({"frames": frames}, indent=2), encoding="utf-8")


def _intrinsics(camera: pycolmap.Camera) -> dict[str, Any]:
    names = _COEFFICIENTS[camera.model_name]
    matrix = camera.calibration_matrix()
    fisheye = camera.model_name == "OPENCV_FISHEYE"
    return {
        "camera_model": "OPENCV_FISHEYE" if fisheye else "OPENCV",
        "w": camera.width,
        "h": camera.height,
        "fl_x": matrix[0, 0],
        "fl_y": matrix[1, 1],
        "cx": matrix[0, 2],
        "cy": matrix[1, 2],
        **dict(zip(names, camera.params[len(camera.params) - len(names) :].tolist(), strict=True)),
    }
