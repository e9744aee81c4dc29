"""Our mapper and COLMAP's mapper on synthetic halls that were not used to tune any option.

    python -m benchmarks.other_halls [--views 49] [--seeds 1 2 3 4] [--matches NAME ...]
        [--priors NAME ...] [--workers 2] [--output FILE]

The halls of :mod:`benchmarks.everyday` get other seeds, worse matches, fewer pairs and worse depth
priors. Our mapper and COLMAP's incremental mapper use the same verified matches. Registered images
are summed over the seeds, and pose AUC is over the image pairs of all seeds. CPU time is summed
over concurrent processes.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks._scenes import percent
from benchmarks.everyday import CONVENTION, PEER
from mpsfm_core.data import MappingProblem
from mpsfm_core.evaluation.methods import OURS, MethodResult, MethodRun, run_methods
from mpsfm_core.evaluation.pose_auc import pose_auc, pose_errors_deg
from mpsfm_core.mapping.options import MapperOptions
from mpsfm_core.testing.synthetic.halls import (
    CALIBRATED_PRIORS,
    QUALITIES,
    HallProblem,
    PriorErrors,
    make_hall_problem,
)


@dataclass(frozen=True)
class Matches:
    """Degradation of the matches of a synthetic hall.

    ``options`` are arguments of :func:`make_hall_problem`. ``share`` is the share of the image
    pairs that are used, at random. ``reach`` is the maximum index difference of the two views of a
    pair.
    """

    options: Mapping[str, float] = field(default_factory=dict)
    share: float = 1.0
    reach: int = 10**9

    def hall(self, views: int, errors: PriorErrors, seed: int) -> HallProblem:
        """Create a synthetic hall with degraded matches, and depth priors with errors."""
        hall = make_hall_problem(views, errors, seed=seed, **self.options)  # type: ignore[arg-type]
        rng = np.random.default_rng(seed)
        selected = [
            pair
            for pair in hall.problem.pairs
            if rng.uniform() < self.share and pair.image_b - pair.image_a <= self.reach
        ]
        return hall._replace(problem=MappingProblem(hall.problem.images, tuple(selected)))


MATCHES = {
    "as everyday": Matches(),
    "a fifth wrong": Matches({"wrong_matches": 0.2}),
    "off by 1.5 px": Matches({"keypoint_noise_px": 1.5}),
    "few points": Matches({"points_per_view": 25}),
    "a third of the pairs": Matches(share=1 / 3),
    "three neighbours": Matches(reach=3),
}
PRIORS = QUALITIES | {
    "wrong by half in a tenth": replace(CALIBRATED_PRIORS, patch=0.5),
    "of a weak network": PriorErrors(scale=0.2, field=0.12, declared=0.2),
}


def main() -> None:
    """Parse the command line, run both mappers on all halls, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--views", type=int, default=49)
    parser.add_argument("--seeds", type=int, nargs="+", default=[1, 2, 3, 4])
    parser.add_argument("--matches", nargs="+", choices=list(MATCHES), default=list(MATCHES))
    parser.add_argument("--priors", nargs="+", choices=list(PRIORS), default=list(PRIORS))
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--output", type=Path, help="also write the table to this file")
    arguments = parser.parse_args()
    lines = [
        "| matches | priors | images: COLMAP | ours | AUC@1/5/20: COLMAP | ours | CPU / COLMAP |",
        "|---" * 7 + "|",
    ]
    print(*lines, sep="\n")
    for matches in arguments.matches:
        for priors in arguments.priors:
            halls = [
                MATCHES[matches].hall(arguments.views, PRIORS[priors], seed)
                for seed in arguments.seeds
            ]
            lines.append(f"| {matches} | {priors} | {compared(halls, arguments.workers)} |")
            print(lines[-1], flush=True)
    if arguments.output:
        arguments.output.write_text("\n".join(lines) + "\n", encoding="utf-8")


def compared(halls: Sequence[HallProblem], workers: int) -> str:
    """Compute registered images, pose AUC and CPU time of both mappers for one table row."""
    tasks = [
        MethodRun(f"{number}", method, hall.problem, MapperOptions())
        for number, hall in enumerate(halls)
        for method in (PEER, OURS)
    ]
    results: dict[str, list[tuple[HallProblem, MethodResult]]] = {PEER: [], OURS: []}
    for task, outcome in run_methods(tasks, workers):
        results[task.method].append((halls[int(task.label)], outcome))
    of_peer, of_ours = _summed(results[PEER]), _summed(results[OURS])
    total = sum(len(hall.truth) for hall in halls)
    cells = [f"{rows['images']} of {total}" for rows in (of_peer, of_ours)]
    cells += [percent(rows["auc"]) for rows in (of_peer, of_ours)]
    return " | ".join([*cells, f"{of_ours['seconds'] / of_peer['seconds']:.2f}x"])


def _summed(outcomes: Sequence[tuple[HallProblem, MethodResult]]) -> dict[str, Any]:
    models = [outcome.models[0] if outcome.models else {} for _, outcome in outcomes]
    errors = [
        pose_errors_deg(model, hall.truth, CONVENTION)
        for model, (hall, _) in zip(models, outcomes, strict=True)
    ]
    return {
        "images": sum(map(len, models)),
        "auc": pose_auc(np.concatenate(errors), CONVENTION),
        "seconds": sum(outcome.cpu_seconds for _, outcome in outcomes),
    }


if __name__ == "__main__":
    main()
