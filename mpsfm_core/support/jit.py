"""Numba decorators for inner loops: kernels for Python callers, helpers for kernels.

Compiled kernels are cached in ``$NUMBA_CACHE_DIR``, next to the module, or in the user's cache if
the package is not writable. Helpers are compiled into their kernels. Pass counters to helpers as
``np.int64(0)``: a literal 0 has its own numba type, which would compile the helper twice.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from functools import cache
from typing import Any, TypeVar

from numba import njit
from numba.extending import register_jitable

_log = logging.getLogger(__name__)

F = TypeVar("F", bound=Callable[..., Any])
_ALWAYS: dict[str, Any] = {"nogil": True, "error_model": "numpy"}


def kernel(**options: Any) -> Callable[[F], F]:
    """Return a decorator that compiles a function for Python callers.

    The compiled function releases the interpreter lock and divides floats like numpy.

    Args:
        options: Keyword arguments of :func:`numba.njit`.
    """

    def decorate(function: F) -> F:
        try:
            return _compiled(function, cache=True, **options)
        except RuntimeError as error:  # no writable cache folder
            _warn(str(error))
            return _compiled(function, **options)

    return decorate


def helper(**options: Any) -> Callable[[F], F]:
    """Return a decorator that makes a Python function callable from kernels."""
    without = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}
    decorate: Callable[[F], F] = register_jitable(**_ALWAYS, **without, **options)
    return decorate


def _compiled(function: F, **options: Any) -> F:
    compiled: F = njit(**_ALWAYS, **options)(function)
    return compiled


@cache
def _warn(reason: str) -> None:
    text = "cannot cache compiled code (%s): set NUMBA_CACHE_DIR to a writable folder"
    _log.warning(text, reason.split(":")[0])
