"""Tests of the sample scene: files, size, consistency and uncertainty of its priors."""

from __future__ import annotations

import importlib
import importlib.util
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import cv2
import numpy as np
import pycolmap
import pytest
import yaml

from mpsfm_core.data import DepthPrior, NormalPrior

SCENE = Path(__file__).resolve().parents[2] / "examples" / "sample_scene"
DATA_FOLDERS = ("images", "gt", "gt_depth", "gt_normals", "priors")


@pytest.fixture(scope="module")
def verify() -> ModuleType:
    spec = importlib.util.spec_from_file_location("sample_scene_verify", SCENE / "verify.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    with pytest.MonkeyPatch.context() as patch:
        # dataclasses look up annotations in sys.modules
        patch.setitem(sys.modules, spec.name, module)
        spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def views(verify: ModuleType) -> list[Any]:
    return verify.load_views(SCENE)


def test_sample_scene_is_complete_and_small() -> None:
    stems = {path.stem for path in (SCENE / "images").glob("*.jpg")}
    assert len(stems) == 8
    for folder in ("gt_depth", "gt_normals", "priors/depth", "priors/normals"):
        assert {path.stem for path in (SCENE / folder).iterdir()} == stems
    files = [p for folder in DATA_FOLDERS for p in (SCENE / folder).rglob("*") if p.is_file()]
    assert sum(p.stat().st_size for p in files) < 8e6


def test_sample_intrinsics_equal_model_and_image_size() -> None:
    model = pycolmap.Reconstruction(SCENE / "gt")
    declared = yaml.safe_load((SCENE / "intrinsics.yaml").read_text())[1]
    assert declared["images"] == "all"
    for image in model.images.values():
        camera = image.camera
        np.testing.assert_allclose(declared["params"], camera.params)
        pixels = cv2.imread(str(SCENE / "images" / image.name))
        assert pixels.shape == (camera.height, camera.width, 3)


def test_sample_depth_maps_are_consistent(verify: ModuleType, views: list[Any]) -> None:
    errors = verify.depth_errors(views)
    assert errors.size > 1e6
    assert np.median(errors) < 0.0005


def test_sample_normals_agree_with_depth(verify: ModuleType, views: list[Any]) -> None:
    step = 8  # pixels; over this distance, depth steps of a millimeter are negligible
    middle, before, after = slice(step, -step), slice(None, -2 * step), slice(2 * step, None)
    angles = []
    for view in views:
        points = verify.pixel_rays(view) * view.depth[..., None]
        right = points[middle, after] - points[middle, before]
        down = points[after, middle] - points[before, middle]
        normal = np.cross(down, right)
        normal /= np.linalg.norm(normal, axis=-1, keepdims=True).clip(1e-9)
        cosine = (normal * view.normals[middle, middle]).sum(-1)
        angles.append(np.degrees(np.arccos(cosine[view.depth[middle, middle] > 0].clip(-1, 1))))
        towards_camera = (view.normals * verify.pixel_rays(view)).sum(-1)[view.depth > 0] < 0
        assert towards_camera.mean() > 0.999
    assert np.median(np.concatenate(angles)) < 1.0


def test_sample_images_agree_with_poses(verify: ModuleType, views: list[Any]) -> None:
    sift = cv2.SIFT_create(nfeatures=3000)
    a, b = views[1], views[2]
    images = [cv2.imread(str(SCENE / "images" / v.name), cv2.IMREAD_GRAYSCALE) for v in (a, b)]
    (points_a, words_a), (points_b, words_b) = (sift.detectAndCompute(i, None) for i in images)
    pairs = cv2.BFMatcher(crossCheck=True).match(words_a, words_b)
    # In OpenCV, the center of the first pixel is (0, 0).
    x_a = np.array([points_a[m.queryIdx].pt for m in pairs]) + 0.5
    x_b = np.array([points_b[m.trainIdx].pt for m in pairs]) + 0.5
    distance = verify.epipolar_distance(a, b, x_a, x_b)
    right = distance[distance < 3]
    assert len(right) > 300
    assert np.median(right) < 0.5


def test_sample_scene_has_low_overlap(verify: ModuleType, views: list[Any]) -> None:
    two, three = verify.overlaps(views)
    count = len(views)
    for i in range(count):
        assert 0.3 < two[i, (i + 1) % count] < 0.46
        assert two[i, (i + 2) % count] < 0.05
    assert three < 0.04


def test_sample_priors_are_valid(views: list[Any]) -> None:
    for view in views:
        depth, normals = view.depth_prior, view.normal_prior
        kept = DepthPrior.from_arrays(depth["depth"], depth["variance"], depth["valid"])
        np.testing.assert_array_equal(kept.valid, depth["valid"])
        accepted = NormalPrior.from_arrays(
            normals["normals"], normals["variance"], normals["valid"]
        )
        assert accepted.valid.sum() > 0.9 * normals["valid"].sum()
        length = np.linalg.norm(normals["normals"][normals["valid"]], axis=-1)
        np.testing.assert_allclose(length, 1, atol=1e-3)


def test_sample_prior_variances_match_their_errors(verify: ModuleType, views: list[Any]) -> None:
    relative, score = map(np.concatenate, zip(*map(verify.depth_scores, views), strict=True))
    assert 0.04 < verify.rms(relative) < 0.12
    assert 0.75 < verify.rms(score) < 1.25
    angle, score = map(np.concatenate, zip(*map(verify.normal_scores, views), strict=True))
    assert 2 < np.median(angle) < 6
    assert 0.75 < verify.rms(score) < 1.25
    scales = [np.median(verify.depth_scores(view)[0]) for view in views]
    assert 0.02 < np.std(scales) < 0.1


def test_degraded_depth_is_seeded_with_calibrated_variance(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(SCENE)
    truth_of = importlib.import_module("generator.cameras").Truth
    priors = importlib.import_module("generator.priors")
    depth = np.full((60, 80), 2.0)
    depth[:, 40:] = 4.0
    truth = truth_of(depth, np.broadcast_to([0.0, 0.0, -1.0], (60, 80, 3)))

    def degrade(seed: int) -> Any:
        return priors.degrade_depth(truth, priors.PriorErrors(), np.random.default_rng(seed))

    np.testing.assert_array_equal(degrade(0).values, degrade(0).values)
    many = [degrade(seed) for seed in range(60)]
    score = np.stack([(p.values - depth) / np.sqrt(p.variance) for p in many])
    assert 0.8 < np.sqrt(np.mean(score**2)) < 1.2
    assert 0.5 < np.sqrt(np.mean(score[:, :, 38:42] ** 2)) < 1.5
