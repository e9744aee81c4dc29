"""Ablation of the mapper: each variant changes one component of the default mapper.

    python -m benchmarks.ablation [--scene rendered_kitchen] [--priors sensor,degraded]
        [--sets minimal,leq10,leq30,all] [--only NAME ...] [--output DIR] [--workers 1]

:data:`VARIANTS` lists the variants with their settings below ``mapping``. All variants use the same
matches. An interrupted ablation resumes from the folder --output. Writes
benchmarks/results/ablation-SCENE.md with AUC@1 / 5 / 20 degrees, as table 5 of the paper.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path

from benchmarks._scenes import RESULTS, print_progress, shared_folder
from mpsfm_core.evaluation.benchmark import BenchmarkPlan, run_benchmark
from mpsfm_core.evaluation.pose_auc import CONVENTIONS
from mpsfm_core.evaluation.report import BenchmarkRow, build_rows
from mpsfm_core.optimize.options import Loss
from mpsfm_core.support.yaml_text import write_yaml

VARIANTS: Mapping[str, Mapping[str, object]] = {
    "default": {},
    "initialization from one pair": {"global_initialization": False},
    "reprojection loss not estimated": {"refinement": {"measure_keypoint_noise": False}},
    "no lifting": {"registration": {"lifting": False}},
    "no depth refinement": {"refinement": {"integrate": False}},
    "no depth regularization": {"refinement": {"depth_regularization": False}},
    "no refinement, no regularization": {
        "refinement": {"integrate": False, "depth_regularization": False}
    },
    "no depth check": {"consistency": {"enabled": False}},
    "evidence not weighted": {"consistency": {"weigh_evidence": False}},
    "no final depth check": {"consistency": {"check_at_end": False}},
    "RANSAC poses not refined": {"registration": {"num_locally_optimized": 0}},
    "declared depth noise": {"refinement": {"measure_depth_noise": False}},
    "matches weighted equally": {"weigh_by_score": False},
    "new images with the final loss": {"refinement": {"first_reprojection_scale": 1.0}},
    "reprojection loss of the reference": {
        "refinement": {
            "bundle": {"reprojection_loss": int(Loss.SOFT_L1), "reprojection_scale": 1.5}
        }
    },
}


def main() -> None:
    """Map the test sets with all variants of the mapper, and write the tables of pose AUC."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scene", default="rendered_kitchen")
    parser.add_argument("--priors", default="sensor,degraded")
    parser.add_argument("--sets", default="minimal,leq10,leq30,all")
    names = list(VARIANTS)
    parser.add_argument("--only", nargs="+", choices=names, default=names, metavar="NAME")
    parser.add_argument("--output", type=Path, default=Path("build/benchmarks"))
    parser.add_argument("--workers", type=int, default=1)
    arguments = parser.parse_args()
    output = arguments.output / f"ablation-{arguments.scene}"
    configs = {_file_name(name): name for name in arguments.only}
    plan = BenchmarkPlan(
        (shared_folder() / "data" / arguments.scene,),
        tuple(str(_write_config(output / "configs", name)) for name in arguments.only),
        tuple(arguments.sets.split(",")),
        tuple(arguments.priors.split(",")),
        peers=(),
        overrides=("runtime.workers=1",),
        workers=arguments.workers,
    )
    rows = build_rows(run_benchmark(plan, output, on_record=print_progress))
    text = _table(arguments.scene, rows, configs)
    RESULTS.mkdir(exist_ok=True)
    (RESULTS / f"ablation-{arguments.scene}.md").write_text(text, encoding="utf-8")
    print(text)


def _write_config(folder: Path, name: str) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{_file_name(name)}.yaml"
    path.write_text(write_yaml({"extends": "benchmark", "mapping": dict(VARIANTS[name])}))
    return path


def _file_name(variant: str) -> str:
    return variant.replace(",", "").replace(" ", "-")


def _table(scene: str, rows: Sequence[BenchmarkRow], configs: Mapping[str, str]) -> str:
    """Format one table per depth prior, with a row per mapper variant."""
    convention = CONVENTIONS["paper"]
    parts = [
        f"# Ablation on {scene}",
        f"Pose AUC at 1 / 5 / 20 degrees in percent (registered images), convention "
        f"`{convention.name}`: {convention.description}.",
    ]
    cells = {(row.method, row.config, row.bucket): _cell(row) for row in rows}
    buckets = list(dict.fromkeys(row.bucket for row in rows))
    for method in dict.fromkeys(row.method for row in rows):
        lines = [["variant", *buckets], ["---"] * (len(buckets) + 1)]
        for config, variant in configs.items():
            lines.append([variant, *(cells.get((method, config, b), "") for b in buckets)])
        table = "\n".join(f"| {' | '.join(line)} |" for line in lines)
        parts.append(f"## {method}\n\n{table}")
    return "\n\n".join(parts) + "\n"


def _cell(row: BenchmarkRow) -> str:
    failed = f", {row.failed} failed" if row.failed else ""
    return f"{'/'.join(f'{v:.1f}' for v in row.auc.values())} ({row.registered:.0%}{failed})"


if __name__ == "__main__":
    main()
