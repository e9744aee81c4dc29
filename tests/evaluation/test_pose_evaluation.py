"""Tests of the evaluation of poses by image name."""

from __future__ import annotations

import json
from pathlib import Path

import pycolmap
import pytest

from mpsfm_core.data.errors import InputError
from mpsfm_core.evaluation.pose_evaluation import evaluate
from mpsfm_core.inputs.models import read_poses


def test_evaluate_returns_plain_data(model: pycolmap.Reconstruction, tmp_path: Path) -> None:
    model.write_text(str(tmp_path))
    truth = read_poses(tmp_path)
    names = list(truth)
    estimated = {name.rsplit(".", 1)[0] + ".jpeg": truth[name] for name in names[:4]}
    report = json.loads(json.dumps(evaluate(estimated, truth)))
    assert report["convention"] == "paper"
    assert (report["images"], report["registered"], report["pairs"]) == (5, 4, 20)
    assert report["registered_share"] == pytest.approx(0.8)
    assert report["unregistered"] == [names[4]]
    assert report["auc"] == pytest.approx({"1": 60, "5": 60, "20": 60}, abs=1e-3)
    assert report["trajectory"]["ate_rmse"] == pytest.approx(0, abs=1e-6)
    chosen = evaluate(estimated, truth, images=[names[0], names[1].rsplit(".", 1)[0]])
    assert (chosen["images"], chosen["pairs"]) == (2, 2)
    assert chosen["trajectory"] is None


def test_evaluate_unknown_image_raises(model: pycolmap.Reconstruction, tmp_path: Path) -> None:
    model.write_binary(str(tmp_path))
    truth = read_poses(tmp_path)
    with pytest.raises(InputError, match=r"no image .* name nowhere\.jpg"):
        evaluate(truth, truth, images=["nowhere.jpg"])
    with pytest.raises(InputError, match="at least two"):
        evaluate(truth, truth, images=list(truth)[:1])
