"""Our mapper and COLMAP's mapper on well-connected images with the same verified matches.

    python -m benchmarks.everyday [--views 49 100 ...] [--priors exact calibrated "locally biased"]
        [--only NAME ...] [--threads 1] [--repeats 1] [--json] [--output FILE]

Scenes are synthetic halls with boxes, seen by cameras along a path
(:mod:`mpsfm_core.testing.synthetic.halls`). Neighboring views overlap well, keypoints have 0.7 px
of noise and 5 % of the matches are outliers. Each run has its own process, which loads compiled
code before timing starts. Times are medians over repeats; runs of both mappers are interleaved.
Memory is the peak resident memory of the process. With ``--threads`` above 1, compare wall times
instead of CPU times. ``--only`` selects from :data:`VARIANTS`, mapper settings that differ from the
defaults. ``--json`` prints one JSON object as the last line.
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks._scenes import percent
from mpsfm_core.evaluation.methods import OURS, MethodResult, MethodRun, run_methods
from mpsfm_core.evaluation.pose_auc import CONVENTIONS, pose_auc, pose_errors_deg
from mpsfm_core.mapping.options import MapperOptions
from mpsfm_core.testing.synthetic.halls import QUALITIES, HallProblem, make_hall_problem

PEER = "colmap"
VARIANTS: Mapping[str, Mapping[str, object]] = {
    "default": {},
    "initialization from one pair": {"global_initialization": False},
    "reprojection loss not estimated": {"refinement": {"measure_keypoint_noise": False}},
    "evidence not weighted": {"consistency": {"weigh_evidence": False}},
    "no depth check": {"consistency": {"enabled": False}},
}
CONVENTION = CONVENTIONS["paper"]


def main() -> None:
    """Parse the command line, run both mappers, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--views", type=int, nargs="+", default=[49, 100])
    parser.add_argument("--priors", nargs="+", choices=list(QUALITIES), default=list(QUALITIES))
    parser.add_argument("--only", nargs="+", choices=list(VARIANTS), default=["default"])
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--repeats", type=int, default=1)
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--output", type=Path, help="also write the table to this file")
    arguments = parser.parse_args()
    rows = []
    for views in arguments.views:
        for prior in arguments.priors:
            rows += measured(views, prior, arguments.only, arguments.repeats, arguments.threads)
    text = table(rows)
    print(text)
    if arguments.output:
        arguments.output.write_text(text + "\n", encoding="utf-8")
    if arguments.json:
        print(json.dumps({"rows": rows, "growth": growth(rows)}))


def measured(
    views: int, prior: str, variants: Sequence[str], repeats: int, threads: int = 1
) -> list[dict[str, Any]]:
    """Yield a table row for COLMAP's mapper and for each variant of our mapper."""
    hall = make_hall_problem(views, QUALITIES[prior])
    methods = {PEER: (PEER, MapperOptions())}
    for variant in variants:
        methods[variant] = OURS, MapperOptions.model_validate(dict(VARIANTS[variant]))
    outcomes: dict[str, list[MethodResult]] = {label: [] for label in methods}
    for _ in range(repeats):
        for label, (method, options) in methods.items():
            # one reconstruction per process, because peak memory is per process
            tasks = [MethodRun(label, method, hall.problem, options, threads=threads)]
            outcomes[label] += [outcome for _, outcome in run_methods(tasks, 1)]
            print(f"{views} {prior} {label}: {outcomes[label][-1].seconds:.1f} s", file=sys.stderr)
    base = _row(hall, outcomes[PEER])
    shared = {
        "views": views,
        "priors": prior,
        "pairs": len(hall.problem.pairs),
        "matches": sum(len(pair) for pair in hall.problem.pairs),
    }
    rows = []
    for label, of_label in outcomes.items():
        row = {**shared, "method": label if label == PEER else f"ours, {label}"}
        row |= _row(hall, of_label)
        row["cpu_ratio"] = row["cpu_seconds"] / max(base["cpu_seconds"], 1e-9)
        row["wall_ratio"] = row["seconds"] / max(base["seconds"], 1e-9)
        rows.append(row)
    return rows


def _row(hall: HallProblem, outcomes: Sequence[MethodResult]) -> dict[str, Any]:
    """Compute median times over repeated runs, whose reconstructions are identical."""
    first = outcomes[0]
    poses = first.models[0] if first.models else {}
    area = pose_auc(pose_errors_deg(poses, hall.truth, CONVENTION), CONVENTION)
    return {
        "registered": len(poses),
        "auc": {str(threshold): value for threshold, value in area.items()},
        "auc_percent": percent(area),
        "seconds": statistics.median(o.seconds for o in outcomes),
        "cpu_seconds": statistics.median(o.cpu_seconds for o in outcomes),
        "peak_mib": statistics.median(o.peak_mib for o in outcomes),
        "error": first.error,
    }


def growth(rows: Sequence[Mapping[str, Any]]) -> dict[str, float]:
    """Fit the exponent of CPU time as a power of the number of views, by mapper and depth prior."""
    points: dict[str, list[tuple[int, float]]] = {}
    for row in rows:
        name = f"{row['method']}, {row['priors']}"
        points.setdefault(name, []).append((row["views"], row["cpu_seconds"]))
    return {
        name: float(np.polyfit(*np.log(np.array(of_name).T), 1)[0])
        for name, of_name in points.items()
        if len(of_name) > 1
    }


def table(rows: Sequence[Mapping[str, Any]]) -> str:
    """Format a Markdown table with one row per run, and the growth exponents of CPU time."""
    lines = [
        "| views | priors | method | registered | AUC@1/5/20 | CPU, s | wall, s | CPU / COLMAP | "
        "wall / COLMAP | peak, MiB |",
        "|---" * 10 + "|",
    ]
    lines += [
        f"| {row['views']} | {row['priors']} | {row['method']} | {row['registered']} | "
        f"{row['auc_percent']} | {row['cpu_seconds']:.1f} | {row['seconds']:.1f} | "
        f"{row['cpu_ratio']:.2f}x | {row['wall_ratio']:.2f}x | {row['peak_mib']:.0f} |"
        for row in rows
    ]
    exponents = [f"{name}: n^{value:.2f}" for name, value in growth(rows).items()]
    if exponents:
        lines += ["", "Growth of CPU time: " + "; ".join(exponents) + "."]
    return "\n".join(lines)


if __name__ == "__main__":
    main()
