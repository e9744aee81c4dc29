"""Encoding of Python values as JSON text and one memory block with the bytes of all arrays.

Messages are not pickled, because pickle can execute code and both processes may have different
versions of Python and numpy. Messages may contain None, bool, int, float, str, paths, lists,
tuples, dictionaries with text keys, numpy arrays, the data types of :mod:`mpsfm_core.data`, weights
files and calibrations.
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
from mpsfm_core.providers import PROVIDER_KINDS, WeightsFile
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
            *(cls for kind in PROVIDER_KINDS.values() for cls in kind.data_types),
            WeightsFile,
            DepthCalibration,
            NormalCalibration,
        )
    }
)


class EncodedMessage:
    """Encoded Python value, which consists of JSON ``text`` and numpy ``arrays``."""

    def __init__(self, value: Any) -> None:
        self.arrays: list[NDArray[Any]] = []
        self.size = 0
        """Size in bytes of the memory block for all arrays of the message."""
        self.text = json.dumps(self._plain(value)).encode()

    def write(self, block: memoryview) -> None:
        """Copy the arrays of the message into a memory block, each at its offset."""
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
            return {"array": self._allocate(value)}
        if isinstance(value, np.generic):
            return value.item()
        if isinstance(value, (list, tuple)):
            return {type(value).__name__: [self._plain(entry) for entry in value]}
        if isinstance(value, Mapping):
            return {"dict": {str(key): self._plain(entry) for key, entry in value.items()}}
        name = type(value).__name__
        if _TYPES.get(name) is type(value):
            return {"type": name, "fields": {k: self._plain(v) for k, v in _fields(value)}}
        raise DataError("value", f"a value of type {name} cannot be sent to another process")

    def _allocate(self, array: NDArray[Any]) -> list[Any]:
        if array.dtype.hasobject:
            raise DataError("value", "an array of Python objects cannot be sent to another process")
        start, self.size = self.size, self.size + _aligned(array.nbytes)
        self.arrays.append(array)
        return [array.dtype.str, list(array.shape), start]


def decode_message(text: bytes, block: UInt8, copy: bool) -> Any:
    """Decode a Python value from a received message.

    The decoder does not validate the decoded instances of data types. The constructors in the
    sending process validated the fields of the instances, and
    :mod:`mpsfm_core.providers.validation` validates every return value of a provider.

    Args:
        text: JSON text of the received message.
        block: Bytes of the arrays in the received message.
        copy: True copies the received arrays, False returns read-only numpy views of ``block``.

    Returns:
        The decoded Python value.

    Raises:
        DataError: The message does not follow the encoding protocol.
    """
    try:
        return _Decoder(block, copy).build(json.loads(text))
    except (ValueError, KeyError, TypeError, AttributeError, MemoryError, RecursionError) as error:
        raise DataError("value", f"the received message is malformed: {error}") from error


class _Decoder:
    """Decoder of one message, whose decoded arrays keep the message's memory block alive."""

    def __init__(self, block: UInt8, copy: bool) -> None:
        self._block, self._copy = block, copy

    def build(self, plain: Any) -> Any:
        if not isinstance(plain, dict):
            return plain
        if "type" in plain:
            values = {key: self.build(entry) for key, entry in plain["fields"].items()}
            return _restore(_TYPES[plain["type"]], values)
        ((tag, content),) = plain.items()
        if tag == "array":
            return self._array(content)
        if tag == "path":
            return Path(content)
        if tag == "dict":
            return {key: self.build(entry) for key, entry in content.items()}
        if tag in ("list", "tuple"):
            entries = [self.build(entry) for entry in content]
            return tuple(entries) if tag == "tuple" else entries
        raise DataError("value", f"unknown content {tag!r}")

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


def _restore(kind: type, values: dict[str, Any]) -> Any:
    """Create an instance of a data type from field values without validating them."""
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
