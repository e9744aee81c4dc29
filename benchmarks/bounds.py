"""Upper bound of pose accuracy: our mapper, and our mapper started at the true poses.

    python -m benchmarks.bounds [--buckets minimal leq30] [--output DIR]

The scene is rendered_kitchen; its true depth is degraded with several random seeds. A mapper that
starts at the true poses only refines them, and drops images without points. The pose error that
remains is due to matches, depth errors or the objective function. Writes
benchmarks/results/bounds-rendered_kitchen.md.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from benchmarks._scenes import RESULTS, percent, shared_folder
from benchmarks.accuracy import DEGRADED
from mpsfm_core.data import Float64, MappingProblem, Pose
from mpsfm_core.evaluation.benchmark import SetPairFilter, prepare_sets
from mpsfm_core.evaluation.pose_auc import CONVENTIONS, pose_auc, pose_errors_deg
from mpsfm_core.evaluation.scene_folder import read_scene
from mpsfm_core.mapping.mapper import reconstruct
from mpsfm_core.providers.registry import Registry

SCENE = "rendered_kitchen"
CONVENTION = CONVENTIONS["paper"]
HEADER = (
    "| bucket | sets | initialization | AUC@1/5/20 | registered |\n| --- | --- | --- | --- | --- |"
)


def main() -> None:
    """Map all test sets from true initial poses and from scratch, and write the table of AUC."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--buckets", nargs="+", default=["minimal", "leq30"])
    parser.add_argument("--output", type=Path, default=Path("build/benchmarks"))
    arguments = parser.parse_args()
    scene = read_scene(shared_folder() / "data" / SCENE)
    sets = scene.select_sets(arguments.buckets)
    registry, only = Registry.discover(), SetPairFilter()
    only.allow(sets)
    registry.register(only, name="pairs of sets")
    errors: dict[tuple[str, str], list[Float64]] = {}
    sizes: dict[tuple[str, str], list[float]] = {}
    for prior in DEGRADED:
        prepared = prepare_sets(
            scene,
            sets,
            prior,
            "benchmark",
            ("runtime.workers=1",),
            arguments.output / "bounds",
            registry,
        )
        options = prepared.config.mapper_options()
        for item in sets:
            truth = {name: scene.truth[name] for name in item.images}
            plain = prepared.build_problem(item)
            for start, run in (("own", plain), ("true poses", _posed(plain, truth))):
                models = reconstruct(run, options).reconstructions
                poses = models[0].poses if models else {}
                key = item.bucket, start
                errors.setdefault(key, []).append(pose_errors_deg(poses, truth, CONVENTION))
                sizes.setdefault(key, []).append(len(poses) / len(truth))
    lines = [HEADER]
    for (bucket, start), each in errors.items():
        area = pose_auc(np.concatenate(each), CONVENTION)
        share = np.mean(sizes[bucket, start])
        lines.append(f"| {bucket} | {len(each)} | {start} | {percent(area)} | {share:.0%} |")
    parts = [
        f"# Bounds set by matches and depth on {SCENE}",
        "The table compares our mapper with our mapper initialized with the true poses, on "
        f"degraded depth of {len(DEGRADED)} random seeds. "
        f"Pose AUC in percent, convention `{CONVENTION.name}`: {CONVENTION.description}.",
        "\n".join(lines),
    ]
    text = "\n\n".join(parts) + "\n"
    RESULTS.mkdir(exist_ok=True)
    (RESULTS / f"bounds-{SCENE}.md").write_text(text, encoding="utf-8")
    print(text)


def _posed(problem: MappingProblem, truth: Mapping[str, Pose]) -> MappingProblem:
    images = tuple(replace(image, known_pose=truth[image.name]) for image in problem.images)
    return replace(problem, images=images)


if __name__ == "__main__":
    main()
