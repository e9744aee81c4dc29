"""Write and read the files of refined depth maps."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mpsfm_core.data import DepthPrior, PinholeCamera
from mpsfm_core.data.errors import InputError
from mpsfm_core.mapping.scene.reconstruction import Reconstruction, RegisteredImage
from mpsfm_core.support.format_versions import VERSION, check_version
from mpsfm_core.support.npz import read_npz, write_npz
from mpsfm_core.support.threads import parallel_map

FORMAT = 1
"""Format version of the depth map files."""


def write_depth_maps(folder: Path, reconstruction: Reconstruction) -> None:
    """Write ``folder/NAME.npz`` for each registered image (NAME includes its extension).

    ``depth`` (h, w) float32 is the z-depth in units of the COLMAP model, and ``variance`` (h, w)
    float32 the depth variance in squared units. ``valid`` (h, w) bool is the mask of valid depth.
    ``camera`` (4,) float64 is fx, fy, cx, cy of the undistorted depth grid in COLMAP pixels.
    ``cam_from_world`` (3, 4) float64 is the camera pose.
    """

    def write(image: RegisteredImage) -> None:
        height, width = image.depth.shape
        assert image.depth.variance is not None  # refined depth maps have a variance
        arrays: dict[str, Any] = {
            VERSION: np.array(FORMAT),
            "depth": image.depth.depth,
            "variance": image.depth.variance,
            "valid": image.depth.valid,
            "camera": image.camera.resized(width, height).params,
            "cam_from_world": np.column_stack([image.rotation, image.translation]),
        }
        write_npz(folder / f"{image.name}.npz", **arrays)

    parallel_map(write, reconstruction.images)


def read_depth_map(path: Path, scale: float = 1.0) -> tuple[PinholeCamera, DepthPrior]:
    """Read a depth map that :func:`write_depth_maps` wrote.

    Args:
        path: depth map file to read.
        scale: factor that multiplies the depth.

    Returns:
        The camera of the depth grid, and the scaled depth map.

    Raises:
        InputError: the file is damaged, has a newer format version or is not a depth map.
    """
    arrays = load_depth_map(path)
    try:
        depth, variance = arrays["depth"], arrays["variance"]
        rows, columns = depth.shape
        grid = PinholeCamera(columns, rows, *map(float, arrays["camera"]))
        scaled = depth * np.float32(scale), variance * np.float32(scale**2)
        return grid, DepthPrior(*scaled, arrays["valid"])
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path} is not a depth map of a run: {error}") from error


def load_depth_map(path: Path) -> dict[str, NDArray[Any]]:
    """Read the arrays of a depth map file without checking their content.

    Raises:
        InputError: the file is damaged or has a newer format version.
    """
    try:
        arrays = read_npz(path)
    except (OSError, ValueError) as error:
        raise InputError(f"{path} is damaged or not a depth map of a run: {error}") from error
    check_version(arrays, FORMAT, path)
    return arrays
