"""Import of datasets whose ground truth is a COLMAP model."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pycolmap

from mpsfm_core.data import Float64, Int64
from mpsfm_core.evaluation.importers.frames import Frame, FrameObservations, photo_size
from mpsfm_core.inputs.models import read_model


def model_frames(folder: Path, photo_of: Callable[[str], Path]) -> list[Frame]:
    """Read the registered images of a COLMAP model as frames.

    The intrinsics are rescaled to the size of the image files.

    Args:
        folder: COLMAP model.
        photo_of: Function that returns the file path for an image name; images without a file are
            skipped.
    """
    model = read_model(folder)
    frames = []
    for image in sorted(model.images.values(), key=lambda image: str(image.name)):
        photo = photo_of(str(image.name))
        if image.has_pose and photo.is_file():
            pose = np.asarray(image.cam_from_world().matrix(), dtype=np.float64)
            camera = pycolmap.Camera(image.camera.todict())
            size = photo_size(photo)
            scale = np.array(size) / [camera.width, camera.height]
            if size != (camera.width, camera.height):
                camera.rescale(*size)
            seen = _observations(model, image, scale)
            frames.append(Frame(photo.name, photo, camera, pose, None, seen))
    return frames


def _observations(
    model: pycolmap.Reconstruction, image: pycolmap.Image, scale: Float64
) -> FrameObservations:
    """Return the observations of an image, one for each observed 3D point."""
    seen = {int(point.point3D_id): point.xy for point in image.get_observation_points2D()}
    ids: Int64 = np.array(list(seen), dtype=np.int64)
    return FrameObservations(
        np.array([xy * scale for xy in seen.values()]).reshape(-1, 2),
        ids,
        np.array([model.points3D[int(i)].xyz for i in ids]).reshape(-1, 3),
    )
