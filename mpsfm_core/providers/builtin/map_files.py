"""Maps read from files of several formats, found by the name of their image."""

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
from mpsfm_core.inputs.image_decoding import check_size
from mpsfm_core.inputs.options import InputOptions
from mpsfm_core.providers.builtin.options import FileOptions
from mpsfm_core.support.npz import read_npz

_SUFFIXES = (".npz", ".npy", ".exr", ".png", ".tif", ".tiff")
_SINGLE_CHANNELS = ("Z", "Y", "depth.Z", "Depth.Z", "R", "V")
_VECTOR_CHANNELS = (("X", "Y", "Z"), ("R", "G", "B"))
_MAX_ASPECT_DIFFERENCE = 0.02
"""Rounding of a reduced map's size stays below; a map of a cropped image does not."""


def find_file(options: FileOptions, view: View, what: str) -> Path:
    """The file of a view; raises :class:`InputError` that names what was looked for."""
    suffixes = _SUFFIXES if options.suffix is None else (options.suffix,)
    full = options.directory / view.name
    bases = [full, full.with_suffix("")]
    for base in bases:
        for suffix in suffixes:
            path = _find_ignoring_case(base.with_name(base.name + suffix))
            if path is not None:
                return path
    wanted = f"{bases[1]}{suffixes[0] if len(suffixes) == 1 else '{' + ','.join(suffixes) + '}'}"
    raise InputError(f"{what} of image {view.name!r}: there is no file {wanted}")


def _find_ignoring_case(path: Path) -> Path | None:
    """Return the file of this name, else the one whose name differs only in case."""
    if path.is_file():
        return path
    if not path.parent.is_dir():
        return None
    name = path.name.casefold()
    similar = (other for other in path.parent.iterdir() if other.name.casefold() == name)
    return next((other for other in sorted(similar) if other.is_file()), None)


def read_arrays(path: Path, main: str) -> dict[str, NDArray[Any]]:
    """The arrays of an NPZ by name; of any other format its one map under the name ``main``.

    Colours are in RGB order. Raises :class:`InputError` when the file cannot be read.
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
    except Exception as error:  # readers of damaged files raise what their parsers raise
        raise InputError(f"{path} cannot be read: {type(error).__name__}: {error}") from error
    if main not in arrays:
        raise InputError(f"{path} has no array {main!r}, it has {', '.join(arrays) or 'none'}")
    return arrays


def check_map(path: Path, values: NDArray[Any], view: View, channels: int) -> None:
    """Raise :class:`InputError` unless the map is (h, w) or (h, w, channels) and covers the
    view."""
    expected = 2 if channels == 1 else 3
    if values.ndim != expected or (channels > 1 and values.shape[2] != channels):
        wanted = "one channel" if channels == 1 else f"{channels} channels"
        raise InputError(f"{path}: expected a map of {wanted}, it has shape {values.shape}")
    height, width = values.shape[:2]
    aspect = (width / max(height, 1)) / (view.camera.width / view.camera.height)
    if not 1 - _MAX_ASPECT_DIFFERENCE < aspect < 1 + _MAX_ASPECT_DIFFERENCE:
        raise InputError(
            f"{path} has {width}x{height} pixels and so does not cover image {view.name!r} "
            f"({view.camera.width}x{view.camera.height})"
        )


def _read_numpy(path: Path, main: str) -> dict[str, NDArray[Any]]:
    if path.suffix == ".npz":
        return read_npz(path)
    # From memory, because numpy leaves a damaged file open.
    return {main: np.lib.format.read_array(io.BytesIO(path.read_bytes()), allow_pickle=False)}


def _read_image(path: Path) -> NDArray[Any]:
    content = path.read_bytes()
    check_size(content, path, InputOptions().max_pixels)
    data = np.frombuffer(content, dtype=np.uint8)
    pixels = cv2.imdecode(data, cv2.IMREAD_UNCHANGED) if data.size else None
    if pixels is None:
        raise ValueError("it is damaged or no image")
    if pixels.ndim == 3:
        pixels = pixels[..., 2::-1] if pixels.shape[2] >= 3 else pixels[..., 0]
    return np.asarray(pixels)


def _read_exr(path: Path) -> NDArray[Any]:
    try:
        openexr = importlib.import_module("OpenEXR")
    except ImportError as error:
        raise InputError(
            f"{path}: reading EXR needs the package OpenEXR: pip install OpenEXR"
        ) from error
    try:
        with openexr.File(str(path), separate_channels=True) as file:
            channels = {name: c.pixels for name, c in file.channels().items()}
    except RuntimeError as error:
        raise ValueError(error) from error
    return _choose_channels(channels)


def _choose_channels(channels: dict[str, NDArray[Any]]) -> NDArray[Any]:
    """(h, w, 3) of an X, Y, Z or R, G, B image, else (h, w) of its depth channel."""
    if len(channels) == 1:
        return next(iter(channels.values()))
    for names in _VECTOR_CHANNELS:
        if all(name in channels for name in names):
            return np.stack([channels[name] for name in names], axis=-1)
    for name in _SINGLE_CHANNELS:
        if name in channels:
            return channels[name]
    raise ValueError(f"none of its channels {', '.join(sorted(channels))} is known")
