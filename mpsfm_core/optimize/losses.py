"""Robust losses in the convention of Ceres, ``(rho(s), rho'(s))`` of squared residuals s.

A loss maps the squared residual ``s`` and the loss scale ``a``, in the unit of the residual, to
``(rho(s), rho'(s))``. An objective is ``sum(rho(s)) / 2``, and ``rho'`` is the weight in
iteratively re-weighted least squares (IRLS). The functions accept numpy arrays and, in kernels,
scalars. :func:`evaluate_loss` selects a function by its :class:`Loss`.
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
    """Evaluate ``rho = s``, the quadratic loss, on which the scale has no effect."""
    return s, 0.0 * s + 1.0


@register_jitable
def soft_l1(s: NDArray[Any], scale: float) -> tuple[Any, Any]:
    """Evaluate ``rho = 2 a^2 (sqrt(1 + s / a^2) - 1)``, linear in large residuals."""
    root = np.sqrt(1.0 + s / (scale * scale))
    return 2.0 * s / (root + 1.0), 1.0 / root


@register_jitable
def cauchy(s: NDArray[Any], scale: float) -> tuple[Any, Any]:
    """Evaluate ``rho = a^2 log(1 + s / a^2)``, where large residuals lose influence."""
    ratio = s / (scale * scale)
    return scale * scale * np.log1p(ratio), 1.0 / (1.0 + ratio)


@register_jitable
def truncated(s: NDArray[Any], scale: float) -> tuple[Any, Any]:
    """Evaluate ``rho = min(s, a^2)``, where residuals above the scale have no influence."""
    return np.minimum(s, scale * scale), (s < scale * scale) * 1.0


LOSSES: Mapping[Loss, Callable[[NDArray[Any], float], tuple[Any, Any]]] = MappingProxyType(
    {
        Loss.TRIVIAL: trivial,
        Loss.SOFT_L1: soft_l1,
        Loss.CAUCHY: cauchy,
        Loss.TRUNCATED: truncated,
    }
)
"""Loss functions by :class:`Loss`, for numpy arrays. Kernels use :func:`evaluate_loss`."""


@jit.helper()
def evaluate_loss(loss: int, s: float, scale: float) -> Any:
    """Evaluate ``(rho, rho')`` of a squared residual for a :class:`Loss` given as int."""
    if loss == 1:
        return soft_l1(s, scale)
    if loss == 2:
        return cauchy(s, scale)
    if loss == 3:
        return truncated(s, scale)
    return trivial(s, scale)
