"""Write nerfstudio's ``transforms.json`` from a COLMAP model."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap

from mpsfm_core.inputs.nerfstudio import DISTORTION_KEYS, OPENGL_FROM_OPENCV


def supports_camera(camera: pycolmap.Camera) -> bool:
    """Return whether ``transforms.json`` supports a camera model without undistortion."""
    return camera.model_name in DISTORTION_KEYS


def write_transforms(path: Path, model: pycolmap.Reconstruction, files: Mapping[str, str]) -> None:
    """Write poses and cameras of a COLMAP model as ``transforms.json``.

    Args:
        path: path of the ``transforms.json`` to write.
        model: COLMAP model whose images all have a pose.
        files: paths of the image files by image name, relative to the folder of ``path``.
    """
    frames = []
    for image in sorted(model.images.values(), key=lambda image: str(image.name)):
        pose = np.eye(4)
        pose[:3] = image.cam_from_world().inverse().matrix()
        frames.append(
            {
                "file_path": files[image.name],
                "transform_matrix": (pose @ OPENGL_FROM_OPENCV).tolist(),
                **_intrinsics(model.cameras[image.camera_id]),
            }
        )
    path.write_text(json.dumps({"frames": frames}, indent=2), encoding="utf-8")


def _intrinsics(camera: pycolmap.Camera) -> dict[str, Any]:
    names = DISTORTION_KEYS[camera.model_name]
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
