"""Pose accuracy of our mapper and COLMAP's mappers on the same verified matches.

    python -m benchmarks.accuracy [--tables rendered_kitchen ...] [--output DIR] [--workers 1]

Runs ``mpsfm benchmark`` and writes one file per table to benchmarks/results/. An interrupted
benchmark resumes from the folder --output, whose report.json has pose AUC of all methods. Scenes
are in $MPSFM_SHARED or ../shared. The exit code is 1 if a pose AUC on rendered_kitchen is below its
target.
"""

from __future__ import annotations

import argparse
import re
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from benchmarks._scenes import RESULTS, frame_names, print_progress, shared_folder, with_sets
from mpsfm_core.evaluation.benchmark import BenchmarkPlan, run_benchmark
from mpsfm_core.evaluation.records import BenchmarkRecord
from mpsfm_core.evaluation.report import BenchmarkRow, build_rows, format_markdown, write_report

PRIORS = ("sensor", "degraded", "config")
"""Depth priors of the benchmark; the prior ``config`` is the network FastDepth."""
SEEDS = 12
"""Number of random seeds of the simulated depth errors on the scene rendered_kitchen.

Seeds change pose AUC on rendered_kitchen by several points, because its test sets have few images.
"""
DEGRADED = ("degraded", *(f"degraded-{seed}" for seed in range(1, SEEDS)))
"""Names of the depth priors with simulated errors, one per random seed."""
TABLE_START = "Pose AUC in percent"
"""First words of the generated part of a result page; the text above is hand-written."""
WINDOWS, FRAMES = 6, 5
"""Number of low-parallax test sets, and of consecutive video frames in each of them."""


@dataclass(frozen=True)
class Comparison:
    """One table of pose AUC: a scene, its buckets (None: all) and priors, and the configuration.

    ``configuration`` is the name of a YAML configuration and its settings. ``depth`` is the YAML
    block of the depth network, None for FastDepth. ``note`` is the text above the table of a new
    page. ``ours_only`` omits COLMAP's mappers from the table.
    """

    scene: str
    buckets: tuple[str, ...] | None = None
    priors: tuple[str, ...] = PRIORS
    configuration: tuple[str, str] = ("xfeat", "")
    depth: str | None = None
    low_parallax: bool = False
    note: str = ""
    ours_only: bool = False


ALIKED = (
    "aliked",
    """\
features: {use: aliked, options: {max_keypoints: 1500}}
matcher: {use: lightglue-aliked}
""",
)
FASTDEPTH = "depth: {{use: onnx, options: {{model: {model}}}}}\n"
COMPACT = "depth: {use: compact}\nnormals: {use: compact}\n"
NETWORK_BUCKETS: Mapping[str, tuple[str, ...]] = {
    "rendered_kitchen": ("minimal", "leq30", "all"),
    "hololens_room": ("leq5", "leq10", "leq30", "all"),
}
"""Buckets (test sets grouped by overlap) of each scene on which depth networks are compared."""
UNCONFIRMED = "unconfirmed", "mapping: {register_tentatively: true}\n"
COMPARISONS: Mapping[str, Comparison] = {
    "rendered_kitchen": Comparison(
        "rendered_kitchen",
        priors=(*PRIORS, *DEGRADED[1:]),
        note=f"Degraded depth has errors of {SEEDS} seeds, and each seed counts as a test set.",
    ),
    "hololens_room": Comparison(
        "hololens_room",
        note="The bucket `minimal` depends on the device pose of one pair (device_poses.md).",
    ),
    "hololens_room-low_parallax": Comparison("hololens_room", low_parallax=True),
    "hololens_room-aliked": Comparison(
        "hololens_room", ("minimal", "leq5", "leq10"), ("sensor", "config"), ALIKED
    ),
    "hololens_room-unconfirmed": Comparison(
        "hololens_room",
        ("minimal", "leq5", "leq10", "all"),
        ("sensor", "config"),
        UNCONFIRMED,
        note="With `mapping.register_tentatively`, images that cannot be verified are registered "
        "with the pose that explains most of their matches.",
        ours_only=True,
    ),
    **{
        f"{scene}-compact": Comparison(
            scene,
            buckets,
            ("config",),
            depth=COMPACT,
            note="The mapper uses depth and normals of the network `compact`. FastDepth on the "
            f"same matches is in the rows `ours-config` of accuracy-{scene}.md.",
            ours_only=True,
        )
        for scene, buckets in NETWORK_BUCKETS.items()
    },
}
"""Tables by name."""
TARGETS: Mapping[tuple[str, str], tuple[float, float, float]] = {
    ("minimal", "ours-sensor"): (35, 70, 80),
    ("leq10", "ours-sensor"): (35, 70, 80),
    ("leq30", "ours-sensor"): (55, 88, 96),
    ("all", "ours-sensor"): (70, 92, 97),
    ("minimal", "ours-degraded"): (12, 40, 65),
    ("leq30", "ours-degraded"): (30, 65, 85),
    ("all", "ours-degraded"): (45, 80, 92),
}
"""Target pose AUC in percent at 1, 5, 20 degrees on rendered_kitchen, by bucket and method."""


