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
        ([LEFT, {"image_prefix": "right/"}], "is missing"),
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


def test_database_with_unknown_relative_pose_is_an_error(tmp_path: Path) -> None:
    path = tmp_path / "database.db"
    write_database(path, None)
    with pytest.raises(InputError, match="of camera 2 is unknown"):
        read_rigs(path, NAMES, tmp_path)
