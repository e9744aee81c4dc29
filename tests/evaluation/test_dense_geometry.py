"""Tests of the evaluation of depth maps and clouds with true depth."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mpsfm_core.data import DepthPrior, Float64
from mpsfm_core.evaluation.dense_geometry import evaluate_dense_geometry
from mpsfm_core.evaluation.prior_quality import read_depth
from mpsfm_core.evaluation.records import BenchmarkRecord
from mpsfm_core.evaluation.report import build_rows
from mpsfm_core.evaluation.scene_folder import SceneFolder, read_scene
from mpsfm_core.evaluation.true_surface import build_true_surface
from mpsfm_core.mapping.scene.reconstruction import Reconstruction, RegisteredImage
from tests.evaluation.conftest import CAMERA, NAMES

CAMERAS = dict.fromkeys(NAMES, CAMERA)
SCALE = 0.25
"""Length of a meter in world units of the reconstruction."""
NO_POINTS = np.zeros(0, np.int64)


@pytest.fixture(scope="module")
def scene(scene_folder: Path) -> SceneFolder:
    return read_scene(scene_folder)


def model(scene: SceneFolder, factor: float = 1.0, images: int = len(NAMES)) -> Reconstruction:
    """Return a reconstruction with true poses in world units, and depth with a factor as error."""
    assert scene.depth is not None
    registered = []
    for index, name in enumerate(NAMES[:images]):
        rotation, translation = scene.truth[name]
        depth = read_depth(scene.depth / name) * np.float32(factor * SCALE)
        maps = DepthPrior.from_arrays(depth, (0.01 * depth) ** 2, depth > 0)
        pose = rotation, SCALE * translation
        registered.append(RegisteredImage(index, name, CAMERA, *pose, NO_POINTS, maps, SCALE))
    return Reconstruction(tuple(registered), np.zeros((0, 3)), np.zeros(0))


def cloud_of(scene: SceneFolder) -> Float64:
    assert scene.depth is not None
    return SCALE * build_true_surface(scene.depth, NAMES, CAMERAS, scene.truth, 0.01)


def test_dense_geometry_is_invariant_to_unit(scene: SceneFolder) -> None:
    found = evaluate_dense_geometry(model(scene), cloud_of(scene), scene, CAMERAS, (0.02, 0.05))
    assert found is not None
    assert found["depth"]["abs_rel"] < 1e-4 and found["depth"]["images"] == len(NAMES)
    assert found["depth"]["scale"] == pytest.approx(1 / SCALE)
    assert found["cloud"]["f1"] == {"0.02": 1.0, "0.05": 1.0}


def test_dense_geometry_measures_depth_scale_error(scene: SceneFolder) -> None:
    found = evaluate_dense_geometry(model(scene, 1.1), cloud_of(scene), scene, CAMERAS, (0.02,))
    assert found is not None and found["depth"]["abs_rel"] == pytest.approx(0.1, abs=1e-3)


def test_dense_geometry_without_truth_returns_none(scene: SceneFolder, tmp_path) -> None:
    cloud = cloud_of(scene)
    (tmp_path / "gt_depth").mkdir()
    for other in (replace(scene, path=tmp_path / "nowhere"), replace(scene, path=tmp_path)):
        assert evaluate_dense_geometry(model(scene), cloud, other, CAMERAS, (0.02,)) is None
    assert evaluate_dense_geometry(model(scene, images=2), cloud, scene, CAMERAS, (0.02,)) is None


def test_build_rows_averages_dense_sets(scene: SceneFolder) -> None:
    found = evaluate_dense_geometry(model(scene), cloud_of(scene), scene, CAMERAS, (0.02,))
    other = evaluate_dense_geometry(model(scene, 1.1), cloud_of(scene)[:1], scene, CAMERAS, (0.02,))
    records = [
        BenchmarkRecord(
            "room", "sift", "all", f"all-0{k}", "ours", "", {}, scene.truth, 0, 1, 1, dense=each
        )
        for k, each in enumerate((found, other, None))
    ]
    (row,) = build_rows(records)
    assert row.sets == 3 and row.dense is not None and row.dense["sets"] == 2
    assert row.dense["abs_rel"] == pytest.approx(0.05, abs=1e-3)
    assert row.dense["completeness"]["0.02"] == pytest.approx(0.5, abs=0.01)
    assert build_rows(records[2:])[0].dense is None
