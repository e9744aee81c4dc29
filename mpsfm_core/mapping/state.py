"""State of the mapper as nested dictionaries of arrays, like ``state_dict`` in PyTorch.

Each class of the mapper that changes during a run returns its state from ``state_dict``, and takes
the state back in ``load_state_dict``. The state omits everything that the mapping problem and the
options determine, such as correspondences and depth priors.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any, Protocol, TypeAlias

import numpy as np
from numpy.typing import NDArray

from mpsfm_core.data.decisions import ImageReason, Reason, reason_from_json
from mpsfm_core.data.errors import DataError

StateDict: TypeAlias = dict[str, Any]
"""State of an object, as arrays, numbers, strings and None by name, or nested lists and
dictionaries."""
CheckpointArrays: TypeAlias = Mapping[str, NDArray[Any]]
"""Flattened state with its arrays by path, such as ``mapper/component/scene/rotations``, and an
array ``state`` with all other values as JSON."""

_TREE = "state"
_PLAIN = (bool, int, float, str, type(None))


class Stateful(Protocol):
    """Object whose state a checkpoint contains."""

    def state_dict(self) -> StateDict:
        """Return the state of the object."""

    def load_state_dict(self, state: StateDict) -> None:
        """Restore the state of the object, which may keep and modify the arrays of ``state``."""


def flatten_state(state: StateDict) -> CheckpointArrays:
    """Convert a state to arrays that an NPZ file can store.

    Raises:
        TypeError: The state contains a value that JSON and NPZ do not support; the message has the
            path of the value.
    """
    arrays: dict[str, NDArray[Any]] = {}
    tree = _separate(state, "", arrays)
    text = json.dumps({"arrays": list(arrays), "state": tree}, separators=(",", ":"))
    return {_TREE: np.frombuffer(text.encode(), dtype=np.uint8), **arrays}


def unflatten_state(arrays: CheckpointArrays) -> StateDict:
    """Restore a state from the arrays of :func:`flatten_state`.

    Raises:
        DataError: An array of the flattened state is missing or damaged.
    """
    try:
        stored = json.loads(arrays[_TREE].tobytes())
        missing = stored["arrays"] - arrays.keys()
        if missing:
            raise ValueError(f"the array {min(missing)} is missing in the checkpoint")
        return dict(_join(stored["state"], "", {name: arrays[name] for name in stored["arrays"]}))
    except (AttributeError, KeyError, RecursionError, TypeError, ValueError) as error:
        raise DataError(
            "state", f"the checkpoint is damaged: {type(error).__name__}: {error}"
        ) from error


def _separate(value: Any, path: str, arrays: dict[str, NDArray[Any]]) -> Any:
    """Move the arrays of a nested state to ``arrays``, and replace each array by None."""
    if isinstance(value, np.ndarray):
        arrays[path] = value
        return None
    if isinstance(value, dict):
        return {name: _separate(item, _child(path, name), arrays) for name, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_separate(item, _child(path, row), arrays) for row, item in enumerate(value)]
    if not isinstance(value, _PLAIN):
        raise TypeError(f"{path}: {type(value).__name__} cannot be stored in a checkpoint")
    return value


def _join(value: Any, path: str, arrays: CheckpointArrays) -> Any:
    """Put the arrays of a nested state back in place of None."""
    if path in arrays:
        # Preserve C or Fortran order, because the order of elements affects the rounding of sums.
        return arrays[path].copy(order="K")
    if isinstance(value, dict):
        return {name: _join(item, _child(path, name), arrays) for name, item in value.items()}
    if isinstance(value, list):
        return [_join(item, _child(path, row), arrays) for row, item in enumerate(value)]
    return value


def _child(path: str, name: object) -> str:
    return f"{path}/{name}" if path else str(name)


def reasons_to_json(reasons: Mapping[str, Reason]) -> StateDict:
    """Convert rejection reasons to JSON values, by the name of the rejected image or image pair."""
    return {name: reason.to_json() for name, reason in reasons.items()}


def reasons_from_json(stored: StateDict) -> dict[str, Reason]:
    """Restore rejection reasons from :func:`reasons_to_json`."""
    return {name: reason_from_json(ImageReason, reason) for name, reason in stored.items()}
