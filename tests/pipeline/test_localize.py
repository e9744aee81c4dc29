"""Tests of localization of photos in the true model of the sample scene."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pycolmap
import pytest
from typer.testing import CliRunner

import mpsfm_core
from mpsfm_core import InputError
from mpsfm_core.cli import build_app
from mpsfm_core.data.decisions import DoubtReason, ImageReason
from mpsfm_core.geometry import camera_center, rotation_angle_deg
from mpsfm_core.geometry.pycolmap_conversion import pose_from
from mpsfm_core.inputs.models import reconstruction_poses
from mpsfm_core.report.reasons import explain
from mpsfm_core.results.exports.source import ExportSource
from mpsfm_core.results.localization import find_pose_doubts

SAMPLE = Path(__file__).parents[2] / "examples" / "sample_scene"
MODEL_NAMES = ("view_0.jpg", "view_1.jpg", "view_3.jpg")
QUERY = "view_2.jpg"
SETTINGS = (
    *("extraction.integration_size=96", "normals.use=from-depth", "depth.use=files"),
    *(f"depth.options.directory={SAMPLE / 'priors' / 'depth'}", "runtime.workers=1"),
    *("features.options.max_keypoints=1000", "adjustment.enabled=false"),
)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with ``model``, and ``photos`` with a query and a photo of noise."""
    folder = tmp_path_factory.mktemp("localize")
    model = pycolmap.Reconstruction(str(SAMPLE / "gt"))
    for image in list(model.images.values()):
        if str(image.name) not in MODEL_NAMES:
            model.deregister_frame(image.frame_id)
    (folder / "model").mkdir()
    model.write(str(folder / "model"))
    (folder / "photos").mkdir()
    shutil.copy(SAMPLE / "images" / QUERY, folder / "photos")
    noise = np.random.default_rng(0).integers(0, 255, (480, 640), dtype=np.uint8)
    cv2.imwrite(str(folder / "photos" / "view_5.jpg"), cv2.blur(noise, (5, 5)))
    return folder


@pytest.fixture(scope="module")
def arguments(folder: Path) -> dict[str, Any]:
    """Return the arguments of ``localize`` that all calls share."""
    return {
        "config": "demo",
        "images": SAMPLE / "images",
        "intrinsics": SAMPLE / "intrinsics.yaml",
        "overrides": [*SETTINGS, f"runtime.cache_dir={folder / 'cache'}"],
    }


@pytest.fixture(scope="module")
def result(folder: Path, arguments: dict[str, Any]) -> mpsfm_core.LocalizationResult:
    return mpsfm_core.localize(
        folder / "model", folder / "photos", folder / "out", extend=True, **arguments
    )


def test_localized_photo_has_the_true_pose(result: mpsfm_core.LocalizationResult) -> None:
    true_pose = reconstruction_poses(pycolmap.Reconstruction(str(SAMPLE / "gt")))[QUERY]
    photo = result.photos[QUERY]
    assert rotation_angle_deg(photo.pose[0] @ true_pose[0].T) < 0.3
    assert np.linalg.norm(photo.center - camera_center(*true_pose)) < 0.05
    assert photo.num_inliers > 30 and set(photo.matches) <= set(MODEL_NAMES)
    assert 0 < np.sqrt(np.trace(photo.center_covariance)) < 0.1


def test_photo_of_another_place_gets_a_reason(result: mpsfm_core.LocalizationResult) -> None:
    assert list(result.reasons) == ["view_5.jpg"]
    assert result.reasons["view_5.jpg"].code in ImageReason


def test_focal_length_from_one_image_makes_the_pose_doubtful(
    result: mpsfm_core.LocalizationResult,
) -> None:
    (doubt,) = find_pose_doubts(["a.jpg"], focal_known=False)
    assert doubt.code is DoubtReason.FOCAL_LENGTH_FROM_ONE_IMAGE
    assert "a.jpg" in explain(doubt).text and "--intrinsics" in explain(doubt).remedy
    assert not find_pose_doubts(["a.jpg"], focal_known=True)
    assert not find_pose_doubts(["a.jpg", "b.jpg"], focal_known=False)
    assert not result.photos[QUERY].doubts


