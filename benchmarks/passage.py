"""CPU time of calls to providers in other environments, by ``python -m benchmarks.passage``.

Calls a provider with a constant result through a worker process. Measures CPU time of the main
process and the worker. View and depth map have one megapixel each, without and with variance. The
printed CPU time is the smallest of several rounds, without validation of the depth map.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import psutil

from mpsfm_core import DepthPrior, PinholeCamera, View
from mpsfm_core.providers.environments import worker
from mpsfm_core.providers.environments.worker_process import Worker

_SIDE = 1000
_CALLS, _ROUNDS = 100, 5


class _Holding:
    """Depth provider that returns constant depth maps."""

    def __init__(self) -> None:
        depth = np.random.default_rng(0).uniform(1, 2, (_SIDE, _SIDE))
        self._answers = {
            "depth": DepthPrior.from_arrays(depth),
            "depth and variance": DepthPrior.from_arrays(depth, depth),
        }

    def predict(self, view: View) -> DepthPrior:
        """Return the constant depth map (with or without variance) that the view's name selects."""
        return self._answers[view.name]


class _Service(worker.ProviderServer):
    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        self._provider = _Holding()


def main() -> None:
    """Measure the CPU time of calls through a worker process, and print the times."""
    rng = np.random.default_rng(1)
    image = rng.integers(0, 255, (_SIDE, _SIDE, 3), dtype=np.uint8)
    camera = PinholeCamera(_SIDE, _SIDE, 800, 800, 500, 500)
    with tempfile.TemporaryDirectory() as folder:
        python = Path(folder) / "python"
        python.write_text(f'#!/bin/sh\nexec {sys.executable} {__file__} "$3"\n')
        python.chmod(0o755)
        asked = Worker(python, "benchmark")
        for name in ("depth", "depth and variance"):
            arguments = [View(name, image, camera)]
            best = _cpu_ms(asked, {"do": "call", "method": "predict", "arguments": arguments})
            print(f"{name}: {best:.1f} ms of CPU a call", flush=True)
        asked.close()


def _cpu_ms(asked: Worker, call: dict[str, Any]) -> float:
    processes = [psutil.Process(), *psutil.Process().children()]

    def spent() -> float:
        return sum(sum(process.cpu_times()[:2]) for process in processes)

    rounds = []
    for _ in range(1 + _ROUNDS):  # the first call of the provider allocates the shared memory
        begin = spent()
        for _ in range(_CALLS):
            asked.ask(call, 60)
        rounds.append((spent() - begin) / _CALLS * 1e3)
    return min(rounds)


if __name__ == "__main__":
    if len(sys.argv) > 1:
        worker.ProviderServer = _Service  # type: ignore[misc]
        worker.main()
    else:
        main()
