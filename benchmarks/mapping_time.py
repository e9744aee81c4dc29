"""Mapping time of our mapper and of COLMAP's incremental mapper on the same matches.

    python -m benchmarks.mapping_time [--scenes rendered_kitchen ...] [--output DIR]

Each test set has twice as many evenly spaced frames as the previous test set. Matches are those of
XFeat and LighterGlue, and depth priors are true depth; the time excludes extraction and matching. A
small test set is mapped first to load compiled code. COLMAP runs without and with structure-less
registration, the default since version 4. Writes benchmarks/results/mapping_time.md. Run this
benchmark on an idle machine.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from benchmarks._scenes import RESULTS, frame_names, print_progress, shared_folder, with_sets
from mpsfm_core.evaluation.benchmark import BenchmarkPlan, run_benchmark
from mpsfm_core.evaluation.records import BenchmarkRecord

SIZES = (7, 14, 28)
PEERS = ("colmap", "colmap-structureless")
METHODS = ("ours-sensor", *PEERS)


def main() -> None:
    """Map the frames of each scene, and write the table of mapping times."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", nargs="+", default=["rendered_kitchen", "hololens_room"])
    parser.add_argument("--output", type=Path, default=Path("build/benchmarks"))
    arguments = parser.parse_args()
    parts = [
        "# Mapping time",
        "Tables list wall time and CPU time of mapping in seconds (number of registered images).",
    ]
    for name in arguments.scenes:
        scene, output = shared_folder() / "data" / name, arguments.output / "mapping_time" / name
        frames = frame_names(scene)
        sizes = [size for size in SIZES if size <= len(frames)]
        sets = {f"{n:03d}": [_spaced(frames, n)] for n in sizes}
        folder = with_sets(scene, output / name, {"000": [frames[:4]], **sets})
        plan = BenchmarkPlan(
            (folder,), priors=("sensor",), peers=PEERS, overrides=("runtime.workers=1",), workers=1
        )
        records = run_benchmark(plan, output, on_record=print_progress)
        parts.append(f"## {name}\n\n{_table(sizes, records)}")
    text = "\n\n".join(parts) + "\n"
    RESULTS.mkdir(exist_ok=True)
    (RESULTS / "mapping_time.md").write_text(text, encoding="utf-8")
    print(text)


def _spaced(frames: Sequence[str], count: int) -> list[str]:
    return [frames[k] for k in np.linspace(0, len(frames) - 1, count).round().astype(int)]


def _table(sizes: Sequence[int], records: Sequence[BenchmarkRecord]) -> str:
    """Format a table row for each number of images, and a row of growth exponents of the time."""
    record_by_run = {(record.bucket, record.label): record for record in records}
    lines = [
        f"| images | {' | '.join(METHODS)} | ours / colmap | ours / colmap-structureless |",
        "|---" * (len(METHODS) + 3) + "|",
    ]
    seconds = np.zeros((len(sizes), len(METHODS)))
    for row, size in enumerate(sizes):
        of_size = [record_by_run[f"{size:03d}", method] for method in METHODS]
        seconds[row] = [record.seconds for record in of_size]
        cells = [f"{r.seconds:.2f}, {r.cpu_seconds:.2f} ({len(r.estimated)})" for r in of_size]
        ratios = [f"{seconds[row, 0] / other:.1f}x" for other in seconds[row, 1:]]
        lines.append(f"| {size} | {' | '.join([*cells, *ratios])} |")
    slopes = np.polyfit(np.log(sizes), np.log(seconds), 1)[0]
    lines.append(f"| growth | {' | '.join(f'n^{slope:.2f}' for slope in slopes)} | | |")
    return "\n".join(lines)


if __name__ == "__main__":
    main()
