"""Mapping of the parts of a reconstruction, on this machine or on remote workers.

The main process writes the mapping problem of each part to the cache folder. A worker reads the
problem, and writes its result as a checkpoint of completed mapping. The main process then maps
all parts itself, and finds the checkpoints. An interrupted run loses at most the parts in progress.
"""

from __future__ import annotations

import json
import os
import socket
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path

from mpsfm_core.config import RuntimeOptions
from mpsfm_core.data import MappingProblem
from mpsfm_core.extraction.active_provider import thread_count
from mpsfm_core.extraction.cache import cache_folder, digest
from mpsfm_core.extraction.executors import THREADS, finish_items, open_executor
from mpsfm_core.mapping import mapper
from mpsfm_core.mapping.options import MapperOptions
from mpsfm_core.mapping.problem_state import problem_from_state, problem_to_state
from mpsfm_core.mapping.scene.reconstruction import MappingResult, compute_depth_maps
from mpsfm_core.pipeline.checkpoints import MappingCheckpoints
from mpsfm_core.pipeline.stages import Stages, peak_memory_mb, reset_peak_memory
from mpsfm_core.pipeline.task_inputs import TaskInputs
from mpsfm_core.providers.registry import Registry
from mpsfm_core.support.disk_arrays import store_on_disk
from mpsfm_core.support.files import write_file
from mpsfm_core.support.memory import release_free_memory
from mpsfm_core.support.threads import limit_threads

MAX_WHOLE_IMAGES = 2000
"""Largest number of images that are mapped in one piece if ``mapping.parts`` is ``auto`` and an
executor is set. Above it, at least three workers can share the parts.
[tuned: benchmarks.scale]"""
AUTO_PART_IMAGES = 1000
"""Number of images in each part if ``mapping.parts`` is ``auto``. [tuned: benchmarks.scale]"""
_STEP = "parts"
_NEVER_S = 1e9
"""Seconds between checkpoints if only completed parts are stored."""


def choose_part_size(
    options: MapperOptions, runtime: RuntimeOptions, num_images: int
) -> MapperOptions:
    """Replace the size of parts ``auto`` by a number of images, or by None for one piece."""
    if options.parts != "auto":
        return options
    in_parts = runtime.executor != THREADS and num_images > MAX_WHOLE_IMAGES
    return options.model_copy(update={"parts": AUTO_PART_IMAGES if in_parts else None})


class PartMapper:
    """Maps the parts of one reconstruction, and stores their results until :meth:`forget`.

    Implements :data:`mpsfm_core.mapping.parts.part_mapping.MapParts`.

    Args:
        runtime: Executor, cache folder and threads.
        registry: The installed providers, among them executors.
        stages: Receiver of progress.
        fresh: If true, ignore the results of an interrupted run.
    """

    def __init__(
        self, runtime: RuntimeOptions, registry: Registry, stages: Stages, *, fresh: bool = False
    ) -> None:
        self._runtime, self._registry, self._stages = runtime, registry, stages
        self._fresh = fresh
        self._stored: list[_StoredPart] = []
        self.records: list[PartRecord] = []
        """Time and memory of each part of the last reconstruction."""

    def __call__(
        self, problems: Sequence[MappingProblem], options: MapperOptions
    ) -> list[MappingResult]:
        """Map all parts, and return their results in order."""
        runtime = self._runtime
        step = MapPart(
            cache_folder(runtime.cache_dir),
            options,
            _NEVER_S if runtime.checkpoint_s is None else runtime.checkpoint_s,
            thread_count(runtime),
        )
        parts = [_StoredPart(step, problem) for problem in problems]
        self._stored += parts
        if self._fresh:
            self.forget()
        with self._stages.step(_STEP, len(parts)):
            self._map_remotely(step, parts)
            is_remote = runtime.executor != THREADS
            stores = is_remote or runtime.checkpoint_s is not None
            results, self.records = [], []
            for done, part in enumerate(parts, start=1):
                with measure_part(part.problem) as measured:
                    result = step.map(part.problem, part.key, stores=stores)
                models = compute_depth_maps(result.reconstructions)
                results.append(replace(result, reconstructions=models))
                self.records.append(step.read_record(part.key) or measured[0])
                if not is_remote:
                    self._stages.stage_progress(_STEP, done, len(parts))
        return results

    def forget(self) -> None:
        """Delete the stored problems and results of all parts."""
        for part in self._stored:
            part.forget()

    def _map_remotely(self, step: MapPart, parts: Sequence[_StoredPart]) -> None:
        """Map the parts on the workers of the executor, if any, which store their results."""
        with open_executor(self._runtime, self._registry) as executor:
            if executor is None:
                return
            for part in parts:
                part.store()
            finish_items(
                executor.run(step, [part.key for part in parts]),
                lambda done: self._stages.stage_progress(_STEP, done, len(parts)),
            )


