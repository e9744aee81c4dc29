"""Serialization of the state of the mapper to plain arrays, bit for bit.

Objects and array memory with several references stay shared, because a resumed mapper run must give
bit-identical results. Unsupported objects, such as locks and open files, raise an error that names
the attribute. Reading a checkpoint executes no stored code and only creates objects of data classes
of ``mpsfm_core``.
"""

from __future__ import annotations

import hashlib
import importlib
import json
from collections import Counter, OrderedDict, defaultdict
from collections.abc import Iterator, Mapping, Sized
from enum import Enum
from typing import Any, TypeAlias, TypeVar, cast

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel

from mpsfm_core.data.errors import DataError

CheckpointArrays: TypeAlias = Mapping[str, NDArray[Any]]
"""Arrays of a checkpoint by name, where the array ``tree`` contains the object graph as JSON."""

T = TypeVar("T")

FORMAT = 1
"""Format version of checkpoints, which increases when the meaning of stored states changes."""

_TREE = "tree"
_PACKAGES = ("mapping", "optimize", "data", "geometry")
_PLAIN = (bool, int, float, str)
_FACTORIES = {"int": int, "float": float, "list": list, "set": set, "dict": dict}
_MAPS: dict[str, type[dict[Any, Any]]] = {
    cls.__name__: cls for cls in (dict, Counter, OrderedDict, defaultdict)
}
_GENERATORS = ("PCG64", "PCG64DXSM", "MT19937", "Philox", "SFC64")


def serialize(state: object, shared: object = None) -> CheckpointArrays:
    """Serialize an object graph.

    Args:
        state: The object.
        shared: Objects such as the mapping problem that the reader also has, stored by reference.

    Raises:
        TypeError: An object is not supported; the message names its attribute.
    """
    writer = _Writer(shared)
    tree = writer.node(state, "state")
    text = json.dumps({"format": FORMAT, "state": tree}, separators=(",", ":"))
    return {_TREE: np.frombuffer(text.encode(), dtype=np.uint8), **writer.arrays}


def deserialize(frozen: CheckpointArrays, shared: object = None) -> Any:
    """Restore an object graph from :func:`serialize`.

    Args:
        frozen: Arrays of the checkpoint.
        shared: Objects equal to the shared objects that were passed to :func:`serialize`.

    Raises:
        DataError: The arrays of the checkpoint are damaged or have another format.
    """
    try:
        stored = json.loads(frozen[_TREE].tobytes())
        if stored["format"] != FORMAT:
            raise ValueError(f"the checkpoint has format {stored['format']} instead of {FORMAT}")
        return _Reader(frozen, shared)(stored["state"])
    except DataError:
        raise
    except Exception as error:  # a damaged checkpoint may raise any error
        raise DataError(
            "state", f"the checkpoint is damaged: {type(error).__name__}: {error}"
        ) from error


class _Writer:
    """Writer that numbers the objects of a graph and stores repeated objects by reference."""

    def __init__(self, shared: object) -> None:
        self.arrays: dict[str, NDArray[Any]] = {}
        self._shared: dict[int, int] = {}
        for number, found in enumerate(_parts(shared)):
            self._shared.setdefault(id(found), number)
        self._met: dict[int, int] = {}
        self._alive: list[object] = [shared]  # only live Python objects have unique ids

    def node(self, value: Any, place: str) -> Any:
        """Return the JSON node that represents a Python value."""
        if value is None or type(value) in _PLAIN:
            return value
        # plain values come first, because Python may share equal plain values
        if id(value) in self._shared:
            return {"shared": self._shared[id(value)]}
        if id(value) in self._met:
            return {"met": self._met[id(value)]}
        number = self._met[id(value)] = len(self._met)
        self._alive.append(value)
        return {"id": number, **self._described(value, place)}

    def _described(self, value: Any, place: str) -> dict[str, Any]:
        cls = type(value)
        if cls is np.ndarray:
            return self._array(value, place)
        if isinstance(value, np.generic):
            return {"scalar": self._store(np.array(value))}
        if cls is bytes:
            return {"bytes": self._store(np.frombuffer(value, dtype=np.uint8))}
        if cls in (list, tuple, set):
            return {cls.__name__: self._items(value, place)}
        if cls in _MAPS.values():
            factory = getattr(value, "default_factory", None)
            if factory is not None and factory not in _FACTORIES.values():
                raise TypeError(f"{place}: default factory {factory!r} cannot be serialized")
            keys = self._items(value, f"{place} keys")
            found = [self.node(item, f"{place}[{key!r}]") for key, item in value.items()]
            name = "" if factory is None else factory.__name__
            return {"map": cls.__name__, "factory": name, "keys": keys, "values": found}
        if cls is np.random.Generator:
            generator = value.bit_generator
            name = type(generator).__name__
            return {"random": name, "state": self.node(generator.state, f"{place}.state")}
        if isinstance(value, type) and _is_ours(value):
            return {"class": _path(value)}
        if not _is_ours(cls):
            raise TypeError(f"{place}: a {cls.__module__}.{cls.__qualname__} cannot be serialized")
        if isinstance(value, Enum):
            return {"member": _path(cls), "name": value.name}
        if isinstance(value, tuple):  # of names
            return {"names": _path(cls), "items": self._items(value, place)}
        attributes = {name: self.node(item, f"{place}.{name}") for name, item in _attributes(value)}
        return {"object": _path(cls), "attributes": attributes}

    def _items(self, values: Any, place: str) -> list[Any]:
        return [self.node(item, f"{place}[{index}]") for index, item in enumerate(values)]

    def _array(self, array: NDArray[Any], place: str) -> dict[str, Any]:
        if array.dtype.hasobject:
            raise TypeError(f"{place}: an array of objects cannot be serialized")
        if isinstance(array.base, np.ndarray) and array.size:
            owner = array.base
            while isinstance(owner.base, np.ndarray):
                owner = owner.base
            if type(owner) is np.ndarray and _memory(owner) is not None:
                return {
                    "view": self.node(owner, place),
                    "offset": _address(array) - _address(owner),
                    "dtype": array.dtype.str,
                    "shape": array.shape,
                    "strides": array.strides,
                    "writeable": array.flags.writeable,
                }
        dense = array if array.base is None else array.copy(order="K")
        axes = _order(dense)
        name = self._store(np.ascontiguousarray(dense.transpose(axes)).reshape(-1))
        return {
            "array": name,
            "shape": [dense.shape[axis] for axis in axes],
            "axes": np.argsort(axes).tolist(),
            "writeable": array.flags.writeable,
        }

    def _store(self, array: NDArray[Any]) -> str:
        name = f"a{len(self.arrays)}"
        self.arrays[name] = array
        return name


