"""Methods of the benchmark: mpsfm and other mappers, each run in a subprocess.

If a mapper crashes, only its subprocess ends and the benchmark continues.
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
from mpsfm_core.mapping.options import MapperOptions
from mpsfm_core.mapping.parts import part_mapping
from mpsfm_core.mapping.scene.reconstruction import Reconstruction
from mpsfm_core.pipeline.stages import peak_memory_mb
from mpsfm_core.support.threads import limit_threads
from mpsfm_core.testing.synthetic.problems import make_mapping_problem
from mpsfm_core.testing.synthetic.scenes import arc_poses, room_scene

OURS = "ours"
CHAINED_PNP = "chained-pnp"
"""Name of the baseline without a mapper (:mod:`~mpsfm_core.evaluation.chained_pnp`)."""
PRIOR_METHODS = (OURS, CHAINED_PNP)
"""Names of the methods that use depth priors and therefore run with each prior quality."""
PEER_METHODS = (CHAINED_PNP, *PEERS)
"""Names of the mappers with which the benchmark compares mpsfm."""


@dataclass(frozen=True, eq=False)
class MethodResult:
    """Result of a benchmark method on a test set of images."""

    models: Sequence[dict[str, Pose]] = ()
    """Estimated poses ``cam_from_world`` by image name of each model, the largest first."""
    seconds: float = 0.0
    """Wall time of the reconstruction in seconds, without dense evaluation."""
    cpu_seconds: float = 0.0
    """CPU time of the reconstruction in seconds, without dense evaluation."""
    peak_mib: float = 0.0
    """Peak memory of the subprocess, including its earlier runs; 0 if unknown."""
    error: str = ""
    """Error message of a failed run; empty on success."""
    dense: dict[str, Any] | None = None
    """Accuracy of depth maps and cloud of the largest model, from
    :meth:`DenseEvaluation.evaluate`."""


@dataclass(frozen=True, eq=False)
class MethodRun:
    """Inputs of a benchmark run: a method and a test set of images."""

    label: str
    """Label of the mapper and prior quality in the benchmark record."""
    method: str
    """Name of the method: :data:`OURS` or one of :data:`PEER_METHODS`."""
    problem: MappingProblem
    """Mapping problem (images, priors and verified matches) of the test set."""
    options: MapperOptions
    """Options of mpsfm."""
    dense: DenseEvaluation | None = None
    """Dense evaluation after mpsfm, or None to skip the evaluation."""
    threads: int = 1
    """Maximum number of threads (with several threads COLMAP is not deterministic)."""


def run_methods(
    runs: Sequence[MethodRun], workers: int
) -> Iterator[tuple[MethodRun, MethodResult]]:
    """Run benchmark methods in `workers` subprocesses and yield each result when its run ends."""
    processes = _WorkerProcesses()
    pool = ThreadPoolExecutor(max(1, workers), thread_name_prefix="mpsfm-benchmark")
    try:
        futures: dict[Future[MethodResult], MethodRun] = {
            pool.submit(processes.run, t): t for t in runs
        }
        for future in as_completed(futures):
            yield futures[future], future.result()
    finally:
        pool.shutdown(wait=True, cancel_futures=True)
        processes.close()


def run_method(run: MethodRun) -> MethodResult:
    """Run a benchmark method in this process; an exception becomes the error of the result."""
    started, cpu_started = time.perf_counter(), time.process_time()
    models: list[dict[str, Pose]] = []
    reconstructions: Sequence[Reconstruction] = ()
    dense, error = None, ""
    try:
        with limit_threads(run.threads):
            if run.method == CHAINED_PNP:
                models = estimate_chained_poses(run.problem, run.options.seed)
            elif run.method != OURS:
                models = run_peer(run.method, run.problem)
            else:
                reconstructions = part_mapping.reconstruct(run.problem, run.options).reconstructions
                models = [model.poses for model in reconstructions]
    except Exception as raised:  # The benchmark continues, because a failed run is also a result.
        error = f"{type(raised).__name__}: {raised}"
    seconds, cpu_seconds = time.perf_counter() - started, time.process_time() - cpu_started
    if run.dense is not None and reconstructions:
        try:
            with limit_threads(run.threads):
                dense = run.dense.evaluate(reconstructions[0], run.problem)
        except Exception as raised:  # The poses stay valid if dense evaluation fails.
            error = f"dense: {type(raised).__name__}: {raised}"
    return MethodResult(models, seconds, cpu_seconds, peak_memory_mb() or 0.0, error, dense)


class _WorkerProcesses:
    """Process pool with one subprocess per calling thread, restarted after a crash."""

    def __init__(self) -> None:
        self._local = threading.local()
        self._lock = threading.Lock()
        self._processes: list[ProcessPoolExecutor] = []

    def run(self, run: MethodRun) -> MethodResult:
        """Run a benchmark method in the subprocess of the calling thread."""
        process = getattr(self._local, "process", None) or self._start_process()
        try:
            return process.submit(run_method, run).result()
        except BrokenProcessPool:
            self._start_process()
            return MethodResult(error="its process died")

    def close(self) -> None:
        """Shut down all subprocesses of the process pool."""
        for process in self._processes:
            process.shutdown(wait=True, cancel_futures=True)

    def _start_process(self) -> ProcessPoolExecutor:
        # Subprocesses are not forked, because a fork copies held locks without the threads that
        # release the locks.
        context = multiprocessing.get_context("spawn")
        process = ProcessPoolExecutor(1, mp_context=context, initializer=initialize_process)
        self._local.process = process
        with self._lock:
            self._processes.append(process)
        return process


def initialize_process() -> None:
    """Silence COLMAP and load compiled kernels, which the run time should not include."""
    pycolmap.logging.minloglevel = int(pycolmap.logging.FATAL)
    camera = PinholeCamera(160, 120, 130.0, 130.0, 80.0, 60.0)
    problem = make_mapping_problem(room_scene(), camera, arc_poses(3, 8.0))
    run_method(MethodRun(OURS, OURS, problem, MapperOptions()))
