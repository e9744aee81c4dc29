"""Content-addressed cache of provider results on disk.

The key of a cache entry is the hash of all inputs of the result: options, weights and images. A
cache entry is therefore never out of date. Each entry is written to a temporary file and renamed
when complete. A damaged cache entry is computed again, so entries are not flushed to disk one by
one, which would take longer than matching an image pair.
"""

from __future__ import annotations

import errno
import functools
import hashlib
import json
import logging
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any, TypeVar, cast, get_args, get_origin, get_type_hints

import numpy as np
from numpy.typing import NDArray

from mpsfm_core.data.decisions import Reason
from mpsfm_core.data.errors import OutputError
from mpsfm_core.support.files import remove_temporary_files, write_file
from mpsfm_core.support.npz import read_npz
from mpsfm_core.support.user_folders import user_cache_folder

_log = logging.getLogger(__name__)

T = TypeVar("T")
Arrays = Mapping[str, NDArray[Any]]

FORMAT = 1
"""Version of the file format of cache entries; raising the number invalidates all entries."""


class Cache:
    """Folder of cache entries, shared by threads and processes.

    Args:
        folder: Cache folder, default ``$MPSFM_CACHE`` or the platform's user cache. Cache entries
            are stored in the subfolder ``extraction/`` of the cache folder.
    """

    def __init__(self, folder: Path | None = None) -> None:
        self.folder = cache_folder(folder) / "extraction"
        self._unfinished = self.folder / "unfinished"
        remove_temporary_files(self._unfinished)

    def load(self, kind: str, key: str, cls: type[T]) -> T | None:
        """Load a cache entry as an object of ``cls``, or None without a readable entry."""
        path = self._path(kind, key)
        try:
            return unpack(cls, read_npz(path))
        except FileNotFoundError:
            return None
        except OSError as error:
            _log.warning(
                "cache entry %s cannot be read (%s): the result is computed again", path, error
            )
            return None
        except Exception as error:  # constructors of data classes raise errors of any kind
            _log.warning(
                "cache entry %s is damaged (%s): the result is computed again", path, error
            )
            return None

    def store(self, kind: str, key: str, value: object) -> None:
        """Store an object as a cache entry.

        Raises:
            OutputError: the entry cannot be written to disk.
        """
        path, arrays = self._path(kind, key), cast(Any, pack(value))
        try:
            write_file(path, lambda file: np.savez(file, **arrays), self._unfinished, sync=False)
        except OSError as error:
            reason = "the disk is full" if error.errno == errno.ENOSPC else str(error)
            raise OutputError(
                f"cannot write to the cache {self.folder}: {reason}; free disk space or set "
                f"runtime.cache_dir"
            ) from error

    def forget(self, kind: str, key: str) -> None:
        """Delete a cache entry if it exists."""
        with suppress(OSError):
            self._path(kind, key).unlink()

    def _path(self, kind: str, key: str) -> Path:
        return self.folder / kind / key[:2] / f"{key}.npz"


def cache_folder(folder: Path | None = None) -> Path:
    """Return the cache folder, ``folder`` if given, else ``$MPSFM_CACHE`` or the user cache."""
    return user_cache_folder() if folder is None else Path(folder).expanduser()


def content_key(*parts: object) -> str:
    """Return the SHA-256 of plain data (numbers, texts, lists, dictionaries with text keys)."""
    text = json.dumps([FORMAT, *parts], sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()


def digest(value: object) -> str:
    """Return the SHA-256 of the arrays of a data object, independent of their memory layout.

    Raises:
        TypeError: The data object contains a value that is no array, number or text.
    """
    sha256 = hashlib.sha256()
    for name, array in pack(value).items():
        sha256.update(f"{name} {array.dtype.str} {array.shape}\n".encode())
        sha256.update(np.ascontiguousarray(array).reshape(-1).view(np.uint8).data)
    return sha256.hexdigest()


def pack(value: object, prefix: str = "") -> dict[str, NDArray[Any]]:
    """Flatten a data object to a dictionary of arrays by field path; omit values that are None."""
    if value is None:
        return {}
    if isinstance(value, Reason):
        value = json.dumps(value.to_json())
    if isinstance(value, (tuple, Mapping)):
        parts = value.items() if isinstance(value, Mapping) else enumerate(value)
        return {
            name: array
            for key, part in parts
            for name, array in pack(part, f"{prefix}/{key}").items()
        }
    if not is_dataclass(value):
        array = np.asarray(value)
        if array.dtype.hasobject:
            raise TypeError(
                f"{prefix}: the type {type(value).__name__} cannot be converted to an array"
            )
        return {prefix or "value": array}
    arrays: dict[str, NDArray[Any]] = {}
    for field in fields(value):
        path = f"{prefix}/{field.name}" if prefix else field.name
        arrays |= pack(getattr(value, field.name), path)
    return arrays


def unpack(cls: type[T], arrays: Arrays, prefix: str = "") -> T:
    """Rebuild an object of ``cls`` (a data class, or an array) from the result of :func:`pack`."""
    if not is_dataclass(cls):
        return arrays[prefix or "value"]  # type: ignore[return-value]
    hints = _hints(cls)
    values: dict[str, Any] = {}
    for field in fields(cls):
        path = f"{prefix}/{field.name}" if prefix else field.name
        nested = _data_class(hints[field.name])
        if nested and get_origin(hints[field.name]) is tuple:
            values[field.name] = _unpack_tuple(nested, arrays, path)
        elif nested and any(name.startswith(path + "/") for name in arrays):
            values[field.name] = unpack(nested, arrays, path)
        elif path in arrays:
            values[field.name] = arrays[path].item() if arrays[path].ndim == 0 else arrays[path]
        else:
            values[field.name] = None
    return cls(**values)


def _unpack_tuple(cls: type[T], arrays: Arrays, path: str) -> tuple[T, ...]:
    names = {name.removeprefix(f"{path}/").partition("/")[0] for name in arrays if "/" in name}
    count = sum(f"{index}" in names for index in range(len(names)))
    return tuple(unpack(cls, arrays, f"{path}/{index}") for index in range(count))


_hints = functools.cache(get_type_hints)  # get_type_hints takes longer than reading a small entry


def _data_class(hint: object) -> type | None:
    """Return the data class ``C`` of an annotation ``C``, ``C | None`` or ``tuple[C, ...]``."""
    kinds = (hint, *get_args(hint))
    return next((k for k in kinds if isinstance(k, type) and is_dataclass(k)), None)
