"""Test that repeated reconstructions in one process do not leak memory."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

import mpsfm_core
from mpsfm_core.testing.leak_probe import ProcessUsage, measure_usage

RUNS = 20
MOST_MB = 15.0
"""Maximum memory growth in MB from the first to the second half of the runs, twice the measured
growth. The allocator causes this initial growth; memory does not grow further in 200 runs
(benchmarks/results/leaks.md)."""


@pytest.mark.slow
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="memory is given back on Linux")
def test_repeated_reconstructions_do_not_leak(photo_scene, tmp_path: Path) -> None:
    listed = tmp_path / "list.txt"
    listed.write_text("1.png\n2.png\n3.png\n")
    settings = ("extraction.integration_size=64", "inputs.max_image_size=160")

    def run() -> None:
        mpsfm_core.reconstruct(
            photo_scene.images,
            tmp_path / "out",
            config=photo_scene.config,
            intrinsics=photo_scene.intrinsics,
            image_list=listed,
            overrides=[f"runtime.cache_dir={tmp_path}", *settings],
        )

    held = np.fromiter(measure_usage(run, RUNS), np.dtype((float, len(ProcessUsage._fields))), RUNS)
    middle, end = ProcessUsage(*held[RUNS // 2 - 1]), ProcessUsage(*held[-1])
    assert (end.objects, end.files, end.threads) == (middle.objects, middle.files, middle.threads)
    first, second = held[: RUNS // 2, 0], held[RUNS // 2 :, 0]
    assert np.median(second) - np.median(first) < MOST_MB
