"""Robust losses in the convention of Ceres, ``(rho(s), rho'(s))`` of squared residuals s.

A loss function maps the squared residual ``s`` and the loss scale ``a`` to ``(rho(s), rho'(s))``.
The loss scale has the unit of the residual. The minimized cost is ``sum(rho(s)) / 2``, and ``rho'``
is the weight in iteratively re-weighted least squares (IRLS). All loss functions accept numpy
arrays and, in compiled kernels, scalars. :func:`evaluate_loss` selects a function by its
:class:`Loss`.
"""
# mypy: allow-untyped-decorators

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any

import numpy as np
from numba.extending import register_jitable
from numpy.typing import NDArray

from mpsfm_core.optimize.options import Loss
from mpsfm_core.support import jit


@register_jitable
def trivial(s: NDArray[Any], scale: float) -> tuple[Any, Any]:
    """Evaluate the quadratic loss ``rho = s``, which has no scale."""
    return s, 0.0 * s + 1.0


@register_jitable
def soft_l1(s: NDArray[Any], scale: float) -> tuple[Any, Any]:
    """Evaluate the soft-L1 loss ``rho = 2 a^2 (sqrt(1 + s / a^2) - 1)``."""
    root = np.sqrt(1.0 + s / (scale * scale))
    return 2.0 * s / (root + 1.0), 1.0 / root


@register_jitable
def cauchy(s: NDArray[Any], scale: float) -> tuple[Any, Any]:
    """Evaluate the Cauchy loss ``rho = a^2 log(1 + s / a^2)``."""
    ratio = s / (scale * scale)
    return scale * scale * np.log1p(ratio), 1.0 / (1.0 + ratio)


@register_jitable
def truncated(s: NDArray[Any], scale: float) -> tuple[Any, Any]:
    """Evaluate the truncated quadratic loss ``rho = min(s, a^2)``."""
    return np.minimum(s, scale * scale), (s < scale * scale) * 1.0


LOSSES: Mapping[Loss, Callable[[NDArray[Any], float], tuple[Any, Any]]] = MappingProxyType(
    {
        Loss.TRIVIAL: trivial,
        Loss.SOFT_L1: soft_l1,
        Loss.CAUCHY: cauchy,
        Loss.TRUNCATED: truncated,
    }
)
"""Loss functions for numpy arrays, by member of the enumeration :class:`Loss`. Kernels use
:func:`evaluate_loss`."""


@jit.helper()
def evaluate_loss(loss: int, s: float, scale: float) -> Any:
    """Evaluate ``(rho, rho')`` of a squared residual for the integer value of a :class:`Loss`."""
    if loss == 1:
        return soft_l1(s, scale)
    if loss == 2:
        return cauchy(s, scale)
    if loss == 3:
        return truncated(s, scale)
    return trivial(s, scale)
