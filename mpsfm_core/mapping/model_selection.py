"""Runs of the mapper with different random choices: which counts, and when no more are needed.

They are compared by how many of the matches they explain, and where that is much the same by how
much of what images see lies in others at the same depth.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

from mpsfm_core.data import MappingProblem
from mpsfm_core.mapping.consistency.depth_agreement import measure_depth_agreement
from mpsfm_core.mapping.options import ConsistencyOptions
from mpsfm_core.mapping.scene.reconstruction import MappingReport, Reconstruction

AGREEMENT = 0.01
"""Of all matches; two runs that differ by less in what they explain came to the same (ours)."""


class Run(NamedTuple):
    """``models``: the groups of one run, the largest first. ``explained``: by each, of the summed
    scores of all matches."""

    models: Sequence[Reconstruction]
    explained: Sequence[float]
    report: MappingReport

    @property
    def of_largest(self) -> float:
        """Share of the matches that the largest group explains."""
        return self.explained[0] if self.explained else 0.0

    @property
    def size(self) -> int:
        """Number of images of the largest group."""
        return len(self.models[0].images) if self.models else 0


def settled(runs: Sequence[Run], enough: float) -> bool:
    """Whether the last run explains enough, or came to the same as one before it."""
    *before, last = runs
    return sum(last.explained) >= enough or any(_agree(run, last) for run in before)


def best(runs: Sequence[Run], options: ConsistencyOptions) -> Run:
    """The run whose largest group explains most; of those that explain about as much, one to which
    most others came too, and of these the one in which most depth agrees."""
    most = max(run.of_largest for run in runs)
    equal = [run for run in runs if most - run.of_largest < AGREEMENT]
    times = [sum(_agree(run, other) for other in runs) for run in equal]
    often = [run for run, count in zip(equal, times, strict=True) if count == max(times)]
    if len(often) == 1 or not most:
        return often[0]
    return max(often, key=lambda run: (measure_depth_agreement(run.models[0], options), run.of_largest))


def _agree(one: Run, other: Run) -> bool:
    return one.size == other.size and abs(one.of_largest - other.of_largest) < AGREEMENT


def with_all_times(report: MappingReport, runs: Sequence[Run]) -> MappingReport:
    """The report with the time that all runs took."""
    seconds: Counter[str] = Counter()
    counts: Counter[str] = Counter()
    for run in runs:
        seconds.update(run.report.seconds)
        counts.update(run.report.counts)
    return replace(report, seconds=dict(seconds), counts=dict(counts), runs=len(runs))


def explained_shares(models: Sequence[Reconstruction], problem: MappingProblem) -> list[float]:
    """What each model explains of the summed scores of all matches."""
    total = total_score(problem) or 1.0
    return [explained_score(model, problem) / total for model in models]


def explained_score(model: Reconstruction, problem: MappingProblem) -> float:
    """Summed scores of the matches of which both keypoints see the same point of a model."""
    points = {image.index: image.point_ids for image in model.images}
    total = 0.0
    for pair in problem.pairs:
        if pair.image_a in points and pair.image_b in points:
            seen_a = points[pair.image_a][pair.matches[:, 0]]
            seen_b = points[pair.image_b][pair.matches[:, 1]]
            total += float(pair.scores[(seen_a >= 0) & (seen_a == seen_b)].sum(dtype=float))
    return total


def total_score(problem: MappingProblem) -> float:
    """Summed scores of all matches."""
    return sum(float(pair.scores.sum(dtype=float)) for pair in problem.pairs)
