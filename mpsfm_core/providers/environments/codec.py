"""Values of our protocols as a text with numbers and a block of array bytes, and back.

Not pickle: what comes from the other side can be nothing but the types below, and the versions of
Python and numpy of both sides may differ. Known are None, bool, int, float, str, paths, lists,
tuples, dictionaries with text keys, numpy arrays, the data types, and specifications of weights and
calibrations.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel

from mpsfm_core import data
from mpsfm_core.data import UInt8
from mpsfm_core.data.errors import DataError
from mpsfm_core.providers import WeightsFile
from mpsfm_core.providers.uncertainty.calibration import DepthCalibration, NormalCalibration

_ALIGNMENT = 64
_TYPES: Mapping[str, type] = MappingProxyType(
    {
        kind.__name__: kind
        for kind in (
            data.PinholeCamera,
            data.View,
            data.DepthPrior,
            data.NormalPrior,
            data.MultiViewPrior,
            data.Features,
            data.SparseMatches,
            data.DenseMatches,
            data.PairDepth,
            data.PairMatches,
            WeightsFile,
            DepthCalibration,
            NormalCalibration,
        )
    }
)


class EncodedMessage:
    """A value ready to be sent: ``text`` and the arrays that it refers to, in their order."""

    def __init__(self, value: Any) -> None:
        self.arrays: list[NDArray[Any]] = []
        self.size = 0
        """Of the block that :meth:`write` fills, in bytes."""
        self.text = json.dumps(self._plain(value)).encode()

    def write(self, block: memoryview) -> None:
        """Copy the arrays to their places in a block of ``size`` bytes."""
        start = 0
        for array in self.arrays:
            place = np.frombuffer(block, array.dtype, array.size, start).reshape(array.shape)
            np.copyto(place, array)
            start += _aligned(array.nbytes)

    def _plain(self, value: Any) -> Any:
        if value is None or isinstance(value, (bool, int, float, str)):
            return value
        if isinstance(value, Path):
            return {"path": str(value)}
        if isinstance(value, np.ndarray):
            return {"array": self._place(value)}
        if isinstance(value, np.generic):
            return value.item()
        if isinstance(value, (list, tuple)):
            return {type(value).__name__: [self._plain(entry) for entry in value]}
        if isinstance(value, Mapping):
            return {"dict": {str(key): self._plain(entry) for key, entry in value.items()}}
        name = type(value).__name__
        if _TYPES.get(name) is type(value):
            return {"type": name, "fields": {k: self._plain(v) for k, v in _fields(value)}}
        raise DataError("value", f"a {name} cannot be handed to another process")

    def _place(self, array: NDArray[Any]) -> list[Any]:
        if array.dtype.hasobject:
            raise DataError("value", "an array of objects cannot be handed to another process")
        start, self.size = self.size, self.size + _aligned(array.nbytes)
        self.arrays.append(array)
        return [array.dtype.str, list(array.shape), start]


def decode_message(text: bytes, block: UInt8, copy: bool) -> Any:
    """The value again. Its arrays are read-only views of the block, or copies if so asked.

    Data types are put together without the checks of their values: the other side's constructors
    made them, and :mod:`mpsfm_core.providers.validation` checks every answer of a provider,
    wherever it lives. Raises :class:`~mpsfm_core.data.errors.DataError` for what is no value of a
    type above."""

    try:
        return _Unpacking(block, copy).build(json.loads(text))
    except (ValueError, KeyError, TypeError, AttributeError, MemoryError, RecursionError) as error:
        raise DataError("value", f"does not follow the protocol: {error}") from error


class _Unpacking:
    """Of one message. It is gone with it, and arrays alone keep the block."""

    def __init__(self, block: UInt8, copy: bool) -> None:
        self._block, self._copy = block, copy

    def build(self, plain: Any) -> Any:
        if not isinstance(plain, dict):
            return plain
        if "type" in plain:
            values = {key: self.build(entry) for key, entry in plain["fields"].items()}
            return _put_together(_TYPES[plain["type"]], values)
        ((kind_of, content),) = plain.items()
        if kind_of == "array":
            return self._array(content)
        if kind_of == "path":
            return Path(content)
        if kind_of == "dict":
            return {key: self.build(entry) for key, entry in content.items()}
        if kind_of in ("list", "tuple"):
            entries = [self.build(entry) for entry in content]
            return tuple(entries) if kind_of == "tuple" else entries
        raise DataError("value", f"unknown content {kind_of!r}")

    def _array(self, description: list[Any]) -> NDArray[Any]:
        dtype, shape, start = np.dtype(description[0]), tuple(description[1]), description[2]
        count = int(np.prod(shape, dtype=np.int64))
        if not count:
            return np.empty(shape, dtype)
        end = start + count * dtype.itemsize
        view: NDArray[Any] = self._block[start:end].view(dtype).reshape(shape)
        if self._copy:
            view = np.array(view)
        view.flags.writeable = False
        return view


def _put_together(kind: type, values: dict[str, Any]) -> Any:
    if issubclass(kind, BaseModel):
        return kind(**values)
    assert is_dataclass(kind)
    if values.keys() != {field.name for field in fields(kind)}:
        raise DataError("value", f"is no {kind.__name__}")
    made = object.__new__(kind)
    for name, value in values.items():
        object.__setattr__(made, name, value)
    return made


def _fields(value: Any) -> list[tuple[str, Any]]:
    if isinstance(value, BaseModel):
        return list(value)
    assert is_dataclass(value)
    return [(field.name, getattr(value, field.name)) for field in fields(value)]


def _aligned(size: int) -> int:
    return -(-size // _ALIGNMENT) * _ALIGNMENT
