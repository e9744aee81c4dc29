"""Rig input: Tests of reading rigs from COLMAP's rig_config.json, models and databases."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest

from mpsfm_core.data.errors import InputError
from mpsfm_core.inputs.rigs import read_rigs

NAMES = ["left/1.jpg", "left/2.jpg", "right/1.png", "other/1.jpg"]
QUATERNION = [0.8, 0.0, 0.0, 0.6]
LEFT = {"image_prefix": "left/", "ref_sensor": True}
RIGHT = {
    "image_prefix": "right/",
    "cam_from_rig_rotation": QUATERNION,
    "cam_from_rig_translation": [1, 2, 3],
}


def write_config(folder: Path, cameras: Any) -> Path:
    path = folder / "rig_config.json"
    path.write_text(json.dumps([{"cameras": cameras}]))
    return path


def test_rig_config_gives_frames_of_equal_names_as_pycolmap_reads_poses(tmp_path: Path) -> None:
    path = write_config(tmp_path, [LEFT, RIGHT])
    (rig,) = read_rigs(path, NAMES, tmp_path)
    assert rig.frames == (("left/1.jpg", "right/1.png"), ("left/2.jpg", None))
    (theirs,) = pycolmap.read_rig_config(path)
    expected = theirs.cameras[1].cam_from_rig
    np.testing.assert_allclose(rig.sensor_from_rig[1][0], expected.rotation.matrix(), atol=1e-12)
    np.testing.assert_allclose(rig.sensor_from_rig[1][1], expected.translation)


@pytest.mark.parametrize(
    ("cameras", "message"),
    [
        ([LEFT], "at least two cameras"),
        ([LEFT, {**RIGHT, "cam_from_rig_translation": None}], "is missing"),
        ([LEFT, {**RIGHT, "cam_from_rig_rotation": [0, 0, 0, 0]}], "quaternion"),
        ([LEFT, {**RIGHT, "cam_from_rig_translation": "far"}], "three numbers"),
        ([LEFT, {**RIGHT, "image_prefix": "l"}], "two of the image_prefixes"),
        ([LEFT, {**RIGHT, "image_prefix": ""}], "needs an 'image_prefix'"),
        ([LEFT, {**RIGHT, "image_prefix": "back/"}], "no frame has two images"),
    ],
)
def test_rig_config_that_does_not_fit_is_one_clear_error(
    tmp_path: Path, cameras: Any, message: str
) -> None:
    path = write_config(tmp_path, cameras)
    with pytest.raises(InputError, match=message) as error:
        read_rigs(path, NAMES, tmp_path)
    assert str(path) in str(error.value)


def test_rig_config_that_is_no_json_is_an_error(tmp_path: Path) -> None:
    path = tmp_path / "rig_config.json"
    path.write_text("[{")
    with pytest.raises(InputError, match="cannot be read as JSON"):
        read_rigs(path, NAMES, tmp_path)


def write_database(path: Path, pose: pycolmap.Rigid3d | None) -> None:
    """Write a COLMAP database with one rig of two cameras and one frame."""
    database = pycolmap.Database.open(path)
    camera = pycolmap.Camera(model="PINHOLE", width=10, height=10, params=[10, 10, 5, 5])
    sensors = [
        pycolmap.sensor_t(pycolmap.SensorType.CAMERA, database.write_camera(camera))
        for _ in range(2)
    ]
    rig = pycolmap.Rig()
    rig.add_ref_sensor(sensors[0])
    rig.add_sensor(sensors[1], pose)
    frame = pycolmap.Frame(rig_id=database.write_rig(rig))
    for name, sensor in zip(("left/1.jpg", "right/1.png"), sensors, strict=True):
        image = database.write_image(pycolmap.Image(name=name, camera_id=sensor.id))
        frame.add_data_id(pycolmap.data_t(sensor, image))
    database.write_frame(frame)
    database.close()


def test_database_with_rig(tmp_path: Path) -> None:
    path = tmp_path / "database.db"
    pose = pycolmap.Rigid3d(pycolmap.Rotation3d([0.0, 0.0, 0.6, 0.8]), [1, 2, 3])
    write_database(path, pose)
    (rig,) = read_rigs(path, NAMES, tmp_path)
    assert rig.frames == (("left/1.jpg", "right/1.png"),)
    np.testing.assert_allclose(np.column_stack(rig.sensor_from_rig[1]), pose.matrix(), atol=1e-12)


def test_unknown_relative_pose_is_none(tmp_path: Path) -> None:
    path = tmp_path / "database.db"
    write_database(path, None)
    (from_database,) = read_rigs(path, NAMES, tmp_path)
    config = write_config(tmp_path, [LEFT, {"image_prefix": "right/"}])
    (from_config,) = read_rigs(config, NAMES, tmp_path)
    for rig in (from_database, from_config):
        assert rig.sensor_from_rig[0] is not None
        assert rig.sensor_from_rig[1] is None
        assert not rig.is_calibrated


def test_folders_are_the_cameras_of_a_rig(tmp_path: Path) -> None:
    (rig,) = read_rigs(Path("folders"), NAMES, tmp_path)
    assert rig.sensor_from_rig == (None, None, None)
    assert rig.frames == (("left/1.jpg", "other/1.jpg", "right/1.png"), ("left/2.jpg", None, None))
    with pytest.raises(InputError, match="at least two folders"):
        read_rigs(Path("folders"), ["left/1.jpg", "left/2.jpg"], tmp_path)
    with pytest.raises(InputError, match="no frame has two images"):
        read_rigs(Path("folders"), ["left/1.jpg", "right/2.jpg"], tmp_path)


def write_model(path: Path) -> pycolmap.Rigid3d:
    """Write a COLMAP model with one rig of two cameras and one frame."""
    model, rig = pycolmap.Reconstruction(), pycolmap.Rig(rig_id=1)
    pose = pycolmap.Rigid3d(pycolmap.Rotation3d([0.0, 0.0, 0.6, 0.8]), [1, 2, 3])
    for camera_id in (1, 2):
        model.add_camera(
            pycolmap.Camera(
                camera_id=camera_id, model="PINHOLE", width=10, height=10, params=[10, 10, 5, 5]
            )
        )
    rig.add_ref_sensor(model.cameras[1].sensor_id)
    rig.add_sensor(model.cameras[2].sensor_id, pose)
    model.add_rig(rig)
    images = [
        pycolmap.Image(name=name, camera_id=number, image_id=number, frame_id=1)
        for number, name in enumerate(("left/1.jpg", "right/1.png"), start=1)
    ]
    frame = pycolmap.Frame(frame_id=1, rig_id=1, rig_from_world=pycolmap.Rigid3d())
    for image in images:
        frame.add_data_id(image.data_id)
    model.add_frame(frame)
    for image in images:
        model.add_image(image)
    model.register_frame(1)
    path.mkdir()
    model.write(path)
    return pose


def test_model_with_rig(tmp_path: Path) -> None:
    pose = write_model(tmp_path / "model")
    (rig,) = read_rigs(tmp_path / "model", NAMES, None)
    assert rig.frames == (("left/1.jpg", "right/1.png"),)
    np.testing.assert_allclose(np.column_stack(rig.sensor_poses[1]), pose.matrix(), atol=1e-12)
