"""Registration of the executor ``dask``, without importing Dask."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from mpsfm_core import hookimpl
from mpsfm_core.providers import Executor


@hookimpl
def mpsfm_executor(name: str, options: Mapping[str, Any]) -> Executor | None:
    """Return an executor that is connected to its Dask workers."""
    if name != "dask":
        return None
    from mpsfm_dask.executor import DaskExecutor

    return DaskExecutor(options)
