"""Providers that read depth, normals and masks of sensors or other programs from files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from mpsfm_core.data import Bool, DepthPrior, NormalPrior, View
from mpsfm_core.data.errors import InputError
from mpsfm_core.inputs.model_orientation import orientation_matrix
from mpsfm_core.providers import ProviderContext
from mpsfm_core.providers.builtin.map_files import (
    check_map,
    find_file,
    read_upright_arrays,
)
from mpsfm_core.providers.builtin.options import (
    DepthFileOptions,
    MaskFileOptions,
    NormalFileOptions,
)

_MIN_ENCODED_LENGTH = 0.5
"""Smallest length of a valid normal vector that is decoded from a color. Mid-gray, which encodes an
unknown normal, is decoded to a vector of length near zero."""


class DepthFiles:
    """Depth provider that reads depth maps and their uncertainty from files."""

    def __init__(self, options: DepthFileOptions, context: ProviderContext) -> None:
        self._options = options

    def predict(self, view: View) -> DepthPrior:
        """Read the depth map of an image from a file, in the resolution of the file.

        Args:
            view: Undistorted image; its name selects the map file.

        Returns:
            Depth map with the variance of each pixel.

        Raises:
            InputError: The map file is missing, unreadable or does not cover the image, or neither
                the depth file nor the options declare a variance.
        """
        path = find_file(self._options, view, "depth")
        arrays, _ = read_upright_arrays(self._options, path, "depth", view)
        stored = _grayscale(path, arrays["depth"])
        check_map(path, stored, view, 1)
        depth = stored.astype(np.float64) * self._options.scale
        valid = _optional(path, arrays, "valid", view)
        variance = self._variance(path, depth, arrays, view)
        return DepthPrior.from_arrays(depth, variance, valid, metric=self._options.metric)

    def _variance(
        self, path: Path, depth: NDArray[Any], arrays: dict[str, NDArray[Any]], view: View
    ) -> NDArray[Any]:
        options = self._options
        stored = _optional(path, arrays, "variance", view)
        if options.variance is not None:
            path = find_file(options.variance, view, "depth variance")
            arrays, _ = read_upright_arrays(options.variance, path, "variance", view)
            stored = arrays["variance"]
            check_map(path, stored, view, 1)
        if stored is None and options.relative_std is None and options.std_floor == 0:
            raise InputError(
                f"depth file {path} has no variance: declare the depth uncertainty, for example "
                f"with depth.options.relative_std=0.02"
            )
        if stored is not None and stored.shape != depth.shape:
            raise InputError(
                f"map file {path}: the shapes of variance {stored.shape} and depth {depth.shape} "
                f"differ"
            )
        with np.errstate(invalid="ignore"):
            variance = np.maximum(
                ((options.relative_std or 0.0) * depth) ** 2, options.std_floor**2
            )
            if stored is not None:
                variance = np.maximum(variance, stored.astype(np.float64) * options.scale**2)
        return variance


class NormalFiles:
    """Normals provider that reads normal maps from files."""

    def __init__(self, options: NormalFileOptions, context: ProviderContext) -> None:
        self._options = options

    def predict(self, view: View, depth: DepthPrior | None = None) -> NormalPrior:
        """Read the normal map of an image from a file, in the resolution of the file.

        Args:
            view: Undistorted image; its name selects the map file.
            depth: Depth prior of the image, which a provider of normal files ignores.

        Returns:
            Unit normals in the camera frame.

        Raises:
            InputError: The map file is missing, unreadable or does not cover the image.
        """
        path = find_file(self._options, view, "normals")
        arrays, orientation = read_upright_arrays(self._options, path, "normals", view)
        normals = _decoded(arrays["normals"])
        check_map(path, normals, view, 3)
        if self._options.frame == "opengl":
            normals = normals * np.array([1.0, -1.0, -1.0])
        normals = normals @ orientation_matrix(orientation).T
        with np.errstate(invalid="ignore"):
            usable = np.linalg.norm(normals, axis=-1) > _MIN_ENCODED_LENGTH
        valid = _optional(path, arrays, "valid", view)
        if valid is not None:
            usable &= valid.astype(np.bool_)
        variance = _optional(path, arrays, "variance", view)
        if variance is None and self._options.std_deg is not None:
            variance = np.full(usable.shape, np.radians(self._options.std_deg) ** 2)
        return NormalPrior.from_arrays(normals, variance, usable, camera=view.camera)


class MaskFiles:
    """Mask provider that reads masks of any size from files."""

    def __init__(self, options: MaskFileOptions, context: ProviderContext) -> None:
        self._options = options

    def mask(self, view: View) -> Bool:
        """Read a mask from a file and resize it to the image by nearest neighbor.

        Args:
            view: Undistorted image; its name selects the map file.

        Returns:
            Mask (H, W) bool, True where a pixel may be used.

        Raises:
            InputError: The map file is missing, unreadable or does not cover the image.
        """
        path = find_file(self._options, view, "mask")
        arrays, _ = read_upright_arrays(self._options, path, "mask", view)
        values = arrays["mask"]
        allowed = (values.any(axis=-1) if values.ndim == 3 else values != 0) != self._options.invert
        check_map(path, allowed, view, 1)
        if not allowed.any():
            raise InputError(
                f"mask {path} excludes every pixel of image {view.name!r}; leave the image out, or "
                f"set the option 'invert' if black pixels may be used"
            )
        resized = cv2.resize(
            allowed.astype(np.uint8), view.camera.size, interpolation=cv2.INTER_NEAREST_EXACT
        )
        return np.asarray(resized > 0)


def _grayscale(path: Path, stored: NDArray[Any]) -> NDArray[Any]:
    """Return one channel of a depth map stored as gray RGB; raise InputError for a color image."""
    if stored.ndim == 3 and stored.shape[2] == 3:
        if (stored == stored[..., :1]).all():
            return np.asarray(stored[..., 0])
        raise InputError(f"depth file {path} is a color image; a depth map has one channel")
    return stored


def _optional(
    path: Path, arrays: dict[str, NDArray[Any]], name: str, view: View
) -> NDArray[Any] | None:
    """Return an optional array of a map file, such as ``valid``, after checking its shape."""
    values = arrays.get(name)
    if values is not None:
        check_map(path, values, view, 1)
    return values


def _decoded(stored: NDArray[Any]) -> NDArray[Any]:
    """Decode unsigned integers to normals in [-1, 1]; leave floating-point normals unchanged."""
    if np.issubdtype(stored.dtype, np.unsignedinteger):
        return stored.astype(np.float64) / np.iinfo(stored.dtype).max * 2 - 1
    return stored.astype(np.float64)
