"""What is compared: our mapper and its peers, each run in a process of its own.

A mapper that crashes takes its process with it, not the benchmark.
"""

from __future__ import annotations

import multiprocessing
import threading
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, ThreadPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from typing import Any

import pycolmap

from mpsfm_core.data import MappingProblem, PinholeCamera, Pose
from mpsfm_core.evaluation.chained_pnp import estimate_chained_poses
from mpsfm_core.evaluation.dense_geometry import DenseEvaluation
from mpsfm_core.evaluation.peers import PEERS, run_peer
from mpsfm_core.mapping import mapper
from mpsfm_core.mapping.options import MapperOptions
from mpsfm_core.mapping.scene.reconstruction import Reconstruction
from mpsfm_core.pipeline.stages import peak_memory_mb
from mpsfm_core.support.threads import limit_threads
from mpsfm_core.testing.synthetic.problems import make_mapping_problem
from mpsfm_core.testing.synthetic.scenes import arc_poses, room_scene

OURS = "ours"
CHAINED_PNP = "chained-pnp"
"""A reference point without a mapper (:mod:`~mpsfm_core.evaluation.chained_pnp`)."""
PRIOR_METHODS = (OURS, CHAINED_PNP)
"""Methods that run once with each prior."""
PEER_METHODS = (CHAINED_PNP, *PEERS)
"""All that ours is compared with."""


@dataclass(frozen=True, eq=False)
class MethodResult:
    """What a method made of a set.

    ``models``: poses by image name, of the largest model first. ``seconds``: wall clock;
    ``cpu_seconds``: of the process, which other jobs on the machine do not stretch.
    ``peak_mib``: most memory that the process held, its problem and earlier tasks included; 0
    where the system does not tell. ``error``: why it failed, empty if it did not. ``dense``: what
    :meth:`DenseEvaluation.measure` says of the largest model; its time is not in the seconds.
    """

    models: Sequence[dict[str, Pose]] = ()
    seconds: float = 0.0
    cpu_seconds: float = 0.0
    peak_mib: float = 0.0
    error: str = ""
    dense: dict[str, Any] | None = None


@dataclass(frozen=True, eq=False)
class MethodRun:
    """One run: ``method`` is :data:`OURS`, :data:`CHAINED_PNP` or the name of a peer. ``dense``: how the
    depth of ours is measured and compared, None where it is not. ``threads``: at most, one unless
    wall time with more is what is compared; results of a peer may depend on them."""

    label: str
    method: str
    problem: MappingProblem
    options: MapperOptions
    dense: DenseEvaluation | None = None
    threads: int = 1


def run_methods(
    tasks: Sequence[MethodRun], workers: int
) -> Iterator[tuple[MethodRun, MethodResult]]:
    """Run tasks in ``workers`` processes; yields them as they are done."""
    lanes = _WorkerProcesses()
    pool = ThreadPoolExecutor(max(1, workers), thread_name_prefix="mpsfm-benchmark")
    try:
        futures: dict[Future[MethodResult], MethodRun] = {
            pool.submit(lanes.run, t): t for t in tasks
        }
        for future in as_completed(futures):
            yield futures[future], future.result()
    finally:
        pool.shutdown(wait=True, cancel_futures=True)
        lanes.close()


def run_method(task: MethodRun) -> MethodResult:
    """Run a task here and now; what it raises becomes the outcome's error."""
    started, cpu_started = time.perf_counter(), time.process_time()
    models: list[dict[str, Pose]] = []
    found: Sequence[Reconstruction] = ()
    dense, error = None, ""
    try:
        with limit_threads(task.threads):
            if task.method == CHAINED_PNP:
                models = estimate_chained_poses(task.problem, task.options.seed)
            elif task.method != OURS:
                models = run_peer(task.method, task.problem)
            else:
                found = mapper.reconstruct(task.problem, task.options).reconstructions
                models = [model.poses for model in found]
    except Exception as raised:  # whatever a mapper raises is its result
        error = f"{type(raised).__name__}: {raised}"
    seconds, cpu_seconds = time.perf_counter() - started, time.process_time() - cpu_started
    if task.dense is not None and found:
        try:
            with limit_threads(task.threads):
                dense = task.dense.measure(found[0], task.problem)
        except Exception as raised:  # the poses stand
            error = f"dense: {type(raised).__name__}: {raised}"
    return MethodResult(models, seconds, cpu_seconds, peak_memory_mb() or 0.0, error, dense)


class _WorkerProcesses:
    """A process for each thread that asks for one, and a new one when it died."""

    def __init__(self) -> None:
        self._local = threading.local()
        self._lock = threading.Lock()
        self._processes: list[ProcessPoolExecutor] = []

    def run(self, task: MethodRun) -> MethodResult:
        """Run a task in the process of the calling thread."""
        process = getattr(self._local, "process", None) or self._start()
        try:
            return process.submit(run_method, task).result()
        except BrokenProcessPool:
            self._start()
            return MethodResult(error="its process died")

    def close(self) -> None:
        """End all processes."""
        for process in self._processes:
            process.shutdown(wait=True, cancel_futures=True)

    def _start(self) -> ProcessPoolExecutor:
        # Forked processes would inherit locks of threads that do not exist in them.
        context = multiprocessing.get_context("spawn")
        process = ProcessPoolExecutor(1, mp_context=context, initializer=_prepare)
        self._local.process = process
        with self._lock:
            self._processes.append(process)
        return process


def _prepare() -> None:
    """Silence COLMAP, whose failures are results here, and load the compiled loops, which would
    otherwise count for the first set."""
    pycolmap.logging.minloglevel = int(pycolmap.logging.FATAL)
    camera = PinholeCamera(160, 120, 130.0, 130.0, 80.0, 60.0)
    problem = make_mapping_problem(room_scene(), camera, arc_poses(3, 8.0))
    run_method(MethodRun(OURS, OURS, problem, MapperOptions()))
