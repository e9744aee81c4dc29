"""Pose accuracy on the shared scenes, our mapper beside COLMAP's on the same matches.

    python -m benchmarks.accuracy [--scenes rendered_kitchen ...] [--output DIR] [--workers 1]

Runs ``mpsfm benchmark`` (resumable: --output keeps what is done) and writes one Markdown file for
each scene to benchmarks/results/. Scenes are in $MPSFM_SHARED or ../shared. For rendered_kitchen
the figures are held against the bars below; the exit code is 1 when one is missed.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

from benchmarks._scenes import RESULTS, shared_folder
from mpsfm_core.evaluation.benchmark import Plan, run_benchmark
from mpsfm_core.evaluation.records import Record
from mpsfm_core.evaluation.report import Row, make_rows, markdown, write_report

LOW_OVERLAP = ("minimal", "leq5", "leq10", "leq30", "all")
SCENES: Mapping[str, tuple[tuple[str, ...] | None, tuple[str, ...]]] = {
    "rendered_kitchen": (None, ("sensor", "degraded")),
    "hololens_room": (LOW_OVERLAP, ("sensor", "config")),
}
"""Scene -> buckets (None: all) and priors; ``config`` is FastDepth."""
BARS: Mapping[tuple[str, str], tuple[float, float, float]] = {
    ("minimal", "ours-sensor"): (35, 70, 80),
    ("leq10", "ours-sensor"): (35, 70, 80),
    ("leq30", "ours-sensor"): (55, 88, 96),
    ("all", "ours-sensor"): (70, 92, 97),
    ("minimal", "ours-degraded"): (12, 40, 65),
    ("leq30", "ours-degraded"): (30, 65, 85),
    ("all", "ours-degraded"): (45, 80, 92),
}
"""Bucket and method on rendered_kitchen -> AUC@1, 5, 20 that are wanted."""
FASTDEPTH = """\
extends: benchmark
depth:
  use: onnx
  options: {{model: {model}}}
"""


def main() -> int:
    """Run the scenes; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", nargs="+", default=list(SCENES), choices=list(SCENES))
    parser.add_argument("--output", type=Path, default=Path("build/benchmarks"))
    parser.add_argument("--workers", type=int, default=1)
    arguments = parser.parse_args()
    shared, missed = shared_folder(), 0
    arguments.output.mkdir(parents=True, exist_ok=True)
    config = arguments.output / "fastdepth.yaml"
    config.write_text(FASTDEPTH.format(model=shared / "models" / "fastdepth_224.onnx"))
    for name in arguments.scenes:
        buckets, priors = SCENES[name]
        plan = Plan(
            (shared / "data" / name,),
            (str(config) if "config" in priors else "benchmark",),
            buckets,
            priors,
            overrides=("runtime.workers=1",),
            workers=arguments.workers,
        )
        output = arguments.output / name
        records = run_benchmark(plan, output, done=_tell)
        write_report(output, records)
        rows = make_rows(records)
        held = _against_bars(rows) if name == "rendered_kitchen" else []
        missed += sum("missed" in line for line in held)
        text = f"# {name}\n\n{markdown(rows)}" + "".join(f"\n{line}" for line in held)
        RESULTS.mkdir(exist_ok=True)
        (RESULTS / f"accuracy-{name}.md").write_text(text.rstrip() + "\n", encoding="utf-8")
        print(text)
    return missed > 0


def _against_bars(rows: Sequence[Row]) -> list[str]:
    """A Markdown table of what was wanted and what was found."""
    lines = ["| bucket | method | wanted | found | |", "| --- | --- | --- | --- | --- |"]
    for row in rows:
        bar = BARS.get((row.bucket, row.method))
        if bar is not None:
            found = tuple(row.auc.values())
            verdict = "held" if all(f >= b for f, b in zip(found, bar, strict=True)) else "missed"
            wanted, have = (" / ".join(f"{v:.1f}" for v in side) for side in (bar, found))
            lines.append(f"| {row.bucket} | {row.method} | {wanted} | {have} | {verdict} |")
    return lines


def _tell(record: Record, known: bool) -> None:
    print(f"{record.set_name} {record.label}{' (known)' if known else ''}", file=sys.stderr)


if __name__ == "__main__":
    sys.exit(main())
