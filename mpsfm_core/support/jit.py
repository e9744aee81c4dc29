"""How inner loops are compiled: kernels that Python calls, and helpers that only kernels call.

Kernels are kept on disk: in ``$NUMBA_CACHE_DIR``, else beside the module, else, where the package
cannot be written, in the user's cache. Helpers are part of the kernels that call them. A counter
that is handed to a helper starts as ``np.int64(0)``: a literal 0 is a type of its own to numba,
which would compile the helper for it too.
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
    """Decorator for a function that Python calls; ``options``: of :func:`numba.njit`.

    The interpreter is released, and floats divide as numpy's do.
    """

    def decorate(function: F) -> F:
        try:
            return _compiled(function, cache=True, **options)
        except RuntimeError as error:  # no folder that could be written
            _warn(str(error))
            return _compiled(function, **options)

    return decorate


def helper(**options: Any) -> Callable[[F], F]:
    """Decorator for a function that kernels call; to Python it stays what it is."""
    without = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}
    decorate: Callable[[F], F] = register_jitable(**_ALWAYS, **without, **options)
    return decorate


def _compiled(function: F, **options: Any) -> F:
    compiled: F = njit(**_ALWAYS, **options)(function)
    return compiled


@cache
def _warn(reason: str) -> None:
    text = "compiled code cannot be kept (%s): set NUMBA_CACHE_DIR to a folder that can be written"
    _log.warning(text, reason.split(":")[0])
