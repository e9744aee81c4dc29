"""``mpsfm demo`` and the sample scene's promise: low overlap, and yet the right poses."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from mpsfm_core.evaluation import evaluate, read_poses

SCENE = Path(__file__).resolve().parents[2] / "examples" / "sample_scene"


def test_the_demo_finds_the_poses_and_says_what_to_open(mpsfm, tmp_path: Path) -> None:
    output = tmp_path / "demo"
    ended = mpsfm("demo", "--output", output)
    assert ended.code == 0, ended.err
    for text in ("8 of 8 images", "(paper convention)", "median error", "dense.ply", "sparse"):
        assert text in ended.out
    report = evaluate(read_poses(output), read_poses(SCENE / "gt"))
    assert report["auc"]["5"] > 80
    assert report["trajectory"]["rotation_median_deg"] < 0.5
    assert report["trajectory"]["ate_median"] < 0.05
    # The priors' scales spread by 4 %; their consensus is the metre of the model.
    assert report["trajectory"]["scale"] == pytest.approx(1, abs=0.08)


def test_a_scene_of_the_same_layout_can_be_given(mpsfm, tmp_path: Path) -> None:
    ended = mpsfm("demo", "--output", tmp_path / "out", "--scene", tmp_path, "--quiet")
    assert ended.code == 2
    assert str(tmp_path / "images") in ended.err
    assert not (tmp_path / "out").exists()


def test_without_priors_it_falls_apart(mpsfm, tmp_path: Path) -> None:
    """What makes the scene a demo: without lifting hardly anything can be registered."""
    output = tmp_path / "demo"
    ended = mpsfm("demo", "--output", output, "--set", "mapping.registration.lifting=false")
    assert ended.code in (0, 3), ended.err
    registered = json.loads((output / "summary.json").read_text())["images"]["registered"]
    assert len(registered) <= 3
