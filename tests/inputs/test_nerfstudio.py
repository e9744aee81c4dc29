"""Tests of reading and writing ``transforms.json``, and of errors in the file."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest

from mpsfm_core.data.errors import InputError
from mpsfm_core.inputs.intrinsics import read_intrinsics
from mpsfm_core.inputs.models import read_poses
from mpsfm_core.inputs.nerfstudio import read_transforms
from mpsfm_core.results.transforms_json import write_transforms

FRAME: dict[str, Any] = {
    "file_path": "images/a.png",
    "transform_matrix": np.eye(4).tolist(),
    **{"w": 64, "h": 48, "fl_x": 60.0, "fl_y": 61.0, "cx": 32.5, "cy": 24.5},
}


def write(path: Path, *frames: Any, **shared: Any) -> Path:
    file = path / "transforms.json"
    file.write_text(json.dumps({**shared, "frames": list(frames)}))
    return file


def camera_of(path: Path, frame: dict[str, Any], **shared: Any) -> pycolmap.Camera:
    (camera,) = read_transforms(write(path, frame, **shared)).cameras.values()
    return camera


@pytest.mark.parametrize(
    ("model", "params", "becomes"),
    [
        ("SIMPLE_PINHOLE", [600, 320, 240], "PINHOLE"),
        ("PINHOLE", [600, 610, 320, 240], "PINHOLE"),
        ("SIMPLE_RADIAL", [600, 320, 240, 0.1], "OPENCV"),
        ("RADIAL", [600, 320, 240, 0.1, 0.01], "OPENCV"),
        ("OPENCV", [600, 610, 320, 240, 0.1, 0.01, 1e-3, 2e-3], "OPENCV"),
        ("OPENCV_FISHEYE", [600, 610, 320, 240, 0.1, 0.01, 1e-3, 2e-3], "OPENCV_FISHEYE"),
    ],
)
def test_written_transforms_are_read_as_the_same_model(
    tmp_path: Path, model: str, params: list[float], becomes: str
) -> None:
    pycolmap.set_random_seed(1)
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_cameras_per_rig, options.num_frames_per_rig = 2, 1, 3
    options.num_points3D = 20
    options.camera_width, options.camera_height = 640, 480
    options.camera_model_id = getattr(pycolmap.CameraModelId, model)
    options.camera_params = params
    original = pycolmap.synthesize_dataset(options)
    names = {image.name: f"./photos/{image.name}" for image in original.images.values()}
    write_transforms(tmp_path / "transforms.json", original, names)
    found = read_transforms(tmp_path / "transforms.json")
    by_name = {image.name: image for image in found.images.values()}
    assert len(by_name) == 6
    for image in original.images.values():
        again = by_name[f"photos/{image.name}"]
        expected, pose = image.cam_from_world().matrix(), again.cam_from_world().matrix()
        np.testing.assert_allclose(pose, expected, atol=1e-9)
        assert again.camera.model_name == becomes
        rays = np.array([[0.0, 0.0, 1.0], [0.3, -0.2, 1.0], [-0.1, 0.25, 1.0]])
        np.testing.assert_allclose(
            again.camera.img_from_cam(rays), image.camera.img_from_cam(rays), atol=1e-9
        )


def test_cameras_look_along_minus_z_with_y_up(tmp_path: Path) -> None:
    pose = np.eye(4)
    pose[:3, 3] = 1.0, 2.0, 3.0
    (found,) = read_transforms(
        write(tmp_path, {**FRAME, "transform_matrix": pose.tolist()})
    ).images.values()
    cam_from_world = found.cam_from_world()
    np.testing.assert_allclose(found.projection_center(), [1, 2, 3])
    np.testing.assert_allclose(cam_from_world * np.array([1.0, 2.0, 2.0]), [0, 0, 1], atol=1e-12)
    np.testing.assert_allclose(cam_from_world * np.array([1.0, 2.5, 2.0]), [0, -0.5, 1], atol=1e-12)


def test_intrinsics_outside_the_frames_are_used_for_all_frames(tmp_path: Path) -> None:
    shared = {key: FRAME[key] for key in FRAME if key not in ("file_path", "transform_matrix")}
    frames = [{k: v for k, v in FRAME.items() if k not in shared} for _ in range(2)]
    frames[1] |= {"file_path": "images/b.png", "fl_x": 80.0}
    model = read_transforms(write(tmp_path, *frames, **shared))
    focals = {image.name: image.camera.params[0] for image in model.images.values()}
    assert focals == {"images/a.png": 60.0, "images/b.png": 80.0}


def test_intrinsics_from_angle_of_view_and_image_size(tmp_path: Path, write_image, photo) -> None:
    write_image("r_0.png")
    frame = {"file_path": "./images/r_0", "transform_matrix": FRAME["transform_matrix"]}
    height, width = photo.shape[:2]
    camera = camera_of(tmp_path, frame, camera_angle_x=math.radians(60))
    assert (camera.width, camera.height) == (width, height)
    focal = width / 2 / math.tan(math.radians(30))
    np.testing.assert_allclose(camera.params, [focal, focal, width / 2, height / 2])
    (tmp_path / "images" / "r_0.png").unlink()
    with pytest.raises(InputError, match=r"frame 1 \(images/r_0\): 'w' and 'h' are missing"):
        camera_of(tmp_path, frame, camera_angle_x=1.0)


def test_a_third_radial_coefficient_is_kept(tmp_path: Path) -> None:
    camera = camera_of(tmp_path, FRAME, k1=0.1, k2=0.02, k3=0.003, p1=1e-3, p2=2e-3)
    assert camera.model_name == "FULL_OPENCV"
    assert camera.params.tolist()[4:] == [0.1, 0.02, 1e-3, 2e-3, 0.003, 0, 0, 0]


def test_rotations_with_few_digits_are_accepted(tmp_path: Path) -> None:
    turned = np.eye(4)
    turned[:2, :2] = [[0.8661, -0.5], [0.5, 0.866]]
    (found,) = read_transforms(
        write(tmp_path, {**FRAME, "transform_matrix": turned.tolist()})
    ).images.values()
    rotation = found.cam_from_world().rotation.matrix()
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)


@pytest.mark.parametrize(
    ("change", "hint"),
    [
        ({"file_path": None}, "has no 'file_path'"),
        ({"transform_matrix": [[1, 0], [0, 1]]}, "4 rows of 4 numbers"),
        ({"transform_matrix": [[1, 0], [0]]}, "4 rows of 4 numbers"),
        ({"transform_matrix": (2 * np.eye(4)).tolist()}, "is not a rotation"),
        ({"transform_matrix": np.diag([1.0, 1, -1, 1]).tolist()}, "is not a rotation"),
        ({"fl_x": None}, "no focal length"),
        ({"fl_x": "wide"}, "'fl_x' must be a number, but is 'wide'"),
        ({"camera_model": "EQUIRECTANGULAR"}, "camera model EQUIRECTANGULAR is not supported"),
        ({"k4": 0.1}, "k4 is not supported"),
    ],
)
def test_wrong_frames_are_named(tmp_path: Path, change: dict[str, Any], hint: str) -> None:
    right = {**FRAME, "file_path": "images/b.png"}
    with pytest.raises(InputError, match=rf"transforms\.json, frame 2.*{hint}"):
        read_transforms(write(tmp_path, right, {**FRAME, **change}))


@pytest.mark.parametrize("text", ["{", "[]", "{}", '{"frames": []}', '{"frames": 3}'])
def test_file_of_another_format_raises(tmp_path: Path, text: str) -> None:
    (tmp_path / "transforms.json").write_text(text)
    with pytest.raises(InputError, match=r"transforms\.json"):
        read_poses(tmp_path / "transforms.json")


def test_two_frames_of_one_image_raise(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="the same file_path"):
        read_transforms(write(tmp_path, FRAME, {**FRAME, "file_path": "./images/a.png"}))


def test_photos_are_found_below_other_folders(tmp_path: Path) -> None:
    file = write(tmp_path, FRAME, {**FRAME, "file_path": "images/b.png", "fl_x": 80.0})
    cameras = read_intrinsics(file).for_images(["b.png", "a.jpg"])
    assert cameras.camera("b.png", (64, 48)).params[0] == 80.0
    assert cameras.camera("a.jpg", (64, 48)).params[0] == 60.0
    with pytest.raises(InputError, match="no camera for image 'c"):
        cameras.camera("c.png", (64, 48))
