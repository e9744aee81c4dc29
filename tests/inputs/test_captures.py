"""Tests of phone captures that follow the documentation of each program's format."""

from __future__ import annotations

import json
import zipfile
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pycolmap
import pytest
from typer.testing import CliRunner

from mpsfm_core.cli import build_app
from mpsfm_core.data import PinholeCamera, View
from mpsfm_core.data.errors import InputError
from mpsfm_core.inputs.captures.convert import ConvertedCapture, convert_capture, find_format
from mpsfm_core.inputs.image_search import find_images
from mpsfm_core.inputs.models import read_poses
from mpsfm_core.providers.builtin.files import DepthFiles
from mpsfm_core.providers.builtin.options import DepthFileOptions
from mpsfm_core.testing.synthetic.scenes import arc_poses, room_scene

SIZE = (160, 120)
CAMERA = PinholeCamera(*SIZE, 130.0, 130.0, 80.0, 60.0)
DEPTH_SIZE = (40, 30)
POSES = arc_poses(24, 2.0)
FLIP = np.diag([1.0, -1.0, -1.0])
"""Rotation that converts camera axes between OpenCV and ARKit."""


@pytest.fixture(scope="module")
def rendered() -> list[Any]:
    """Return rendered views of a room with image and depth."""
    scene = room_scene()
    return [scene.render(CAMERA, pose) for pose in POSES]


def world_from_cam(index: int) -> np.ndarray:
    """Return the pose (3, 4) with OpenCV's camera axes."""
    rotation, translation = POSES[index][:3, :3], POSES[index][:3, 3]
    return np.column_stack([rotation.T, -rotation.T @ translation])


def arkit_pose(index: int) -> np.ndarray:
    pose = world_from_cam(index)
    return np.column_stack([pose[:, :3] @ FLIP, pose[:, 3]])


def jpeg(view: Any) -> bytes:
    return cv2.imencode(".jpg", cv2.cvtColor(view.rgb, cv2.COLOR_RGB2BGR))[1].tobytes()


def sensor_depth(view: Any) -> np.ndarray:
    return cv2.resize(view.depth.astype(np.float32), DEPTH_SIZE, interpolation=cv2.INTER_NEAREST)


def sensor_confidence(low: int, high: int) -> np.ndarray:
    """Return a map whose left column has low confidence."""
    confidence = np.full(DEPTH_SIZE[::-1], high, np.uint8)
    confidence[:, 0] = low
    return confidence


def write_png(path: Path, pixels: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), pixels)


def write_polycam(folder: Path, rendered: list[Any], prefix: str = "") -> Path:
    keyframes = folder / "keyframes"
    for index in range(3):
        stem = f"{1_650_000_000_000 + index}"
        camera = dict(zip(("fx", "fy", "cx", "cy"), CAMERA.params.tolist(), strict=True))
        camera |= {"width": SIZE[0], "height": SIZE[1], "blur_score": 100.0}
        pose = arkit_pose(index)
        camera |= {f"t_{r}{c}": float(pose[r, c]) for r in range(3) for c in range(4)}
        for kind in {"", prefix}:
            path = keyframes / f"{kind}cameras" / f"{stem}.json"
            path.parent.mkdir(parents=True, exist_ok=True)
            # The poses of ARKit drift, those of Polycam's optimization do not.
            drift = {"t_03": camera["t_03"] + 0.5} if kind != prefix else {}
            path.write_text(json.dumps(camera | drift))
            image = keyframes / f"{kind}images" / f"{stem}.jpg"
            image.parent.mkdir(exist_ok=True)
            image.write_bytes(jpeg(rendered[index]))
        millimeters = np.round(sensor_depth(rendered[index]) * 1000).astype(np.uint16)
        write_png(keyframes / "depth" / f"{stem}.png", millimeters)
        write_png(keyframes / "confidence" / f"{stem}.png", sensor_confidence(0, 255))
    return folder


def record3d_metadata(**changes: Any) -> dict[str, Any]:
    quaternions = [pycolmap.Rotation3d(arkit_pose(i)[:, :3]).quat for i in range(3)]
    return {
        "w": SIZE[0],
        "h": SIZE[1],
        "dw": DEPTH_SIZE[0],
        "dh": DEPTH_SIZE[1],
        "fps": 60,
        "K": CAMERA.matrix.T.ravel().tolist(),
        "poses": [[*q.tolist(), *arkit_pose(i)[:, 3]] for i, q in enumerate(quaternions)],
        **changes,
    }


def record3d_files(rendered: list[Any], metadata: dict[str, Any]) -> dict[str, bytes]:
    codecs = pytest.importorskip("imagecodecs")
    files = {"metadata": json.dumps(metadata).encode()}
    for index in range(3):
        depth, confidence = sensor_depth(rendered[index]), sensor_confidence(0, 2)
        files[f"rgbd/{index}.jpg"] = jpeg(rendered[index])
        files[f"rgbd/{index}.depth"] = codecs.lzfse_encode(depth.tobytes())
        files[f"rgbd/{index}.conf"] = codecs.lzfse_encode(confidence.tobytes())
    return files


