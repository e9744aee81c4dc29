"""Tests of model selection among runs with different seeds, by the share of explained matches."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from mpsfm_core.data import MappingProblem, PinholeCamera
from mpsfm_core.mapping import mapper
from mpsfm_core.mapping.consistency.depth_agreement import measure_depth_agreement
from mpsfm_core.mapping.mapper import reconstruct
from mpsfm_core.mapping.model_selection import (
    MapperRun,
    compute_explained_score,
    compute_total_score,
    select_run,
)
from mpsfm_core.mapping.options import ConsistencyOptions, MapperOptions
from mpsfm_core.mapping.scene.reconstruction import MappingReport, Reconstruction
from mpsfm_core.testing.synthetic.problems import SyntheticNoise, make_mapping_problem
from mpsfm_core.testing.synthetic.scenes import arc_poses, room_scene

OPTIONS = ConsistencyOptions()
CAMERA = PinholeCamera(320, 240, 260.0, 260.0, 160.0, 120.0)


@pytest.fixture(scope="module")
def problem() -> MappingProblem:
    """Return the mapping problem of four views on an arc."""
    return make_mapping_problem(
        room_scene(), CAMERA, arc_poses(4, 21.0), noise=SyntheticNoise(keypoints_px=0.3, depth=0.01)
    )


def with_false_matches(problem: MappingProblem, share: float) -> MappingProblem:
    """Return the problem with a share of wrong matches in each pair."""
    pairs = []
    for pair in problem.pairs:
        matches = pair.matches.copy()
        wrong = slice(int(share * len(matches)))
        matches[wrong, 1] = matches[wrong, 1][::-1]
        pairs.append(replace(pair, matches=matches))
    return MappingProblem(problem.images, tuple(pairs))


def test_correct_poses_explain_correct_matches(problem: MappingProblem) -> None:
    (model,) = reconstruct(problem).reconstructions
    total = compute_total_score(problem)
    assert total == pytest.approx(sum(pair.scores.sum() for pair in problem.pairs))
    assert 0.85 * total < compute_explained_score(model, problem) <= total
    fewer = replace(model, images=model.images[:2])
    first = next(pair for pair in problem.pairs if (pair.image_a, pair.image_b) == (0, 1))
    assert 0 < compute_explained_score(fewer, problem) <= first.scores.sum()
    doubtful = with_false_matches(problem, 0.5)
    assert compute_explained_score(model, doubtful) < 0.6 * total


def test_explained_matches_need_one_run(problem: MappingProblem) -> None:
    assert reconstruct(problem).report.runs == 1


def test_agreeing_runs_end_the_search(problem: MappingProblem) -> None:
    doubtful = with_false_matches(problem, 0.35)
    result = reconstruct(doubtful, MapperOptions(max_runs=5))
    assert result.report.runs == 2
    alone = [reconstruct(doubtful, MapperOptions(max_runs=1, seed=seed)) for seed in range(2)]
    assert [run.report.runs for run in alone] == [1, 1]
    scores = [compute_explained_score(run.reconstructions[0], doubtful) for run in alone]
    best = alone[int(np.argmax(scores))].reconstructions[0]
    for image, same in zip(result.reconstructions[0].images, best.images, strict=True):
        np.testing.assert_array_equal(image.rotation, same.rotation)
        np.testing.assert_array_equal(image.translation, same.translation)
        np.testing.assert_array_equal(image.depth.depth, same.depth.depth)


class Scripted:
    """Mapper whose runs are given by the share of matches that each component explains."""

    script: Sequence[Sequence[float]] = ()
    is_deterministic = False
    pair_weights = None

    def __init__(
        self, problem: MappingProblem, options: MapperOptions, events: object, weighed: object
    ) -> None:
        self.explained = self.script[options.seed]

    def run(self, paused: object = None) -> MapperRun:
        # the points of a model identify the component by its explained share
        models = [Reconstruction((), np.full((1, 3), e), np.zeros(1)) for e in self.explained]
        report = MappingReport(seconds={"all": 2.0}, counts={"all": 1})
        return MapperRun(models, self.explained, report)


@pytest.mark.parametrize(
    ("script", "kept", "runs"),
    [
        ([[0.5], [0.6], [0.55]], 0.6, 3),
        ([[0.5], [0.6], [0.505], [0.9]], 0.6, 3),
        ([[0.5], [0.5], [0.9]], 0.5, 2),
        ([[0.5], [0.8], [0.9]], 0.8, 2),
        ([[0.4, 0.4], [0.9]], 0.4, 1),
        ([[], [0.3], [0.2]], 0.3, 3),
        ([[], []], None, 2),
    ],
    ids=["most", "agreement-with-any", "same", "enough", "enough-in-groups", "none-first", "none"],
)
def test_reconstruct_selects_the_run_that_explains_most(
    monkeypatch: pytest.MonkeyPatch,
    problem: MappingProblem,
    script: list[list[float]],
    kept: float | None,
    runs: int,
) -> None:
    monkeypatch.setattr(Scripted, "script", script)
    monkeypatch.setattr(mapper, "Mapper", Scripted)
    result = reconstruct(problem, MapperOptions(max_runs=3))
    assert result.report.runs == runs
    assert result.report.seconds == ({"all": 2.0 * runs}) and result.report.counts == {"all": runs}
    found = [float(model.points[0, 0]) for model in result.reconstructions]
    assert found[:1] == ([] if kept is None else [kept])


def test_deterministic_mapper_needs_one_run(
    monkeypatch: pytest.MonkeyPatch, problem: MappingProblem
) -> None:
    monkeypatch.setattr(Scripted, "script", [[0.1], [0.2]])
    monkeypatch.setattr(Scripted, "is_deterministic", True)
    monkeypatch.setattr(mapper, "Mapper", Scripted)
    assert reconstruct(problem).report.runs == 1


def test_select_run_prefers_repeated_result(problem: MappingProblem) -> None:
    """A single run is selected only if it explains clearly more than two runs with the same
    result."""
    (model,) = reconstruct(problem).reconstructions

    def run(size: int, explained: float) -> MapperRun:
        return MapperRun([replace(model, images=model.images[:size])], [explained], MappingReport())

    alone, one, other = run(4, 0.662), run(3, 0.655), run(3, 0.660)
    assert select_run([alone, one, other], OPTIONS) is other
    assert select_run([alone, one], OPTIONS) is alone
    clearly = run(4, 0.68)
    assert select_run([clearly, one, other], OPTIONS) is clearly


def test_select_run_of_equal_runs_prefers_agreeing_depth(problem: MappingProblem) -> None:
    """If two runs explain equally many matches, the depth maps must agree in the selected run."""
    (model,) = reconstruct(problem).reconstructions
    *rest, last = model.images
    turned = np.diag([-1.0, 1.0, -1.0])
    away = replace(last, rotation=turned @ last.rotation, translation=turned @ last.translation)
    elsewhere = replace(model, images=(*rest, away))
    assert measure_depth_agreement(elsewhere, OPTIONS) < measure_depth_agreement(model, OPTIONS)
    right = MapperRun([model], [0.650], MappingReport())
    wrong = MapperRun([elsewhere], [0.655], MappingReport())
    assert select_run([right, wrong], OPTIONS) is select_run([wrong, right], OPTIONS) is right
