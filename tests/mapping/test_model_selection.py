"""Tests of model selection among runs with different seeds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from mpsfm_core.data import MappingProblem, Rig
from mpsfm_core.mapping.mapper import reconstruct
from mpsfm_core.mapping.model_selection import (
    MapperRun,
    compute_explained_score,
    compute_total_score,
    is_settled,
    select_run,
    sum_step_times,
)
from mpsfm_core.mapping.options import MapperOptions
from mpsfm_core.mapping.reconstruction_score import score_reconstruction
from mpsfm_core.mapping.scene.reconstruction import MappingReport, Reconstruction
from mpsfm_core.mapping.scene.scene import Scene


def with_false_matches(problem: MappingProblem, share: float) -> MappingProblem:
    """Replace a share of each pair's matches by wrong matches."""
    pairs = []
    for pair in problem.pairs:
        matches = pair.matches.copy()
        wrong = slice(int(share * len(matches)))
        matches[wrong, 1] = matches[wrong, 1][::-1]
        pairs.append(replace(pair, matches=matches))
    return MappingProblem(problem.images, tuple(pairs))


def test_compute_explained_score_of_true_poses_is_nearly_total(problem: MappingProblem) -> None:
    (model,) = reconstruct(problem).reconstructions
    total = compute_total_score(problem)
    assert total == pytest.approx(sum(pair.scores.sum() for pair in problem.pairs))
    assert 0.85 * total < compute_explained_score(model, problem) <= total
    fewer = replace(model, images=model.images[:2])
    first = next(pair for pair in problem.pairs if (pair.image_a, pair.image_b) == (0, 1))
    assert 0 < compute_explained_score(fewer, problem) <= first.scores.sum()
    doubtful = with_false_matches(problem, 0.5)
    assert compute_explained_score(model, doubtful) < 0.6 * total


def test_reconstruct_runs_once_if_matches_are_explained(problem: MappingProblem) -> None:
    assert reconstruct(problem).report.runs == 1


def test_reconstruct_stops_after_two_equal_runs(problem: MappingProblem) -> None:
    doubtful = with_false_matches(problem, 0.35)
    result = reconstruct(doubtful, MapperOptions(max_runs=5))
    assert result.report.runs == 2
    alone = [reconstruct(doubtful, MapperOptions(max_runs=1, seed=seed)) for seed in range(2)]
    assert [run.report.runs for run in alone] == [1, 1]
    scores = [score_reconstruction(run.reconstructions[0], Scene(doubtful)).total for run in alone]
    best = alone[int(np.argmax(scores))].reconstructions[0]
    for image, same in zip(result.reconstructions[0].images, best.images, strict=True):
        np.testing.assert_array_equal(image.rotation, same.rotation)
        np.testing.assert_array_equal(image.translation, same.translation)
        np.testing.assert_array_equal(image.depth.depth, same.depth.depth)


def make_run(explained_ratios: Sequence[float]) -> MapperRun:
    """Return a run whose components have no images and explain the given shares of the scores."""
    models = [Reconstruction((), np.zeros((0, 3)), np.zeros(0)) for _ in explained_ratios]
    report = MappingReport(seconds={"all": 2.0}, counts={"all": 1})
    return MapperRun(models, explained_ratios, report)


@pytest.mark.parametrize(
    ("explained_ratios", "settled"),
    [
        ([[0.5]], False),
        ([[0.5], [0.6]], False),
        ([[0.5], [0.6], [0.505]], True),
        ([[0.5], [0.5]], True),
        ([[0.5], [0.8]], True),
        ([[0.4, 0.4]], True),
        ([[], [0.3]], False),
        ([[], []], True),
    ],
    ids=["one", "two", "same-as-first", "same", "enough", "enough-in-two", "none-first", "none"],
)
def test_runs_are_settled_if_enough_is_explained_or_two_runs_are_equal(
    explained_ratios: list[list[float]], settled: bool
) -> None:
    runs = [make_run(ratios) for ratios in explained_ratios]
    assert is_settled(runs, MapperOptions().enough_explained) == settled


def test_sum_step_times_adds_seconds_and_counts_of_all_runs() -> None:
    runs = [make_run([0.5])] * 3
    report = sum_step_times(runs[0].report, [run.report for run in runs])
    assert (report.runs, report.seconds, report.counts) == (3, {"all": 6.0}, {"all": 3})


def test_reconstruct_with_fixed_poses_runs_once(problem: MappingProblem) -> None:
    doubtful = with_false_matches(problem, 0.35)
    (model,) = reconstruct(problem).reconstructions
    options = MapperOptions(known_poses="fixed")
    assert reconstruct(doubtful.with_poses(model.poses), options).report.runs == 1


def test_select_run_prefers_the_run_that_registers_more_images(problem: MappingProblem) -> None:
    (model,) = reconstruct(problem).reconstructions
    fewer = replace(model, images=model.images[:3])
    runs = [
        MapperRun([], [], MappingReport()),
        MapperRun([fewer], [0.66], MappingReport()),
        MapperRun([model], [0.65], MappingReport()),
    ]
    assert select_run(runs, problem) is runs[2]
    assert select_run(runs[:2], problem) is runs[1]
    assert select_run(runs[:1], problem) is runs[0]


def test_select_run_prefers_correct_poses_to_more_explained_matches(
    problem: MappingProblem,
) -> None:
    """An image looks away from the others, although its run claims to explain more matches."""
    (model,) = reconstruct(problem).reconstructions
    *rest, last = model.images
    turned = np.diag([-1.0, 1.0, -1.0])
    away = replace(last, rotation=turned @ last.rotation, translation=turned @ last.translation)
    right = MapperRun([model], [0.650], MappingReport())
    wrong = MapperRun([replace(model, images=(*rest, away))], [0.7], MappingReport())
    assert select_run([right, wrong], problem) is select_run([wrong, right], problem) is right


@pytest.mark.parametrize(("ratio", "is_selected"), [(0.645, True), (0.6, False)])
def test_select_run_prefers_calibrated_rigs_that_explain_as_many_matches(
    problem: MappingProblem, ratio: float, is_selected: bool
) -> None:
    (model,) = reconstruct(problem).reconstructions
    rig = Rig(((np.eye(3), np.zeros(3)),), ((model.images[0].name,),))
    single = MapperRun([model], [0.65], MappingReport())
    calibrated = MapperRun([replace(model, rigs=(rig,))], [ratio], MappingReport())
    assert (select_run([single, calibrated], problem) is calibrated) == is_selected