class _Reader:
    """Reader of the JSON nodes that a checkpoint contains."""

    def __init__(self, frozen: CheckpointArrays, shared: object) -> None:
        self._arrays = frozen
        self._shared = list(_parts(shared))
        self._met: dict[int, Any] = {}
        self._read_only: list[NDArray[Any]] = []

    def __call__(self, tree: Any) -> Any:
        """Return the root object of the restored object graph."""
        made = self.value(tree)
        # set the flag last, because views of a read-only array may be writable
        for array in self._read_only:
            array.flags.writeable = False
        return made

    def value(self, node: Any) -> Any:
        """Return the Python object that a JSON node represents."""
        if not isinstance(node, dict):
            return node
        if "shared" in node:
            return self._shared[node["shared"]]
        if "met" in node:
            return self._met[node["met"]]
        return self._made(node, node["id"])

    def _made(self, node: dict[str, Any], number: int) -> Any:
        # containers are registered before they are filled, because they may contain themselves
        for kind in ("list", "set", "map", "object"):
            if kind in node:
                filled: Any = getattr(self, f"_{kind}")(node, number)
                return filled
        if "tuple" in node:
            made: Any = tuple(map(self.value, node["tuple"]))
        elif "names" in node:
            made = _class(node["names"])._make(map(self.value, node["items"]))  # type: ignore[attr-defined]
        elif "scalar" in node:
            made = self._arrays[node["scalar"]][()]
        elif "bytes" in node:
            made = self._arrays[node["bytes"]].tobytes()
        elif "class" in node:
            made = _class(node["class"])
        elif "member" in node:
            made = _class(node["member"])[node["name"]]  # type: ignore[index]
        elif "random" in node:
            if node["random"] not in _GENERATORS:
                raise ValueError(f"unknown generator {node['random']!r}")
            made = np.random.Generator(getattr(np.random, node["random"])())
            made.bit_generator.state = self.value(node["state"])
        else:
            made = self._array(node)
        self._met[number] = made
        return made

    def _list(self, node: dict[str, Any], number: int) -> list[Any]:
        made: list[Any] = []
        self._met[number] = made
        made.extend(map(self.value, node["list"]))
        return made

    def _set(self, node: dict[str, Any], number: int) -> set[Any]:
        made: set[Any] = set()
        self._met[number] = made
        made.update(map(self.value, node["set"]))
        return made

    def _map(self, node: dict[str, Any], number: int) -> dict[Any, Any]:
        made: dict[Any, Any] = _MAPS[node["map"]]()
        if node["factory"]:
            made = defaultdict(_FACTORIES[node["factory"]])
        self._met[number] = made
        for key, item in zip(node["keys"], node["values"], strict=True):
            made[self.value(key)] = self.value(item)
        return made

    def _object(self, node: dict[str, Any], number: int) -> Any:
        cls = _class(node["object"])
        if issubclass(cls, BaseModel):
            values = {name: self.value(item) for name, item in node["attributes"].items()}
            made: Any = cls.model_construct(**values)
            self._met[number] = made
            return made
        made = self._met[number] = object.__new__(cls)
        for name, item in node["attributes"].items():
            object.__setattr__(made, name, self.value(item))
        return made

    def _array(self, node: dict[str, Any]) -> NDArray[Any]:
        if "view" in node:
            owner = self.value(node["view"])
            # unlike as_strided, the constructor of ndarray checks the bounds of the view
            made: NDArray[Any] = np.ndarray(
                tuple(node["shape"]),
                node["dtype"],
                _memory(owner),
                node["offset"],
                tuple(node["strides"]),
            )
        else:
            flat = self._arrays[node["array"]]
            made = np.array(flat.reshape(node["shape"]).transpose(node["axes"]), order="K")
        if not node["writeable"]:
            self._read_only.append(made)
        return made