@dataclass(frozen=True)
class PartRecord:
    """Time and memory that one part took; ``summary.json`` lists the records of all parts."""

    images: int
    seconds: float
    cpu_seconds: float
    peak_memory_mb: float | None
    """Peak resident memory of the process, or None if the operating system reports none."""
    worker: str
    """Host and process identifier of the worker."""


@contextmanager
def measure_part(problem: MappingProblem) -> Iterator[list[PartRecord]]:
    """Measure the mapping of a part in a ``with`` block, and append the record to the list."""
    records: list[PartRecord] = []
    started, cpu_started = time.perf_counter(), time.process_time()
    yield records
    records.append(
        PartRecord(
            len(problem.images),
            time.perf_counter() - started,
            time.process_time() - cpu_started,
            peak_memory_mb(),
            f"{socket.gethostname()}:{os.getpid()}",
        )
    )


@dataclass(frozen=True)
class MapPart:
    """Pickled function that maps a part on any machine, and stores the result as a checkpoint."""

    cache: Path
    """Cache folder of the run, which all workers share."""
    options: MapperOptions
    every_s: float
    """Minimum seconds between checkpoints of a part in progress."""
    threads: int

    def __call__(self, key: str) -> None:
        """Map the part whose mapping problem is stored under a key."""
        reset_peak_memory()
        with limit_threads(self.threads), store_on_disk(self.cache):
            problem = problem_from_state(self.inputs.load(key))
            with measure_part(problem) as records:
                self.map(problem, key)
        release_free_memory()
        if not self.record_file(key).exists():  # a repeated part only loads its checkpoint
            write_file(self.record_file(key), json.dumps(asdict(records[0])))

    def read_record(self, key: str) -> PartRecord | None:
        """Return the record of a part that a worker mapped, or None without a worker."""
        with suppress(OSError, ValueError, TypeError):
            return PartRecord(**json.loads(self.record_file(key).read_text(encoding="utf-8")))
        return None

    def map(self, problem: MappingProblem, key: str, *, stores: bool = True) -> MappingResult:
        """Map a part, or load its result if the part is complete.

        Args:
            problem: Mapping problem of the part.
            key: Digest of the problem.
            stores: If true, load and write checkpoints.
        """
        checkpoints = self.checkpoints(problem, key) if stores else None
        return mapper.reconstruct(problem, self.options, None, checkpoints)

    def checkpoints(self, problem: MappingProblem, key: str) -> MappingCheckpoints:
        """Return the storage of the checkpoints of a part, which shows no messages."""
        quiet = Stages(Registry())
        return MappingCheckpoints(self.cache, problem, self.options, quiet, self.every_s, key)

    @property
    def inputs(self) -> TaskInputs:
        """Mapping problems of the parts in the cache folder."""
        return TaskInputs(self.cache, _STEP)

    def record_file(self, key: str) -> Path:
        """Return the file of time and memory of the mapping problem with a key."""
        return self.inputs.path(key).with_suffix(".json")


class _StoredPart:
    """Mapping problem of a part, with its files in the cache folder."""

    def __init__(self, step: MapPart, problem: MappingProblem) -> None:
        self.problem, self.key = problem, digest(problem)
        self._inputs, self._record_file = step.inputs, step.record_file(self.key)
        self._checkpoints = step.checkpoints(problem, self.key)

    def store(self) -> None:
        """Write the mapping problem for the workers.

        Raises:
            OutputError: the file cannot be written.
        """
        self._inputs.store(self.key, problem_to_state(self.problem))

    def forget(self) -> None:
        """Delete mapping problem, checkpoint and record."""
        self._checkpoints.forget()
        self._inputs.forget(self.key)
        self._record_file.unlink(missing_ok=True)
