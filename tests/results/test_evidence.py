"""Tests of the evidence for a reconstruction on scenes with known values."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations

import numpy as np

from mpsfm_core.data import VerifiedPair
from mpsfm_core.results.evidence import count_explained_matches, describe_evidence


def test_explained_matches_count_common_points_of_a_pair(solved) -> None:
    right = np.stack([np.arange(10)] * 2, axis=1)
    wrong = np.stack([np.arange(10), np.arange(10) + 1], axis=1)
    matches = np.concatenate([right, wrong])
    scores = np.ones(len(matches), np.float32)
    pairs = (
        VerifiedPair(0, 1, matches, scores, np.eye(3), np.zeros(3)),
        VerifiedPair(0, 3, matches, scores, np.eye(3), np.zeros(3)),
    )
    explained = count_explained_matches(solved.best, replace(solved.problem, pairs=pairs))
    assert explained == {("images/0.png", "images/1.png"): 10}


def test_evidence_of_duplicate_has_the_explained_ratio_of_its_original(solved) -> None:
    problem, model = solved.problem, solved.best
    original, duplicate, third = (image.index for image in model.images[:3])
    names = [problem.images[index].name for index in (original, duplicate)]
    images = list(problem.images)
    images[duplicate] = replace(images[duplicate], duplicate_of=names[0])
    right = np.stack([np.arange(10)] * 2, axis=1)
    wrong = np.stack([np.arange(10), np.arange(10) + 1], axis=1)
    scores = np.ones(len(right), np.float32)
    pairs = (
        VerifiedPair(original, duplicate, wrong, scores, np.eye(3), np.zeros(3)),
        VerifiedPair(original, third, right, scores, np.eye(3), np.zeros(3)),
    )
    changed = replace(problem, images=tuple(images), pairs=pairs)
    assert tuple(names) not in count_explained_matches(model, changed)
    evidence = describe_evidence(model, changed)["images"]
    assert [evidence[name]["explained_ratio"] for name in names] == [1.0, 1.0]


def test_evidence_of_connected_model_has_one_part(solved) -> None:
    model = solved.best
    evidence = describe_evidence(model, solved.problem)
    assert [len(part) for part in evidence["parts"]] == [len(model.images)]
    assert evidence["median_angle_deg"] > 1
    assert all(image["points"] > 0 for image in evidence["images"].values())
    assert all(image["pose_error_deg"] is None for image in evidence["images"].values())


def test_evidence_contains_predicted_pose_errors(solved) -> None:
    model = solved.result.reconstructions[0]
    images = tuple(replace(image, pose_error_deg=1.23456) for image in model.images)
    evidence = describe_evidence(replace(model, images=images), solved.problem)
    assert all(image["pose_error_deg"] == 1.235 for image in evidence["images"].values())


def test_image_without_common_points_is_a_separate_part(solved) -> None:
    model = solved.best
    *others, last = model.images
    lost = replace(last, point_ids=np.full_like(last.point_ids, -1))
    evidence = describe_evidence(replace(model, images=(*others, lost)), solved.problem)
    assert evidence["parts"][-1] == [last.name]
    assert evidence["images"][last.name]["points"] == 0
    assert evidence["images"][last.name]["explained_ratio"] == 0


def test_image_that_shares_few_points_is_a_contradicted_separate_part(solved) -> None:
    """The last image shares at most ten of its points with the other images."""
    model = solved.best
    *others, last = model.images
    rows = np.stack([np.arange(40)] * 2, axis=1)
    scores = np.ones(len(rows), np.float32)
    indices = [image.index for image in model.images]
    pairs = tuple(
        VerifiedPair(a, b, rows, scores, np.eye(3), np.zeros(3))
        for a, b in combinations(indices, 2)
    )
    problem = replace(solved.problem, pairs=pairs)
    assert describe_evidence(model, problem)["contradicted_group"] is None
    point_ids = np.where(last.point_ids >= 10, last.point_ids + len(model.points), last.point_ids)
    separate = replace(last, point_ids=point_ids)
    points = np.concatenate([model.points, model.points])
    separated = replace(model, images=(*others, separate), points=points)
    evidence = describe_evidence(separated, problem)
    assert [len(part) for part in evidence["parts"]] == [2, 1]
    assert evidence["parts"][1] == [last.name]
    assert evidence["contradicted_group"]["images"] == [last.name]
    assert evidence["contradicted_group"]["margin"] > 0
