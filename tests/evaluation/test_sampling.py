"""Tests of the sampling of test sets."""

from __future__ import annotations

import shutil
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from mpsfm_core.cli import build_app
from mpsfm_core.evaluation.overlap import Overlap, overlap_from_depth
from mpsfm_core.evaluation.sampling import (
    LIMITS,
    TRIPLETS,
    SamplingOptions,
    sample_buckets,
)
from mpsfm_core.evaluation.scene_folder import read_scene
from tests.evaluation.test_overlap import wall


@pytest.fixture(scope="module")
def overlap() -> Overlap:
    """Return the overlap of thirty cameras along a wall at irregular distances."""
    shifts = np.cumsum(np.random.default_rng(5).uniform(0.4, 1.4, 30))
    names, poses, cameras, flat = wall(*shifts)
    return overlap_from_depth(names, poses, cameras, lambda _: flat)


def test_sampled_sets_satisfy_limits(overlap: Overlap) -> None:
    buckets = sample_buckets(overlap, SamplingOptions(sets=3))
    place = {name: i for i, name in enumerate(overlap.names)}
    assert set(buckets) >= {"leq10", "leq30", "triplets", "all"}
    for bucket, limit in LIMITS.items():
        for item in buckets.get(bucket, []):
            members = [place[name] for name in item["images"]]
            assert len(members) >= 5
            worst = max(overlap.three_view(*t) for t in combinations(members, 3))
            assert worst == pytest.approx(item["max_three_view_overlap"], abs=1e-4)
            assert worst <= limit
            linked = overlap.two_view[np.ix_(members, members)] - np.eye(len(members))
            assert (linked.max(axis=1) >= 0.25).all()
            assert linked.max() == pytest.approx(item["max_two_view_overlap"], abs=1e-4)
    assert buckets["all"] == [{"images": list(overlap.names)}]


def test_sampled_sets_are_maximal(overlap: Overlap) -> None:
    place = {name: i for i, name in enumerate(overlap.names)}
    for item in sample_buckets(overlap, SamplingOptions(sets=2))["leq10"]:
        members = [place[name] for name in item["images"]]
        for other in set(range(len(overlap))) - set(members):
            fits = all(overlap.three_view(other, a, b) <= 0.10 for a, b in combinations(members, 2))
            assert not (fits and overlap.two_view[other, members].max() >= 0.25)


def test_sampled_sets_differ_and_are_deterministic(overlap: Overlap) -> None:
    options = SamplingOptions(sets=4)
    buckets = sample_buckets(overlap, options)
    assert buckets == sample_buckets(overlap, options)
    assert buckets != sample_buckets(overlap, SamplingOptions(sets=4, seed=1))
    for bucket in LIMITS:
        sets = [set(item["images"]) for item in buckets.get(bucket, [])]
        for a, b in combinations(sets, 2):
            assert max(len(a - b), len(b - a)) >= 2


def test_sampled_triplets_match_group(overlap: Overlap) -> None:
    place = {name: i for i, name in enumerate(overlap.names)}
    triplets = sample_buckets(overlap, SamplingOptions(sets=4))["triplets"]
    assert {"0", "20-40", "40+"} <= set(triplets)
    for group, sets in triplets.items():
        low, high = TRIPLETS[group]
        assert 1 <= len(sets) <= 4
        for names in sets:
            members = [place[name] for name in names]
            three = overlap.three_view(*members)
            assert (low < three <= high) or three == low == high
            links = sum(overlap.two_view[a, b] >= 0.25 for a, b in combinations(members, 2))
            assert links >= 2


def test_max_images_limits_sets(overlap: Overlap) -> None:
    buckets = sample_buckets(overlap, SamplingOptions(sets=2, max_images=6))
    assert max(len(item["images"]) for item in buckets["leq30"]) == 6


def test_build_command_writes_readable_sets(scene_folder: Path, tmp_path: Path) -> None:
    copy = tmp_path / "room"
    shutil.copytree(scene_folder, copy)
    arguments = ["testsets", "build", str(copy), "--min-images", "3"]
    refused = CliRunner().invoke(build_app(), arguments)
    assert refused.exit_code == 2 and "--replace" in refused.stderr
    result = CliRunner().invoke(build_app(), [*arguments, "--replace"])
    assert result.exit_code == 0
    assert "all: 1 set\n" in result.stdout and "triplets/" in result.stdout
    assert (copy / "testsets.yaml").read_text().startswith("# overlap from depth")
    assert {"all"} <= {item.bucket for item in read_scene(copy).sets}


def test_build_sets_model_without_points_raises(scene_folder: Path, tmp_path: Path) -> None:
    copy = tmp_path / "room"
    shutil.copytree(scene_folder, copy)
    arguments = ["testsets", "build", str(copy), "--source", "model", "--replace"]
    result = CliRunner().invoke(build_app(), arguments)
    assert result.exit_code == 2 and "no points" in result.stderr
