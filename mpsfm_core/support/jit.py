"""Numba decorators for inner loops: kernels for Python callers, helpers for kernels.

Compiled kernels are cached in ``$NUMBA_CACHE_DIR``, else next to the module. If the package folder
is not writable, kernels are cached in ``kernels`` of the user's cache (``$MPSFM_CACHE``). Numba
helpers are compiled into the kernels that call them. Pass counters to helpers as ``np.int64(0)``: a
literal 0 has its own numba type, which would compile the helper twice.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Callable
from functools import cache
from hashlib import sha256
from pathlib import Path
from types import FunctionType
from typing import Any, TypeVar

import numba
from numba import njit
from numba.core.caching import IndexDataCacheFile
from numba.extending import register_jitable

from mpsfm_core.support.user_folders import user_cache_folder

_log = logging.getLogger(__name__)

F = TypeVar("F", bound=Callable[..., Any])
_ALWAYS: dict[str, Any] = {"nogil": True, "error_model": "numpy"}


def kernel(**options: Any) -> Callable[[F], F]:
    """Return a decorator that compiles a function for Python callers.

    The compiled function releases Python's global interpreter lock. Division by zero gives inf or
    nan, as in numpy.

    Args:
        options: Keyword arguments that are passed on to :func:`numba.njit`.
    """

    def decorate(function: F) -> F:
        _choose_cache_folder()
        _discard_unreadable_indices()
        try:
            compiled = _compiled(function, cache=True, **options)
            _add_dependencies(compiled)
            return compiled
        except RuntimeError:  # numba found no writable cache folder
            _warn_without_cache()
            return _compiled(function, **options)

    return decorate


def helper(**options: Any) -> Callable[[F], F]:
    """Return a decorator that makes a function callable from kernels and from Python."""
    without = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}
    decorate: Callable[[F], F] = register_jitable(**_ALWAYS, **without, **options)
    return decorate


def _compiled(function: F, **options: Any) -> F:
    compiled: F = njit(**_ALWAYS, no_cfunc_wrapper=True, **options)(function)
    return compiled


def _add_dependencies(compiled: Any) -> None:
    """Recompile a cached kernel if constants or functions that it uses in other modules change.

    By default, numba compiles a kernel again only if the file of the kernel itself changes.
    """
    file = compiled._cache._cache_file
    file._source_stamp = (file._source_stamp, describe_globals(compiled.py_func))


def describe_globals(function: Callable[..., Any]) -> list[str]:
    """Return the values of constants and the code of functions that a function uses.

    Functions from other modules of the package are followed recursively.
    """
    described: dict[str, str] = {}
    pending = [function]
    while pending:
        current = pending.pop()
        for name in current.__code__.co_names:
            value = current.__globals__.get(name)
            value = getattr(value, "py_func", value)
            key = f"{current.__module__}.{name}"
            if isinstance(value, FunctionType) and key not in described:
                if value.__module__.partition(".")[0] == __package__.partition(".")[0]:
                    code = value.__code__
                    content = (code.co_code, code.co_names, code.co_varnames, code.co_consts)
                    described[key] = sha256(repr(content).encode()).hexdigest()
                    pending.append(value)
            elif isinstance(value, (int, float, str, tuple)):
                described[key] = repr(value)
    return [f"{key} = {text}" for key, text in sorted(described.items())]


@cache
def _discard_unreadable_indices() -> None:
    """Make numba treat a cache index that cannot be unpickled as a cache miss.

    numba unpickles the types in a cache index before comparing the index with the source. A type
    that an upgrade renamed would raise AttributeError in the first call of a kernel.
    """
    load: Callable[[Any], Any] = IndexDataCacheFile._load_index

    def load_or_discard(self: Any) -> Any:
        try:
            return load(self)
        except (AttributeError, ImportError):
            return {}

    IndexDataCacheFile._load_index = load_or_discard


@cache
def _choose_cache_folder() -> None:
    """Cache kernels in the user's cache if the package folder is not writable."""
    if os.environ.get("NUMBA_CACHE_DIR") or os.access(Path(__file__).parent, os.W_OK):
        return
    folder = user_cache_folder() / "kernels"
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        return
    if os.access(folder, os.W_OK):
        # Worker processes inherit the environment variable.
        os.environ["NUMBA_CACHE_DIR"] = str(folder)
        numba.config.CACHE_DIR = str(folder)


@cache
def _warn_without_cache() -> None:
    _log.warning(
        "compiled kernels cannot be stored, so every run compiles them again: set MPSFM_CACHE to "
        "a writable folder"
    )
