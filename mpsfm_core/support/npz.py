"""Reading and writing of NPZ files, with a size limit and without pickle."""

from __future__ import annotations

import io
import math
import zipfile
from collections.abc import Callable
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

Parsed = TypeVar("Parsed")

MAX_BYTES = 4_000_000_000
"""Maximum bytes of the unpacked arrays of an NPZ file, unless the file itself is larger.

A small compressed file could expand to any size. ``MAX_BYTES`` is 16 bytes for each pixel of
the largest supported image [ours]."""
_COMPRESSION_LEVEL = 1
"""Compression level of zlib for integers and masks. Floats are not compressed, because zlib makes
maps of depth 13 % and maps of normals 24 % smaller, and takes ten times as long as writing."""

_MAGIC = b"\x93NUMPY\x01\x00"
"""First bytes of an NPY file with format version 1.0."""


def write_npz(path: Path, **arrays: NDArray[Any]) -> None:
    """Write named arrays to an NPZ file and create its folder; floats are not compressed.

    Raises:
        OSError: the file cannot be written.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    with zipfile.ZipFile(path, "w", compresslevel=_COMPRESSION_LEVEL) as archive:
        for name, array in arrays.items():
            is_float = array.dtype.kind == "f"
            archive.compression = zipfile.ZIP_STORED if is_float else zipfile.ZIP_DEFLATED
            with archive.open(f"{name}.npy", "w", force_zip64=True) as file:
                np.lib.format.write_array(file, array, allow_pickle=False)


def read_npz(path: Path) -> dict[str, NDArray[Any]]:
    """Read all arrays of an NPZ file by name.

    Raises:
        OSError: the file cannot be read.
        ValueError: the file is damaged, too large, or no NPZ file.
    """
    with path.open("rb") as file:  # numpy.load does not close a damaged file
        try:
            with zipfile.ZipFile(file) as archive:
                size = sum(entry.file_size for entry in archive.infolist())
                if size > max(MAX_BYTES, path.stat().st_size):
                    raise ValueError(
                        f"the file unpacks to {size / 1e6:.0f} megabytes, but only "
                        f"{MAX_BYTES / 1e6:.0f} are allowed"
                    )
                return parse_arrays(partial(_read_arrays, archive))
        except (OSError, ValueError):
            raise
        except Exception as error:  # zipfile and numpy raise unrelated exception classes
            raise ValueError(f"the NPZ file is damaged: {type(error).__name__}: {error}") from error


def parse_arrays(read: Callable[[], Parsed]) -> Parsed:
    """Call a function that reads arrays by numpy, twice if Python fails to parse their headers.

    Python 3.11 and 3.12.0 may raise SystemError ("AST constructor recursion depth mismatch") if
    several threads parse at the same time (CPython issue 106905).
    """
    try:
        return read()
    except SystemError:
        return read()


def _read_arrays(archive: zipfile.ZipFile) -> dict[str, NDArray[Any]]:
    return {
        name.removesuffix(".npy"): _read_array(bytearray(archive.read(name)))
        for name in archive.namelist()
    }


def _read_array(data: bytearray) -> NDArray[Any]:
    """Parse an NPY file without copying its values."""
    if data[:8] != _MAGIC:
        array: NDArray[Any] = np.lib.format.read_array(io.BytesIO(data), allow_pickle=False)
        return array
    start = 10 + int.from_bytes(data[8:10], "little")
    shape, is_fortran, dtype = _parse_header(bytes(data[:start]))
    values = np.frombuffer(data, dtype, math.prod(shape), start)
    return values.reshape(shape, order="F" if is_fortran else "C")


@lru_cache(maxsize=1 << 14)
def _parse_header(header: bytes) -> tuple[tuple[int, ...], bool, np.dtype[Any]]:
    """Parse the header of an NPY file, which takes longer than reading a small array."""
    stream = io.BytesIO(header)
    np.lib.format.read_magic(stream)
    shape, is_fortran, dtype = np.lib.format.read_array_header_1_0(stream)
    if dtype.hasobject:
        raise ValueError("arrays of Python objects are not read")
    return shape, is_fortran, dtype
