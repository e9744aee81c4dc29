"""Selection of one result among mapper runs with different seeds.

Runs stop when the components explain enough matches, or when two runs give the same result. A
component explains a match if both keypoints of the match observe the same 3D point. The run with
the highest score (:mod:`~mpsfm_core.mapping.reconstruction_score`) is selected.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

from mpsfm_core.data import MappingProblem
from mpsfm_core.mapping.reconstruction_score import score_reconstruction
from mpsfm_core.mapping.scene.reconstruction import (
    MappingReport,
    Reconstruction,
    find_explained_matches,
)
from mpsfm_core.mapping.scene.scene import Scene
from mpsfm_core.mapping.state import StateDict

MAX_RATIO_DIFFERENCE = 0.01
"""Difference between the explained shares of the match scores below which two runs count as equal.
[ours]"""


class MapperRun(NamedTuple):
    """Result of one mapper run with one seed."""

    models: Sequence[Reconstruction]
    """Reconstructed components of the run, sorted by decreasing size."""
    explained_ratios: Sequence[float]
    """Share of the summed match scores that each component explains, in [0, 1]."""
    report: MappingReport

    @property
    def largest_explained_ratio(self) -> float:
        """Share of the match scores that the largest component explains, in [0, 1]."""
        return self.explained_ratios[0] if self.explained_ratios else 0.0

    @property
    def size(self) -> int:
        """Number of images of the largest component."""
        return len(self.models[0].images) if self.models else 0

    @property
    def num_rigs(self) -> int:
        """Number of calibrated rigs."""
        return len(self.models[0].rigs) if self.models else 0

    def state_dict(self) -> StateDict:
        """Return the state of the mapper run for a checkpoint."""
        return {
            "models": [model.state_dict() for model in self.models],
            "explained_ratios": self.explained_ratios,
            "report": self.report.state_dict(),
        }

    @classmethod
    def from_state_dict(cls, state: StateDict) -> MapperRun:
        """Restore a mapper run from a checkpoint."""
        models = [Reconstruction.from_state_dict(model) for model in state["models"]]
        report = MappingReport.from_state_dict(state["report"])
        return cls(models, state["explained_ratios"], report)


def is_settled(runs: Sequence[MapperRun], min_explained_ratio: float) -> bool:
    """Return True if no further mapper run is needed after the last run."""
    *earlier, last = runs
    is_explained = sum(last.explained_ratios) >= min_explained_ratio
    return is_explained or any(_are_equal(run, last) for run in earlier)


def has_refuted_rigs(problem: MappingProblem, runs: Sequence[MapperRun]) -> bool:
    """Return True if a run without the estimated rigs explains more matches than the last.

    A camera that moves evenly looks like a rig, but such a rig contradicts many matches.

    Args:
        problem: Problem of the last run.
        runs: All mapper runs, oldest first.
    """
    if not any(rig.is_estimated for rig in problem.rigs):
        return False
    *earlier, last = (run.largest_explained_ratio for run in runs)
    return max(earlier, default=0.0) - last > MAX_RATIO_DIFFERENCE


def select_run(runs: Sequence[MapperRun], problem: MappingProblem) -> MapperRun:
    """Select the run whose components have the highest score.

    A run with fewer calibrated rigs is selected only if it explains clearly more matches.

    Args:
        runs: Mapper runs, oldest first.
        problem: Mapping problem with the matches that the score compares with the poses.
    """
    max_ratio = max(run.largest_explained_ratio for run in runs)
    num_rigs = max(
        run.num_rigs
        for run in runs
        if max_ratio - run.largest_explained_ratio < MAX_RATIO_DIFFERENCE
    )
    candidates = [run for run in runs if run.num_rigs == num_rigs]
    if len(candidates) == 1:
        return candidates[0]
    scene = Scene(problem)
    return max(
        candidates,
        key=lambda run: sum(score_reconstruction(model, scene).total for model in run.models),
    )


def _are_equal(a: MapperRun, b: MapperRun) -> bool:
    difference = abs(a.largest_explained_ratio - b.largest_explained_ratio)
    return a.size == b.size and difference < MAX_RATIO_DIFFERENCE


def sum_step_times(report: MappingReport, reports: Sequence[MappingReport]) -> MappingReport:
    """Return the report of one mapper run, with the step times summed over several runs."""
    seconds: Counter[str] = Counter()
    counts: Counter[str] = Counter()
    for other in reports:
        seconds.update(other.seconds)
        counts.update(other.counts)
    return replace(report, seconds=dict(seconds), counts=dict(counts), runs=len(reports))


def compute_explained_ratios(
    models: Sequence[Reconstruction], problem: MappingProblem
) -> list[float]:
    """Compute the share of all summed match scores that each model explains, in [0, 1]."""
    total = compute_total_score(problem) or 1.0
    return [compute_explained_score(model, problem) / total for model in models]


def compute_explained_score(model: Reconstruction, problem: MappingProblem) -> float:
    """Sum the scores of the matches whose keypoints observe the same 3D point of a model."""
    explained_matches = find_explained_matches(model.images, problem)
    return sum(float(pair.scores[mask].sum(dtype=float)) for pair, mask in explained_matches)


def compute_total_score(problem: MappingProblem) -> float:
    """Sum the scores of all matches between different frames of the mapping problem."""
    return sum(float(pair.scores.sum(dtype=float)) for pair in problem.pairs_between_frames())