def write_r3d(path: Path, files: dict[str, bytes]) -> Path:
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in files.items():
            archive.writestr(name, content)
    return path


def write_folder(path: Path, files: dict[str, bytes]) -> Path:
    for name, content in files.items():
        (path / name).parent.mkdir(parents=True, exist_ok=True)
        (path / name).write_bytes(content)
    return path


def write_stray_scanner(folder: Path, rendered: list[Any]) -> Path:
    folder.mkdir()
    video = cv2.VideoWriter(str(folder / "rgb.mp4"), cv2.VideoWriter_fourcc(*"mp4v"), 60, SIZE)
    rows = ["timestamp, frame, x, y, z, qx, qy, qz, qw"]
    for index, view in enumerate(rendered):
        video.write(cv2.cvtColor(view.rgb, cv2.COLOR_RGB2BGR))
        pose = world_from_cam(index)
        quaternion = pycolmap.Rotation3d(pose[:, :3]).quat
        values = [*pose[:, 3].tolist(), *quaternion.tolist()]
        rows.append(", ".join([f"{index / 60:.4f}", f"{index:06d}", *map(repr, values)]))
        millimeters = np.round(sensor_depth(view) * 1000).astype(np.uint16)
        write_png(folder / "depth" / f"{index:06d}.png", millimeters)
        write_png(folder / "confidence" / f"{index:06d}.png", sensor_confidence(0, 2))
    video.release()
    (folder / "odometry.csv").write_text("\n".join(rows) + "\n")
    np.savetxt(folder / "camera_matrix.csv", CAMERA.matrix, delimiter=", ")
    return folder


def check_converted(converted: ConvertedCapture, rendered: list[Any], indices: list[int]) -> None:
    """Check poses, cameras and depth of a converted capture against the rendered views."""
    model = pycolmap.Reconstruction(str(converted.poses))
    (camera,) = model.cameras.values()
    assert camera.model_name == "PINHOLE" and (camera.width, camera.height) == SIZE
    np.testing.assert_allclose(camera.params, CAMERA.params, atol=1e-5)
    poses = read_poses(converted.poses, converted.images)
    names = sorted(path.name for path in converted.images.iterdir())
    assert converted.num_images == len(names) and sorted(poses) == names
    depth_files = DepthFiles(DepthFileOptions(directory=converted.depth), None)  # type: ignore[arg-type]
    for name, index in zip(names, indices, strict=True):
        np.testing.assert_allclose(poses[name][0], POSES[index][:3, :3], atol=1e-5)
        np.testing.assert_allclose(poses[name][1], POSES[index][:3, 3], atol=1e-5)
        prior = depth_files.predict(View(name, rendered[index].rgb, CAMERA))
        true = sensor_depth(rendered[index])
        assert prior.metric and not prior.valid[:, 0].any()
        clear = np.abs(true[:, 1:] - 5) > 1e-3  # rounding to millimeters can pass the limit
        assert (prior.valid[:, 1:] == (true[:, 1:] <= 5))[clear].all()
        assert prior.valid.mean() > 0.5
        np.testing.assert_allclose(prior.depth[prior.valid], true[prior.valid], atol=6e-4)
        std = np.sqrt(prior.variance[prior.valid])
        np.testing.assert_allclose(std, np.maximum(0.01 * true[prior.valid], 0.015), rtol=1e-2)


@pytest.mark.parametrize("prefix", ["", "corrected_"])
def test_polycam_capture_gives_poses_cameras_and_depth(
    tmp_path: Path, rendered: list[Any], prefix: str
) -> None:
    capture = write_polycam(tmp_path / "capture", rendered, prefix)
    converted = convert_capture(capture, tmp_path / "out")
    assert converted.program == "Polycam"
    check_converted(converted, rendered, [0, 1, 2])


@pytest.mark.parametrize("form", ["file", "folder", "without sizes of depth", "own intrinsics"])
def test_record3d_capture_gives_poses_cameras_and_depth(
    tmp_path: Path, rendered: list[Any], form: str
) -> None:
    metadata = record3d_metadata()
    if form == "without sizes of depth":
        del metadata["dw"], metadata["dh"]
    if form == "own intrinsics":
        metadata["perFrameIntrinsicCoeffs"] = [CAMERA.params.tolist()] * 3
        metadata["K"] = np.eye(3).ravel().tolist()
    files = record3d_files(rendered, metadata)
    write = write_folder if form == "folder" else write_r3d
    converted = convert_capture(write(tmp_path / "capture.r3d", files), tmp_path / "out")
    assert converted.program == "Record3D"
    check_converted(converted, rendered, [0, 1, 2])


