"""Registration of the executor ``ray``, without importing Ray."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from mpsfm_core import hookimpl
from mpsfm_core.providers import Executor


@hookimpl
def mpsfm_executor(name: str, options: Mapping[str, Any]) -> Executor | None:
    """Return an executor that is connected to its Ray workers."""
    if name != "ray":
        return None
    from mpsfm_ray.executor import RayExecutor

    return RayExecutor(options)