def fingerprint(value: object) -> str:
    """Compute the SHA-256 of a tree of data classes, options, sequences and arrays.

    The memory layout and the sharing of arrays do not change the hash.
    """
    found = hashlib.sha256()
    for part in _parts(value):
        if isinstance(part, np.ndarray):
            found.update(f"{part.dtype.str}{part.shape}".encode())
            found.update(np.ascontiguousarray(part).reshape(-1).view(np.uint8).data)
        else:
            plain = part is None or isinstance(part, (*_PLAIN, Enum))
            size = len(part) if isinstance(part, Sized) else ""
            found.update(f"{_path(type(part))}{part if plain else size};".encode())
    return found.hexdigest()


def canonicalize(value: T) -> T:
    """Return a tree of data with every array in C order and in its own memory.

    Sums and products of arrays depend on the memory layout in the last bit. Data from the cache may
    differ in layout from data that was just computed. A view of a whole array is replaced by that
    array without a copy, so callers must not modify the result.
    """
    made: Any = value
    if isinstance(value, np.ndarray):
        if _is_whole(value):
            made = value.base
        elif value.base is not None or not value.flags.c_contiguous:
            made = np.array(value, order="C")
    elif isinstance(value, tuple):
        items = [canonicalize(item) for item in value]
        if any(new is not old for new, old in zip(items, value, strict=True)):
            made = type(value)._make(items) if hasattr(value, "_make") else tuple(items)
    elif _is_ours(type(value)) and not isinstance(value, (BaseModel, Enum)):
        attributes = {name: canonicalize(item) for name, item in _attributes(value)}
        if any(item is not getattr(value, name) for name, item in attributes.items()):
            made = object.__new__(type(value))
            for name, item in attributes.items():
                object.__setattr__(made, name, item)
    return cast(T, made)


def _is_whole(array: NDArray[Any]) -> bool:
    """Return whether an array contains all elements of its base array in C order."""
    owner = array.base
    return (
        type(owner) is np.ndarray
        and owner.base is None
        and owner.flags.c_contiguous
        and (owner.dtype, owner.shape, owner.strides) == (array.dtype, array.shape, array.strides)
        and _address(owner) == _address(array)
    )


def _parts(value: object) -> Iterator[object]:
    """Yield all objects of a tree in a fixed order, shared objects once per occurrence."""
    yield value
    if isinstance(value, (tuple, list)):
        for item in value:
            yield from _parts(item)
    elif isinstance(value, Mapping):
        for key, item in value.items():
            yield key
            yield from _parts(item)
    elif _is_ours(type(value)) and not isinstance(value, Enum):
        for _, item in _attributes(value):
            yield from _parts(item)


def _attributes(value: Any) -> Iterator[tuple[str, Any]]:
    """Yield the names and values of the slots and attributes of an object."""
    for cls in type(value).__mro__:
        for name in getattr(cls, "__slots__", ()):
            if hasattr(value, name) and not name.startswith("__"):
                yield name, getattr(value, name)
    yield from getattr(value, "__dict__", {}).items()


def _is_ours(cls: type) -> bool:
    """Return whether a class belongs to the packages whose objects may be serialized."""
    package, _, rest = cls.__module__.partition(".")
    return package == __name__.partition(".")[0] and rest.partition(".")[0] in _PACKAGES


def _path(cls: type) -> str:
    return f"{cls.__module__}:{cls.__qualname__}"


def _class(path: str) -> type:
    module, _, name = path.partition(":")
    package, _, rest = module.partition(".")
    if package != __name__.partition(".")[0] or rest.partition(".")[0] not in _PACKAGES:
        raise ValueError(f"{path!r} is no class that a checkpoint may contain")
    found = getattr(importlib.import_module(module), name)
    if not (isinstance(found, type) and _is_ours(found)):
        raise ValueError(f"{path!r} is no class that a checkpoint may contain")
    return found


def _order(array: NDArray[Any]) -> list[int]:
    """Return the axes of an array in their order in memory."""
    long = [axis for axis in range(array.ndim) if array.shape[axis] > 1 and array.size]
    rest = [axis for axis in range(array.ndim) if axis not in long]
    return sorted(long, key=lambda axis: -array.strides[axis]) + rest


def _memory(array: NDArray[Any]) -> NDArray[Any] | None:
    """Return the bytes of an array as a view, or None if the memory is not contiguous."""
    ordered = array.transpose(_order(array))
    return ordered.reshape(-1).view(np.uint8) if ordered.flags.c_contiguous else None


def _address(array: NDArray[Any]) -> int:
    return int(array.__array_interface__["data"][0])