def test_stray_scanner_capture_gives_selected_frames(tmp_path: Path, rendered: list[Any]) -> None:
    capture = write_stray_scanner(tmp_path / "capture", rendered)
    converted = convert_capture(capture, tmp_path / "out")
    assert converted.program == "Stray Scanner" and 3 <= converted.num_images < len(rendered)
    names = sorted(path.stem for path in converted.images.iterdir())
    check_converted(converted, rendered, [int(name) for name in names])


def test_capture_without_depth_gives_images_and_poses(tmp_path: Path, rendered: list[Any]) -> None:
    files = record3d_files(rendered, record3d_metadata())
    files = {name: data for name, data in files.items() if not name.endswith((".depth", ".conf"))}
    converted = convert_capture(write_r3d(tmp_path / "a.r3d", files), tmp_path / "out")
    assert converted.depth is None and converted.num_images == 3


def test_capture_without_confidence_has_larger_std(tmp_path: Path, rendered: list[Any]) -> None:
    capture = write_polycam(tmp_path / "capture", rendered)
    for path in (capture / "keyframes" / "confidence").iterdir():
        path.unlink()
    converted = convert_capture(capture, tmp_path / "out")
    assert converted.depth is not None
    with np.load(sorted(converted.depth.iterdir())[0]) as maps:
        valid, depth = maps["valid"], maps["depth"]
        assert valid[:, 0].any()
        std = np.sqrt(maps["variance"][valid])
        np.testing.assert_allclose(std, np.maximum(0.03 * depth[valid], 0.015), rtol=1e-4)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"poses": [[0, 0, 0, 1, 0, 0, 0]] * 3}, "only videos of the LiDAR camera have poses"),
        ({"poses": [[0, 0, 0, 2, 0, 0, 1]] * 3}, "length 2 instead of 1"),
        ({"w": 80, "h": 60}, "has 160x120 pixels, but its camera is for 80x60"),
        ({"K": [0.0] * 9}, "focal length"),
        ({"K": "lost"}, "metadata cannot be read"),
        ({"dw": 41}, "has 1200 values, not 41 x 30"),
    ],
)
def test_wrong_record3d_metadata_is_one_error(
    tmp_path: Path, rendered: list[Any], changes: dict[str, Any], message: str
) -> None:
    files = record3d_files(rendered, record3d_metadata(**changes))
    with pytest.raises(InputError, match=message):
        convert_capture(write_r3d(tmp_path / "a.r3d", files), tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("name", ["t_00", "fx", "width"])
def test_polycam_camera_without_a_value_is_one_error(
    tmp_path: Path, rendered: list[Any], name: str
) -> None:
    capture = write_polycam(tmp_path / "capture", rendered)
    camera = sorted((capture / "keyframes" / "cameras").iterdir())[0]
    values = json.loads(camera.read_text())
    del values[name]
    camera.write_text(json.dumps(values))
    with pytest.raises(InputError, match=f"{camera.name}.*{name}"):
        convert_capture(capture, tmp_path / "out")


def test_other_files_are_no_captures(tmp_path: Path) -> None:
    (tmp_path / "a.r3d").write_bytes(b"PK\x03\x04 damaged")
    with pytest.raises(InputError, match="damaged"):
        convert_capture(tmp_path / "a.r3d", tmp_path / "out")
    assert find_format(tmp_path) is None
    with pytest.raises(InputError, match="not a capture of Polycam, Record3D, Stray Scanner"):
        convert_capture(tmp_path, tmp_path / "out")


@pytest.mark.slow
def test_import_command_prints_a_command_that_reconstructs(
    tmp_path: Path, rendered: list[Any]
) -> None:
    capture = write_polycam(tmp_path / "capture", rendered)
    output = tmp_path / "out"
    done = CliRunner().invoke(build_app(), ["import", str(capture), "--output", str(output)])
    assert done.exit_code == 0, done.output
    first, command = done.output.splitlines()
    assert first == f"3 images, poses and depth maps of Polycam, written to {output}"
    arguments = command.removeprefix("next: mpsfm ").replace("RESULT", str(tmp_path / "result"))
    arguments = arguments.replace("sensor-depth", "sift") + " --set depth.use=files"
    ended = CliRunner().invoke(build_app(), [*arguments.split(), "--quiet"])
    assert ended.exit_code == 0, ended.output
    found, true = read_poses(tmp_path / "result"), read_poses(output / "poses")
    assert sorted(found) == sorted(true)
    centers = [np.array([-R.T @ t for R, t in map(p.get, sorted(p))]) for p in (found, true)]  # type: ignore[misc]
    baselines = [np.linalg.norm(c[2] - c[0]) for c in centers]
    assert baselines[0] == pytest.approx(baselines[1], rel=0.1)


def test_reconstruct_of_a_capture_names_the_import_command(
    tmp_path: Path, rendered: list[Any]
) -> None:
    capture = write_polycam(tmp_path / "capture", rendered)
    with pytest.raises(InputError, match="of Polycam; convert the capture first: mpsfm"):
        find_images(capture)
