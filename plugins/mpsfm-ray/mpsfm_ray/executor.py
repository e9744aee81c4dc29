"""Executor that runs extraction steps on the workers of a Ray cluster."""

from __future__ import annotations

from collections.abc import Callable, Generator, Mapping, Sequence
from typing import Any

import ray
from pydantic import Field

from mpsfm_core.data.errors import ConfigError
from mpsfm_core.data.options import Options, SettingsError, parse_settings

MAX_TASKS = 50_000
"""Maximum number of Ray tasks per extraction step. If an extraction step has more images or pairs,
several of them share a Ray task. [ours]"""


class RayOptions(Options):
    """Address and number of the Ray workers."""

    address: str | None = None
    """Address of the Ray cluster, ``auto`` or ``ray://HOST:10001``. null starts workers on this
    machine.
    """
    workers: int | None = Field(None, ge=1)
    """Number of worker processes on this machine. null starts one per core."""


class RayExecutor:
    """Executor that runs an extraction step on images or pairs as Ray tasks."""

    def __init__(self, options: Mapping[str, Any]) -> None:
        """Connect to the Ray cluster, or start workers on this machine.

        Raises:
            ConfigError: The options are invalid, or the cluster does not answer.
        """
        try:
            checked = parse_settings(RayOptions, options, ("runtime", "executor_options"))
        except SettingsError as error:
            raise ConfigError(str(error)) from error
        self._own = not ray.is_initialized()
        if not self._own:
            return
        local = {"num_cpus": checked.workers, "include_dashboard": False}
        try:
            ray.init(
                address=checked.address or "local",
                log_to_driver=False,
                **(local if checked.address is None else {}),
            )
        except (OSError, RuntimeError, ValueError) as error:
            where = checked.address or "this machine"
            raise ConfigError(f"no Ray workers at {where}: {error}") from error

    def run(self, step: Callable[[Any], None], items: Sequence[Any]) -> Generator[None, None, None]:
        """Run an extraction step on all images or pairs, see ``mpsfm_core.providers.Executor``."""
        size = 1 + len(items) // MAX_TASKS
        parts = [list(items[n : n + size]) for n in range(0, len(items), size)]
        shared = ray.put(step)
        waiting = {_work.remote(shared, part): len(part) for part in parts}
        try:
            while waiting:
                done, _ = ray.wait(list(waiting))
                for reference in done:
                    try:
                        ray.get(reference)
                    except ray.exceptions.RayTaskError as error:
                        raise error.cause from None
                    for _ in range(waiting.pop(reference)):
                        yield
        finally:
            for reference in waiting:
                ray.cancel(reference)

    def close(self) -> None:
        """Close the connection to the cluster, and stop workers that this executor started."""
        if self._own:
            ray.shutdown()


@ray.remote(max_retries=3)
def _work(step: Callable[[Any], None], items: list[Any]) -> None:
    for item in items:
        step(item)
