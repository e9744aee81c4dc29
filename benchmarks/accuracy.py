"""Pose accuracy on the shared scenes, our mapper beside COLMAP's on the same matches.

    python -m benchmarks.accuracy [--tables rendered_kitchen ...] [--output DIR] [--workers 1]

Runs ``mpsfm benchmark`` (resumable: --output keeps what is done) and writes one Markdown file for
each table to benchmarks/results/. Scenes are in $MPSFM_SHARED or ../shared. For rendered_kitchen
the figures are held against the bars below; the exit code is 1 when one is missed.
"""

from __future__ import annotations

import argparse
import re
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from benchmarks._scenes import RESULTS, frame_names, shared_folder, tell, with_sets
from mpsfm_core.evaluation.benchmark import Plan, run_benchmark
from mpsfm_core.evaluation.pose_auc import CONVENTIONS
from mpsfm_core.evaluation.records import Record
from mpsfm_core.evaluation.report import Row, make_rows, markdown, write_report

PRIORS = ("sensor", "degraded", "config")
"""``config`` is FastDepth."""
SEEDS = 12
"""Of degraded depth on rendered_kitchen: its sets have few images, and their AUC depends on the
errors that these happen to have by several points."""
DEGRADED = ("degraded", *(f"degraded-{seed}" for seed in range(1, SEEDS)))
"""The priors of these seeds."""
TABLE_START = "Pose AUC in percent"
"""How what is written anew begins, below the note."""
WINDOWS, FRAMES = 6, 5
"""Low parallax: so many windows, evenly spaced, of so many consecutive frames."""


@dataclass(frozen=True)
class Comparison:
    """One table: a scene, its buckets (None: all) and priors, and the configuration.

    ``configuration``: its name, and what it says beside the prior. ``depth``: what it says of the
    prior ``config``, None for FastDepth. ``note``: said above the first table;
    what was written there by hand since stays.
    """

    scene: str
    buckets: tuple[str, ...] | None = None
    priors: tuple[str, ...] = PRIORS
    configuration: tuple[str, str] = ("xfeat", "")
    depth: str | None = None
    low_parallax: bool = False
    note: str = ""


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
"""Where networks are compared with each other."""
UNCONFIRMED = "unconfirmed", "mapping: {register_tentatively: true}\n"
COMPARISONS: Mapping[str, Comparison] = {
    "rendered_kitchen": Comparison(
        "rendered_kitchen",
        priors=(*PRIORS, *DEGRADED[1:]),
        note=f"Degraded depth: errors of {SEEDS} seeds, each counted as a set.",
    ),
    "hololens_room": Comparison(
        "hololens_room",
        note="`minimal` hangs on one pair: device_poses.md says what its truth is worth.",
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
        note="With `mapping.register_tentatively`: images that nothing confirms are placed where "
        "their matches fit best, and count.",
    ),
    **{
        f"{scene}-compact": Comparison(
            scene,
            buckets,
            ("config",),
            depth=COMPACT,
            note="Depth and normals of `compact`. FastDepth on the same matches: rows "
            f"`ours-config` of accuracy-{scene}.md.",
        )
        for scene, buckets in NETWORK_BUCKETS.items()
    },
}
"""Name of the table -> what is in it."""
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


def main() -> int:
    """Run the scenes; returns the exit code."""
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
        plan = Plan(
            (_low_parallax(scene, output / name) if comparison.low_parallax else scene,),
            (str(config),),
            comparison.buckets,
            comparison.priors,
            overrides=("runtime.workers=1",),
            workers=arguments.workers,
        )
        records = run_benchmark(plan, output, done=tell)
        write_report(output, records)
        pooled = [_pooled(record) for record in records]
        rows = make_rows(pooled)
        held = _against_bars(rows) if name == "rendered_kitchen" else []
        missed += sum("missed" in line for line in held)
        every = CONVENTIONS["models"]
        of_every = f"## Every model\n\n{markdown(make_rows(pooled, every), every)}"
        file = RESULTS / f"accuracy-{name}.md"
        note = _written_note(file) or comparison.note
        parts = [f"# {name}", note, markdown(rows), "\n".join(held), of_every]
        text = "\n\n".join(part.strip() for part in parts if part)
        RESULTS.mkdir(exist_ok=True)
        file.write_text(text.rstrip() + "\n", encoding="utf-8")
        print(text)
    return missed > 0


def _written_note(file: Path) -> str:
    """What was written by hand above the table of an earlier run."""
    if not file.is_file():
        return ""
    _, _, below_title = file.read_text(encoding="utf-8").partition("\n")
    note, table, _ = below_title.partition(TABLE_START)
    return note.strip() if table else ""


def _pooled(record: Record) -> Record:
    """The record under a label that all seeds of degraded depth share."""
    return replace(record, label=re.sub(r"degraded-\d+$", "degraded", record.label))


def _low_parallax(scene: Path, folder: Path) -> Path:
    """The scene once more, with windows of consecutive frames as its sets."""
    frames = frame_names(scene)
    starts = [k * (len(frames) - FRAMES) // (WINDOWS - 1) for k in range(WINDOWS)]
    windows = [frames[start : start + FRAMES] for start in starts]
    return with_sets(scene, folder, {"low_parallax": windows})


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


if __name__ == "__main__":
    sys.exit(main())
