"""Check that mapping in parts is bit-identical on all executors and after a killed process.

    python -m benchmarks.same_bits [--scene hall] [--views 1000] [--part-images 250]
        [--cases NAME ...] [--folder build/benchmarks/scale] [--output FILE]

A synthetic scene of :mod:`benchmarks.scale` is mapped in parts in each case, with one thread in
each process. The hash of a case covers poses, points and depth maps of all models. A process is
killed (SIGKILL) at 1.25 times the time of the first completed part, in the middle of the next part.
The run of a killed first process is repeated with the same cache folder, and only the repeated run
is measured. The CPU time of workers is that of their completed parts. The memory of a worker is the
peak with mapped files, the memory of the first process that without.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import shutil
import signal
import sys
import threading
import time
from collections import Counter
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any, NamedTuple

from benchmarks.scale import SCENES, store_scene, watch_memory
from mpsfm_core.config import RuntimeOptions
from mpsfm_core.evaluation.methods import initialize_process
from mpsfm_core.extraction.cache import digest
from mpsfm_core.extraction.executors import THREADS
from mpsfm_core.mapping.options import MapperOptions
from mpsfm_core.mapping.parts import part_mapping
from mpsfm_core.mapping.problem_state import problem_from_state
from mpsfm_core.mapping.scene.reconstruction import compute_depth_maps
from mpsfm_core.mapping.state import unflatten_state
from mpsfm_core.pipeline.parts import PartMapper
from mpsfm_core.pipeline.stages import Stages
from mpsfm_core.providers.registry import Registry
from mpsfm_core.support.disk_arrays import store_on_disk
from mpsfm_core.support.npz import read_npz
from mpsfm_core.support.threads import limit_threads

WORKER, FIRST_PROCESS = "worker", "first process"


class Case(NamedTuple):
    """Executor that maps the parts, and the process that is killed meanwhile, if any."""

    executor: str = THREADS
    workers: int = 0
    killed: str = ""


CASES = {
    "no executor": Case(),
    "1 Dask worker": Case("dask", 1),
    "3 Dask workers": Case("dask", 3),
    "2 Dask workers, one killed": Case("dask", 2, WORKER),
    "2 Dask workers, first process killed": Case("dask", 2, FIRST_PROCESS),
    "no executor, first process killed": Case(killed=FIRST_PROCESS),
    "2 Ray workers": Case("ray", 2),
    "2 Ray workers, one killed": Case("ray", 2, WORKER),
}


def main() -> int:
    """Run all cases, print a table, and return 1 if the hash of a case differs."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--scene", choices=list(SCENES), default="hall")
    parser.add_argument("--views", type=int, default=1000)
    parser.add_argument("--part-images", type=int, default=250)
    parser.add_argument("--cases", nargs="+", choices=list(CASES), default=list(CASES))
    parser.add_argument("--folder", type=Path, default=Path("build/benchmarks/scale"))
    parser.add_argument("--output", type=Path, help="also write the table to this file")
    arguments = parser.parse_args()
    scene = store_scene(arguments.scene, arguments.views, arguments.folder)
    lines = [
        "| case | hash | parts by worker | first process: CPU, s | memory, MiB | "
        "workers: CPU, s | memory, MiB |",
        "|---" * 7 + "|",
    ]
    hashes = set()
    for name in arguments.cases:
        row = _measure(scene, CASES[name], arguments.part_images)
        hashes.add(row.get("hash"))
        lines.append(f"| {name} | {_format(row)} |")
        print(lines[-1], file=sys.stderr, flush=True)
    text = "\n".join(lines)
    print(text)
    if arguments.output:
        arguments.output.write_text(f"{text}\n", encoding="utf-8")
    return int(len(hashes) != 1 or None in hashes)


def _measure(scene: Path, case: Case, part_images: int) -> Mapping[str, Any]:
    """Map a scene in new processes; return an empty result if one of the processes fails."""
    cache = scene.with_name("same-bits-cache")
    path = cache / "result.json"
    shutil.rmtree(cache, ignore_errors=True)
    context = multiprocessing.get_context("spawn")
    runs = [(case.killed, 0)]
    if case.killed == FIRST_PROCESS:
        runs = [(FIRST_PROCESS, -signal.SIGKILL), ("", 0)]
    for killed, expected in runs:
        process = context.Process(target=_run, args=(scene, case, part_images, cache, killed))
        process.start()
        process.join()
        if process.exitcode != expected:
            print(f"{case}: exit code {process.exitcode}", file=sys.stderr)
            break
    row: Mapping[str, Any] = json.loads(path.read_text("utf-8")) if path.exists() else {}
    shutil.rmtree(cache, ignore_errors=True)
    return row


class _KillOnce(Stages):
    """Receiver of progress that kills a process after the first completed part."""

    def __init__(self, cache: Path, killed: str) -> None:
        super().__init__(Registry())
        self._cache, self._killed = cache, killed
        self._started = 0.0

    def stage_started(self, stage: str, total: int | None) -> None:
        self._started = time.perf_counter()

    def stage_progress(self, stage: str, done: int, total: int) -> None:
        if done != 1 or not self._killed:
            return
        process = os.getpid()
        if self._killed == WORKER:
            (record, *_) = self._cache.glob("mapping/parts/*.json")
            worker = json.loads(record.read_text(encoding="utf-8"))["worker"]
            process = int(worker.rpartition(":")[2])
        wait_s = (time.perf_counter() - self._started) / 4
        threading.Timer(wait_s, os.kill, (process, signal.SIGKILL)).start()


def _run(scene: Path, case: Case, part_images: int, cache: Path, killed: str) -> None:
    """Map a scene in parts, and write hash, time and memory."""
    runtime = RuntimeOptions(
        cache_dir=cache,
        workers=1,
        executor=case.executor,
        executor_options={"workers": case.workers} if case.workers else {},
    )
    stages = _KillOnce(cache, killed)
    with limit_threads(1), store_on_disk(cache):
        problem = problem_from_state(unflatten_state(read_npz(scene))["problem"])
        initialize_process()
        cpu_started = time.process_time()
        with watch_memory() as peaks_mib:
            part_mapper = PartMapper(runtime, Registry.discover(), stages)
            options = MapperOptions(parts=part_images)
            result = part_mapping.reconstruct(problem, options, map_parts=part_mapper)
            models = compute_depth_maps(result.reconstructions)
        cpu_seconds = time.process_time() - cpu_started
    row = {
        "hash": digest(tuple(models)),
        "cpu_seconds": cpu_seconds,
        "peak_mib": max(peaks_mib),
        "parts": [asdict(record) for record in part_mapper.records],
        "process": os.getpid(),
    }
    (cache / "result.json").write_text(json.dumps(row), encoding="utf-8")


def _format(row: Mapping[str, Any]) -> str:
    """Format the cells of a case."""
    if not row:
        return "failed" + " |" * 5
    of_worker = Counter(part["worker"] for part in row["parts"])
    remote = [part for part in row["parts"] if not part["worker"].endswith(f":{row['process']}")]
    cells = [row["hash"][:12], "+".join(map(str, of_worker.values()))]
    cells += [f"{row['cpu_seconds']:.1f}", f"{row['peak_mib']:.0f}"]
    if remote:
        cpu_seconds = sum(part["cpu_seconds"] for part in remote)
        memory = max(part["peak_memory_mb"] for part in remote)
        cells += [f"{cpu_seconds:.1f}", f"{memory:.0f}"]
    else:
        cells += ["", ""]
    return " | ".join(cells)


if __name__ == "__main__":
    sys.exit(main())
