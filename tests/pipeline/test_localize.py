"""Tests of localization of photos in the true model of the sample scene."""

from __future__ import annotations

import json
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pycolmap
import pytest
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

import mpsfm_core
from mpsfm_core import InputError
from mpsfm_core.cli import build_app
from mpsfm_core.data import Float64
from mpsfm_core.data.decisions import DoubtReason, ImageReason
from mpsfm_core.geometry import camera_center, compose, invert, rotation_angle_deg
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


def test_photos_of_an_unknown_camera_share_the_refined_focal_length(
    folder: Path, arguments: dict[str, Any], tmp_path: Path
) -> None:
    names = (QUERY, "view_4.jpg")
    for name in names:
        shutil.copy(SAMPLE / "images" / name, tmp_path)
    unknown = {key: value for key, value in arguments.items() if key != "intrinsics"}
    result = mpsfm_core.localize(folder / "model", tmp_path, **unknown)
    assert set(result.photos) == set(names)
    (focal_px,) = {photo.camera.params[0] for photo in result.photos.values()}
    (true_camera,) = pycolmap.Reconstruction(str(SAMPLE / "gt")).cameras.values()
    assert focal_px == pytest.approx(true_camera.mean_focal_length(), rel=0.03)


def test_photos_of_a_rig_share_the_pose_of_their_frame(
    folder: Path, arguments: dict[str, Any], tmp_path: Path
) -> None:
    """The second photo of the frame shows nothing."""
    names = QUERY, "view_4.jpg"
    shutil.copy(SAMPLE / "images" / names[0], tmp_path)
    cv2.imwrite(str(tmp_path / names[1]), np.full((480, 640), 128, np.uint8))
    truth = reconstruction_poses(pycolmap.Reconstruction(str(SAMPLE / "gt")))
    relative = compose(truth[names[1]], invert(*truth[names[0]]))
    rig = mpsfm_core.Rig(((np.eye(3), np.zeros(3)), relative), (names,))
    result = mpsfm_core.localize(folder / "model", tmp_path, rigs=[rig], **arguments)
    assert not result.reasons and result.photos[names[1]].num_inliers == 0
    for name in names:
        error = result.photos[name].center - camera_center(*truth[name])
        assert np.linalg.norm(error) < 0.1


def test_rig_with_an_unknown_relative_pose_is_refused(
    folder: Path, arguments: dict[str, Any]
) -> None:
    rig = mpsfm_core.Rig(((np.eye(3), np.zeros(3)), None), ((QUERY, "view_5.jpg"),))
    with pytest.raises(InputError, match="sensor_from_rig"):
        mpsfm_core.localize(folder / "model", folder / "photos", rigs=[rig], **arguments)


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


def turn(angle_deg: float) -> Float64:
    """Return the rotation of a camera about its vertical axis."""
    return Rotation.from_euler("y", angle_deg, degrees=True).as_matrix()


def write_turning_camera(folder: Path, angles_deg: Sequence[float]) -> Path:
    """Write a video of the camera of the query that turns, and the depth of its frames."""
    image = cv2.imread(str(SAMPLE / "images" / QUERY))
    depth = np.load(SAMPLE / "priors" / "depth" / QUERY.replace("jpg", "npz"))["depth"]
    calibration = np.array([[540.0, 0, 320], [0, 540, 240], [0, 0, 1]])
    small = np.diag([0.5, 0.5, 1]) @ calibration
    writer = cv2.VideoWriter(
        str(folder / "turn.avi"), cv2.VideoWriter_fourcc(*"MJPG"), 10, (640, 480)
    )
    for number, angle_deg in enumerate(angles_deg):
        rotation = turn(angle_deg)
        homography = calibration @ rotation @ np.linalg.inv(calibration)
        writer.write(cv2.warpPerspective(image, homography, (640, 480)))
        homography = small @ rotation @ np.linalg.inv(small)
        warped = cv2.warpPerspective(
            depth.astype(np.float32), homography, (320, 240), flags=cv2.INTER_NEAREST
        )
        # the depth of a pixel is the z coordinate in the turned camera
        xy = np.stack(
            [*np.meshgrid(np.arange(320) + 0.5, np.arange(240) + 0.5), np.ones_like(warped)]
        )
        before = np.tensordot(rotation.T @ np.linalg.inv(small), xy, 1)[2]
        warped = np.where(before > 0, warped / before, 0).astype(np.float32)
        valid = warped > 0
        np.savez(
            folder / f"frame_{number:06d}.npz",
            depth=warped,
            variance=(0.05 * warped) ** 2,
            valid=valid,
        )
    writer.release()
    return folder / "turn.avi"


def test_frames_of_a_video_get_their_true_poses(
    folder: Path, arguments: dict[str, Any], tmp_path: Path
) -> None:
    angles_deg = np.linspace(-4, 4, 9)
    video = write_turning_camera(tmp_path, angles_deg)
    for file in (SAMPLE / "priors" / "depth").iterdir():
        shutil.copy(file, tmp_path)
    settings = [f"depth.options.directory={tmp_path}", "inputs.video.motion=0.04"]
    overrides = {"overrides": [*arguments["overrides"], *settings]}
    database = tmp_path / "localization.npz"
    with pytest.raises(InputError, match="need an output folder"):
        mpsfm_core.localize(folder / "model", video, **{**arguments, **overrides})
    result = mpsfm_core.localize(
        folder / "model", video, tmp_path / "out", database=database, **{**arguments, **overrides}
    )
    assert 2 <= len(result.photos) < len(angles_deg) and not result.reasons
    pose = reconstruction_poses(pycolmap.Reconstruction(str(SAMPLE / "gt")))[QUERY]
    assert len(result.frames) == len(angles_deg)
    for frame, angle_deg in zip(result.frames, angles_deg, strict=True):
        assert frame.pose is not None and frame.source in ("keyframe", "tracked")
        assert rotation_angle_deg(frame.pose[0] @ (turn(angle_deg) @ pose[0]).T) < 0.5
        assert np.linalg.norm(camera_center(*frame.pose) - camera_center(*pose)) < 0.08
    assert len((tmp_path / "out" / "trajectory.txt").read_text().splitlines()) == 10


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
