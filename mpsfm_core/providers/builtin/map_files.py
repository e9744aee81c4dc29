"""Readers of depth, normal and mask files, which are named after their image."""

from __future__ import annotations

import importlib
import io
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from mpsfm_core.data import View
from mpsfm_core.data.errors import InputError
from mpsfm_core.inputs.image_decoding import check_size, find_map_orientation, orient
from mpsfm_core.inputs.options import InputOptions
from mpsfm_core.providers.builtin.options import FileOptions
from mpsfm_core.support.npz import parse_arrays, read_npz

_SUFFIXES = (".npz", ".npy", ".exr", ".png", ".tif", ".tiff")
_SINGLE_CHANNELS = ("Z", "Y", "depth.Z", "Depth.Z", "R", "V")
_VECTOR_CHANNELS = (("X", "Y", "Z"), ("R", "G", "B"))
_MAX_ASPECT_DIFFERENCE = 0.02
"""Largest relative difference between the aspect ratios of a map file and its image. Rounding the
width and height of a downsampled map changes the aspect ratio by less than 2 %."""


def find_file(options: FileOptions, view: View, what: str) -> Path:
    """Find the depth, normal or mask file of an image.

    Args:
        options: Folder and file name suffix of the map files.
        view: Undistorted image; its name selects the map file.
        what: Name of the quantity in error messages, such as "depth".

    Returns:
        Path of the existing map file.

    Raises:
        InputError: The image has no map file; the error message contains the expected path.
    """
    suffixes = _SUFFIXES if options.suffix is None else (options.suffix,)
    full = options.directory / view.name
    bases = [full, full.with_suffix("")]
    candidates = [base.with_name(base.name + suffix) for base in bases for suffix in suffixes]
    path = next((path for path in candidates if path.is_file()), None)
    path = path or _find_ignoring_case(candidates)
    if path is not None:
        return path
    wanted = f"{bases[1]}{suffixes[0] if len(suffixes) == 1 else '{' + ','.join(suffixes) + '}'}"
    raise InputError(
        f"{what} of image {view.name!r}: there is no file {wanted}; check the options `directory` "
        "and `suffix`"
    )


def _find_ignoring_case(candidates: list[Path]) -> Path | None:
    """Return the first candidate file whose name differs from the expected name only in case."""
    folder = candidates[0].parent
    if not folder.is_dir():
        return None
    files = {path.name.casefold(): path for path in sorted(folder.iterdir(), reverse=True)}
    names = (path.name.casefold() for path in candidates)
    return next((files[name] for name in names if name in files), None)


def read_upright_arrays(
    options: FileOptions, path: Path, main: str, view: View
) -> tuple[dict[str, NDArray[Any]], int]:
    """Read the named arrays of a map file, and rotate them as EXIF rotates the image.

    Args:
        options: Orientation of the map files.
        path: As of :func:`read_arrays`.
        main: As of :func:`read_arrays`.
        view: Undistorted image that the map belongs to.

    Returns:
        Arrays of the map file by name, and the EXIF orientation by which the grids of the arrays
        were rotated, 1 for upright maps. Vectors in the arrays, such as normals, are not rotated.
    """
    arrays = read_arrays(path, main)
    height, width = (*arrays[main].shape, 0, 0)[:2]
    orientation = find_map_orientation(
        (width, height), view.camera.size, view.orientation, options.orientation
    )
    grids = {k: orient(v, orientation) if v.ndim >= 2 else v for k, v in arrays.items()}
    return grids, orientation


