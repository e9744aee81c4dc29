"""Array types, and checks of shape, dtype and range for data classes."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from mpsfm_core.data.errors import DataError

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
Int64 = NDArray[np.int64]
UInt8 = NDArray[np.uint8]
Bool = NDArray[np.bool_]
Pose = tuple[Float64, Float64]
"""Rigid transform ``y = R x + t``: rotation (3, 3) and translation (3,) float64, for example
``cam_from_world`` of an image."""


def require_array(owner: object, name: str, dtype: Any, shape: tuple[int | None, ...]) -> None:
    """Check dtype and shape of an array attribute, and make the attribute read-only.

    The attribute becomes a read-only view of the array. An array that is not in C order is copied,
    because rounding errors of sums depend on the memory layout.

    Args:
        owner: Data class instance.
        name: Name of the array attribute.
        dtype: Required dtype.
        shape: Required shape, where None accepts any size along its axis.

    Raises:
        DataError: The attribute is not a numpy array, or its dtype or shape is wrong.
    """
    value = getattr(owner, name)
    if not isinstance(value, np.ndarray):
        raise DataError(name, f"value must be a numpy array, got {type(value).__name__}")
    if value.dtype != np.dtype(dtype):
        raise DataError(name, f"array must have dtype {np.dtype(dtype)}, got {value.dtype}")
    matches = value.ndim == len(shape) and all(
        required is None or required == size
        for required, size in zip(shape, value.shape, strict=False)
    )
    if not matches:
        required_shape = "(" + ", ".join("any" if s is None else str(s) for s in shape) + ")"
        raise DataError(name, f"array must have shape {required_shape}, got {value.shape}")
    view = np.ascontiguousarray(value).view()
    view.flags.writeable = False
    object.__setattr__(owner, name, view)


def require_finite(owner: object, name: str) -> None:
    """Raise :class:`DataError` if an array attribute has NaN or infinite values."""
    if not np.isfinite(getattr(owner, name)).all():
        raise DataError(name, "must be finite")


def require_positive_where_valid(values: Float32, valid: Bool, name: str) -> None:
    """Raise :class:`DataError` if a value is not positive where the mask is True."""
    if ((values <= 0) & valid).any():
        raise DataError(name, "values must be positive at valid pixels")


def require_unit_interval(values: Float32, name: str) -> None:
    """Raise :class:`DataError` if a value is outside [0, 1]."""
    if values.size and not (values.min() >= 0 and values.max() <= 1):
        raise DataError(name, "values must lie in [0, 1]")