def main() -> int:
    """Compare our mapper with COLMAP's; return 1 if pose AUC misses a target, else 0."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--tables", nargs="+", default=list(COMPARISONS), choices=COMPARISONS)
    parser.add_argument("--output", type=Path, default=Path("build/benchmarks"))
    parser.add_argument("--workers", type=int, default=1)
    arguments = parser.parse_args()
    shared, missed = shared_folder(), 0
    for name in arguments.tables:
        comparison, output = COMPARISONS[name], arguments.output / name
        output.mkdir(parents=True, exist_ok=True)
        label, settings = comparison.configuration
        config = output / f"{label}.yaml"
        fastdepth = FASTDEPTH.format(model=shared / "models" / "fastdepth_224.onnx")
        config.write_text(f"extends: benchmark\n{comparison.depth or fastdepth}{settings}")
        scene = shared / "data" / comparison.scene
        plan = BenchmarkPlan(
            (_low_parallax(scene, output / name) if comparison.low_parallax else scene,),
            (str(config),),
            comparison.buckets,
            comparison.priors,
            overrides=("runtime.workers=1",),
            workers=arguments.workers,
        )
        records = run_benchmark(plan, output, on_record=print_progress)
        write_report(output, records)
        pooled = [_pooled(record) for record in records]
        rows = build_rows(pooled)
        targets = _compare_with_targets(rows) if name == "rendered_kitchen" else []
        missed += sum("missed" in line for line in targets)
        shown = [row for row in rows if _is_shown(row, comparison)]
        file = RESULTS / f"accuracy-{name}.md"
        note = _written_note(file) or comparison.note
        parts = [f"# {name}", note, format_markdown(shown), "\n".join(targets)]
        text = "\n\n".join(part.strip() for part in parts if part)
        RESULTS.mkdir(exist_ok=True)
        file.write_text(text.rstrip() + "\n", encoding="utf-8")
        print(text)
    return missed > 0


def _is_shown(row: BenchmarkRow, comparison: Comparison) -> bool:
    """Return true if the table of a comparison contains a row of the benchmark report."""
    if row.method.startswith("chained-pnp"):
        return False
    return row.method.startswith("ours") or not comparison.ours_only


def _written_note(file: Path) -> str:
    """Return the hand-written text above the table of an existing result page."""
    if not file.is_file():
        return ""
    _, _, below_title = file.read_text(encoding="utf-8").partition("\n")
    note, table, _ = below_title.partition(TABLE_START)
    return note.strip() if table else ""


def _pooled(record: BenchmarkRecord) -> BenchmarkRecord:
    """Remove the seed of simulated depth errors from the label of a result, to pool all seeds."""
    return replace(record, label=re.sub(r"degraded-\d+$", "degraded", record.label))


def _low_parallax(scene: Path, folder: Path) -> Path:
    """Copy a scene, and replace its test sets by windows of consecutive video frames."""
    frames = frame_names(scene)
    starts = [k * (len(frames) - FRAMES) // (WINDOWS - 1) for k in range(WINDOWS)]
    windows = [frames[start : start + FRAMES] for start in starts]
    return with_sets(scene, folder, {"low_parallax": windows})


def _compare_with_targets(rows: Sequence[BenchmarkRow]) -> list[str]:
    """Format a table of target and measured pose AUC as lines of Markdown."""
    lines = ["| bucket | method | target | measured | |", "| --- | --- | --- | --- | --- |"]
    for row in rows:
        bar = TARGETS.get((row.bucket, row.method))
        if bar is not None:
            measured = tuple(row.auc.values())
            verdict = (
                "reached" if all(f >= b for f, b in zip(measured, bar, strict=True)) else "missed"
            )
            wanted, have = (" / ".join(f"{v:.1f}" for v in side) for side in (bar, measured))
            lines.append(f"| {row.bucket} | {row.method} | {wanted} | {have} | {verdict} |")
    return lines


if __name__ == "__main__":
    sys.exit(main())