def read_arrays(path: Path, main: str) -> dict[str, NDArray[Any]]:
    """Read the named arrays of a map file.

    Args:
        path: Path of an NPZ, NPY, EXR or image file; color channels are returned in the order RGB.
        main: Name of the required array, such as "depth". The only array of an NPY, EXR or image
            file is returned under the name of the required array.

    Returns:
        Arrays of the map file by name.

    Raises:
        InputError: The map file cannot be read or lacks the required array.
    """
    try:
        if path.suffix in (".npz", ".npy"):
            arrays = _read_numpy(path, main)
        elif path.suffix == ".exr":
            arrays = {main: _read_exr(path)}
        else:
            arrays = {main: _read_image(path)}
    except InputError:
        raise
    except Exception as error:  # Parsers raise exceptions of any type for a damaged file.
        raise InputError(
            f"map file {path} cannot be read: {type(error).__name__}: {error}"
        ) from error
    if main not in arrays:
        raise InputError(
            f"map file {path} has no array {main!r}, only {', '.join(arrays) or 'none'}"
        )
    return arrays


def check_map(path: Path, values: NDArray[Any], view: View, channels: int) -> None:
    """Raise an error if the number of channels or the aspect ratio of a map file is wrong.

    Args:
        path: Path of the map file, for error messages.
        values: Depth, normal or mask map, (h, w) or (h, w, channels).
        view: Undistorted image that the map belongs to.
        channels: Expected number of channels of the map.

    Raises:
        InputError: The number of channels is wrong, or the aspect ratio of the map differs from
            that of the image.
    """
    expected = 2 if channels == 1 else 3
    if values.ndim != expected or (channels > 1 and values.shape[2] != channels):
        wanted = "one channel" if channels == 1 else f"{channels} channels"
        raise InputError(f"map file {path} must have {wanted}, but has shape {values.shape}")
    height, width = values.shape[:2]
    aspect = (width / max(height, 1)) / (view.camera.width / view.camera.height)
    if not 1 - _MAX_ASPECT_DIFFERENCE < aspect < 1 + _MAX_ASPECT_DIFFERENCE:
        raise InputError(
            f"map file {path} does not cover image {view.name!r}, because the map ({width}x"
            f"{height}) and the image ({view.camera.width}x{view.camera.height}) differ in aspect "
            f"ratio"
        )


def _read_numpy(path: Path, main: str) -> dict[str, NDArray[Any]]:
    if path.suffix == ".npz":
        return read_npz(path)
    # Load the file into memory first, because numpy does not close a damaged file.
    data = path.read_bytes()
    array = parse_arrays(lambda: np.lib.format.read_array(io.BytesIO(data), allow_pickle=False))
    return {main: array}


def _read_image(path: Path) -> NDArray[Any]:
    content = path.read_bytes()
    check_size(content, path, InputOptions().max_pixels)
    data = np.frombuffer(content, dtype=np.uint8)
    pixels = cv2.imdecode(data, cv2.IMREAD_UNCHANGED) if data.size else None
    if pixels is None:
        raise ValueError("the file is damaged or not an image")
    if pixels.ndim == 3:
        pixels = pixels[..., 2::-1] if pixels.shape[2] >= 3 else pixels[..., 0]
    return np.asarray(pixels)


def _read_exr(path: Path) -> NDArray[Any]:
    try:
        openexr = importlib.import_module("OpenEXR")
    except ImportError as error:
        raise InputError(
            f"reading EXR file {path} needs the package OpenEXR: pip install OpenEXR"
        ) from error
    try:
        with openexr.File(str(path), separate_channels=True) as file:
            channels = {name: c.pixels for name, c in file.channels().items()}
    except RuntimeError as error:
        raise ValueError(error) from error
    return _choose_channels(channels)


def _choose_channels(channels: dict[str, NDArray[Any]]) -> NDArray[Any]:
    """Return EXR channels X, Y, Z or R, G, B as (h, w, 3), else the depth channel as (h, w)."""
    if len(channels) == 1:
        return next(iter(channels.values()))
    for names in _VECTOR_CHANNELS:
        if all(name in channels for name in names):
            return np.stack([channels[name] for name in names], axis=-1)
    for name in _SINGLE_CHANNELS:
        if name in channels:
            return channels[name]
    raise ValueError(f"the EXR file has only unknown channels: {', '.join(sorted(channels))}")
