"""Executor that runs extraction steps on the workers of a Dask cluster."""

from __future__ import annotations

import uuid
from collections.abc import Callable, Generator, Mapping, Sequence
from typing import Any

from dask.distributed import Client, LocalCluster, WorkerPlugin, as_completed, get_worker
from pydantic import Field

from mpsfm_core.data.errors import ConfigError
from mpsfm_core.data.options import Options, SettingsError, parse_settings

MAX_TASKS = 50_000
"""Maximum number of Dask tasks per extraction step. If an extraction step has more images or pairs,
several of them share a Dask task, because the scheduler keeps all tasks in memory. [ours]
"""


class DaskOptions(Options):
    """Address and number of the Dask workers."""

    address: str | None = None
    """Address of the Dask scheduler, ``tcp://HOST:8786``. null starts workers on this machine."""
    workers: int | None = Field(None, ge=1)
    """Number of worker processes on this machine. null starts one per core."""
    timeout_s: float = Field(30.0, gt=0)
    """Maximum time in seconds to wait for the scheduler and a first worker."""


class DaskExecutor:
    """Executor that sends an extraction step, then its images or pairs, to the Dask workers."""

    def __init__(self, options: Mapping[str, Any]) -> None:
        """Connect to the Dask scheduler, or start workers on this machine.

        Raises:
            ConfigError: The options are invalid, or the scheduler does not answer.
        """
        try:
            checked = parse_settings(DaskOptions, options, ("runtime", "executor_options"))
        except SettingsError as error:
            raise ConfigError(str(error)) from error
        self._cluster = None
        try:
            if checked.address is None:
                self._cluster = LocalCluster(
                    n_workers=checked.workers, threads_per_worker=1, dashboard_address=None
                )
            self._client = Client(self._cluster or checked.address, timeout=checked.timeout_s)
            self._client.wait_for_workers(1, timeout=checked.timeout_s)
        except (OSError, TimeoutError, ValueError) as error:
            where = checked.address or "this machine"
            raise ConfigError(f"no Dask workers at {where}: {error}") from error

    def run(self, step: Callable[[Any], None], items: Sequence[Any]) -> Generator[None, None, None]:
        """Run an extraction step on all images or pairs, see ``mpsfm_core.providers.Executor``."""
        name, size = f"mpsfm-{uuid.uuid4().hex}", 1 + len(items) // MAX_TASKS
        parts = [list(items[n : n + size]) for n in range(0, len(items), size)]
        self._client.register_plugin(_StepOnWorker(step), name=name)
        futures = [self._client.submit(_work, name, part, pure=False) for part in parts]
        sizes = {future.key: len(part) for future, part in zip(futures, parts, strict=True)}
        try:
            for future in as_completed(futures):
                future.result()
                for _ in range(sizes[future.key]):
                    yield
        finally:
            self._client.cancel(futures)
            self._client.unregister_worker_plugin(name)

    def close(self) -> None:
        """Close the connection to the cluster, and stop workers that this executor started."""
        self._client.close()
        if self._cluster is not None:
            self._cluster.close()


class _StepOnWorker(WorkerPlugin):  # type: ignore[misc, unused-ignore]
    """Dask plugin that sends an extraction step to every worker, including later workers."""

    def __init__(self, step: Callable[[Any], None]) -> None:
        self.step = step


def _work(name: str, items: list[Any]) -> None:
    step = get_worker().plugins[name].step
    for item in items:
        step(item)