def test_contradicting_depth_makes_the_pose_doubtful() -> None:
    (doubt,) = find_pose_doubts(["a.jpg", "b.jpg"], ("a.jpg", 0.14), focal_known=True)
    assert doubt.code is DoubtReason.DEPTH_CONTRADICTS_MODEL
    assert "14%" in explain(doubt).text and "a.jpg" in explain(doubt).text


def test_written_files_have_the_poses(folder: Path, result: mpsfm_core.LocalizationResult) -> None:
    pose = result.photos[QUERY].pose
    name, *numbers = (folder / "out" / "poses.txt").read_text().split()
    w, x, y, z, *translation = map(float, numbers)
    assert name == QUERY
    np.testing.assert_allclose(pycolmap.Rotation3d([x, y, z, w]).matrix(), pose[0], atol=1e-12)
    np.testing.assert_allclose(translation, pose[1])
    report = json.loads((folder / "out" / "localization.json").read_text())
    assert np.shape(report["localized"][QUERY]["covariance"]) == (6, 6)
    assert report["unlocalized"]["view_5.jpg"]["text"]
    model = pycolmap.Reconstruction(str(folder / "out" / "sparse"))
    (image,) = model.images.values()
    np.testing.assert_allclose(pose_from("", image.cam_from_world())[1], pose[1])


def test_extended_model_keeps_the_model_and_adds_the_photo(
    folder: Path, result: mpsfm_core.LocalizationResult
) -> None:
    extended = ExportSource.read(folder / "out" / "extended", SAMPLE / "images")
    assert extended.names == sorted([*MODEL_NAMES, QUERY])
    before = reconstruction_poses(pycolmap.Reconstruction(str(folder / "model")))
    after = reconstruction_poses(extended.model)
    assert all(np.array_equal(before[name][1], after[name][1]) for name in before)


def test_second_call_reads_the_database_and_gives_the_same_pose(
    folder: Path, arguments: dict[str, Any], result: mpsfm_core.LocalizationResult
) -> None:
    database = folder / "model" / "localization.npz"
    written = database.stat().st_mtime_ns
    events: list[Any] = []
    again = mpsfm_core.localize(
        folder / "model", folder / "photos" / QUERY, **arguments, on_event=events.append
    )
    assert database.stat().st_mtime_ns == written
    assert "mapping" not in {getattr(event, "stage", "") for event in events}
    for first, second in zip(again.photos[QUERY].pose, result.photos[QUERY].pose, strict=True):
        assert np.array_equal(first, second)


def test_extension_by_a_photo_with_the_name_of_an_image_is_refused(
    folder: Path, arguments: dict[str, Any], result: mpsfm_core.LocalizationResult
) -> None:
    photo = SAMPLE / "images" / MODEL_NAMES[0]
    with pytest.raises(InputError, match="already has an image 'view_0"):
        mpsfm_core.localize(folder / "model", photo, extend=True, **arguments)


def test_command_lists_photos_without_pose(
    folder: Path, arguments: dict[str, Any], result: mpsfm_core.LocalizationResult
) -> None:
    options = [f"--{name}={arguments[name]}" for name in ("config", "images", "intrinsics")]
    options += [part for text in arguments["overrides"] for part in ("--set", text)]
    paths = [str(folder / name) for name in ("model", "photos")]
    ended = CliRunner().invoke(
        build_app(), ["localize", *paths, "-o", str(folder / "again"), *options]
    )
    assert ended.exit_code == 0, ended.output
    assert "not localized: view_5.jpg: " in ended.output
    assert "1 of 2 photos localized" in ended.output


def test_model_without_its_images_names_the_option(folder: Path, tmp_path: Path) -> None:
    shutil.copytree(folder / "model", tmp_path / "moved")
    with pytest.raises(InputError, match="give it with --images"):
        mpsfm_core.localize(tmp_path / "moved", folder / "photos", config="demo")
