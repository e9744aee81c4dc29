"""Tests of files of other programs: byte order marks, blank lines, paths, spaces, scales."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from PIL import Image

from mpsfm_core.data.errors import InputError
from mpsfm_core.inputs.image_search import read_image_list
from mpsfm_core.inputs.images import load_images
from mpsfm_core.inputs.intrinsics import read_intrinsics
from mpsfm_core.inputs.matches import matches_from_database
from mpsfm_core.inputs.models import match_names, read_poses
from mpsfm_core.inputs.nerfstudio import read_transforms

MARKS = {"utf-8": "utf-8", "byte-order mark": "utf-8-sig", "PowerShell": "utf-16"}
NAMES = ("0001.jpg", "0002.jpg")


@pytest.fixture
def photos(tmp_path: Path) -> Path:
    folder = tmp_path / "photos"
    folder.mkdir()
    for name in NAMES:
        Image.new("RGB", (64, 48)).save(folder / name)
    return folder


def write_text_model(folder: Path, names: tuple[str, ...] = NAMES) -> Path:
    folder.mkdir(exist_ok=True)
    model = pycolmap.Reconstruction()
    camera = pycolmap.Camera(
        model="PINHOLE", width=64, height=48, params=[70, 71, 32, 24], camera_id=1
    )
    model.add_camera_with_trivial_rig(camera)
    for number, name in enumerate(names, start=1):
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(), np.array([number, 0.0, 0.0]))
        image = pycolmap.Image(name=name, camera_id=1, image_id=number)
        model.add_image_with_trivial_frame(image, pose)
    model.write_text(str(folder))
    return folder


def frames(**shared: object) -> dict[str, object]:
    listed = [
        {"file_path": f"images/{name}", "transform_matrix": np.eye(4).tolist()} for name in NAMES
    ]
    return {"fl_x": 70, **shared, "frames": listed}


def check_poses(poses: dict, names: tuple[str, ...] = NAMES) -> None:
    assert {name: pose[1][0] for name, pose in poses.items()} == {names[0]: 1, names[1]: 2}


@pytest.mark.parametrize("encoding", MARKS.values(), ids=MARKS)
@pytest.mark.parametrize("end", ["\n", "\r\n"], ids=["LF", "CRLF"])
@pytest.mark.parametrize("blank", ["", "top", "end"])
def test_text_models_of_windows_are_read(
    tmp_path: Path, encoding: str, end: str, blank: str
) -> None:
    folder = write_text_model(tmp_path / "model")
    for path in folder.iterdir():
        text = path.read_text().replace("\n", end)
        text = {"": text, "top": end * 2 + text, "end": text + end * 3}[blank]
        path.write_bytes(text.encode(encoding))
    check_poses(read_poses(folder))
    for source in (folder, folder / "cameras.txt"):
        camera = read_intrinsics(source).camera(NAMES[0], (64, 48))
        assert list(camera.params) == [70, 71, 32, 24]


def test_text_model_of_poses_without_points_is_read(tmp_path: Path) -> None:
    folder = write_text_model(tmp_path / "model")
    for name in ("points3D", "rigs", "frames"):
        (folder / f"{name}.txt").unlink()
    check_poses(read_poses(folder))


def test_text_model_with_spaces_in_names_is_read(tmp_path: Path) -> None:
    names = ("cam 1/a b.jpg", "cam 1/a c.jpg")
    folder = write_text_model(tmp_path / "model", names)
    check_poses(read_poses(folder), names)
    read_intrinsics(folder).camera(names[1], (64, 48))


@pytest.mark.parametrize("encoding", MARKS.values(), ids=MARKS)
def test_lists_transforms_and_yaml_with_marks_are_read(
    tmp_path: Path, photos: Path, encoding: str
) -> None:
    (tmp_path / "list.txt").write_bytes("\r\n".join(NAMES).encode(encoding))
    assert read_image_list(tmp_path / "list.txt") == list(NAMES)
    text = json.dumps(frames(w=64, h=48))
    (tmp_path / "transforms.json").write_bytes(text.encode(encoding))
    assert len(read_transforms(tmp_path / "transforms.json").images) == 2
    (tmp_path / "intrinsics.yaml").write_bytes("1: {params: [70, 70, 32, 24]}".encode(encoding))
    images = load_images(photos, tmp_path / "intrinsics.yaml", tmp_path / "list.txt")
    assert images[0].camera.focal_length_x == 70


@pytest.mark.parametrize(
    "path",
    [r"C:\data\images\0002.JPG", r"\\server\share\0002.jpg", "/home/me/0002.jpg",
     r"images\0002.png", "0002.JPEG", "../0002.jpg", "IMAGES/0002.jpg"],
)  # fmt: skip
def test_names_of_other_systems_match(path: str) -> None:
    other = path.replace("0002", "0001")
    assert match_names(NAMES, [path, other]) == {"0002.jpg": path, "0001.jpg": other}


def test_names_that_differ_in_case_match_if_unique() -> None:
    assert match_names(["IMG_1.jpg", "b.jpg"], ["img_1.JPG", "b.jpg"]) == {
        "IMG_1.jpg": "img_1.JPG",
        "b.jpg": "b.jpg",
    }
    assert match_names(["a.jpg", "A.jpg"], ["a.JPG"]) == {"a.jpg": "a.JPG"}


def test_model_with_windows_paths_gives_cameras(tmp_path: Path, photos: Path) -> None:
    names = tuple(rf"C:\data\images\{name}" for name in NAMES)
    folder = write_text_model(tmp_path / "model", names)
    assert load_images(photos, folder)[1].camera.focal_length_x == 70


@pytest.mark.parametrize("prefix", ["images", "/home/me/data", r"C:\data", "../photos"])
@pytest.mark.parametrize("extension", [".jpg", ""])
def test_transforms_without_size_use_the_photos_of_the_run(
    tmp_path: Path, photos: Path, prefix: str, extension: str
) -> None:
    data = frames()
    for frame, name in zip(data["frames"], NAMES, strict=True):  # type: ignore[call-overload]
        frame["file_path"] = f"{prefix}/{Path(name).stem}{extension}"
    path = tmp_path / "elsewhere" / "transforms.json"
    path.parent.mkdir()
    path.write_text(json.dumps(data))
    camera = load_images(photos, path)[0].camera
    assert (camera.width, camera.height, camera.focal_length_x) == (64, 48, 70)
    assert len(read_poses(path, photos)) == 2


def matrix_of(block: np.ndarray) -> list[list[float]]:
    matrix = np.eye(4)
    matrix[:3, :3] = block
    return matrix.tolist()


@pytest.mark.parametrize(
    ("block", "advice"),
    [
        (0.01 * np.eye(3), r"times 0\.01: the camera is scaled.*Blender.*Ctrl\+A"),
        (2.5 * np.eye(3)[[1, 2, 0]], r"times 2\.5"),
        (np.diag([1.0, 2.0, 1.0]), "scaled differently"),
        (np.diag([1.0, 1.0, -1.0]), "mirrored"),
        (np.zeros((3, 3)), "is not a rotation"),
    ],
)
def test_matrix_that_is_no_rotation_comes_with_advice(
    tmp_path: Path, block: np.ndarray, advice: str
) -> None:
    data = frames(w=64, h=48)
    data["frames"][1]["transform_matrix"] = matrix_of(block)  # type: ignore[index]
    (tmp_path / "transforms.json").write_text(json.dumps(data))
    with pytest.raises(InputError, match=advice):
        read_transforms(tmp_path / "transforms.json")


def test_names_of_both_sides_are_quoted(tmp_path: Path, photos: Path) -> None:
    folder = write_text_model(tmp_path / "model", ("other_a.jpg", "other_b.jpg"))
    with pytest.raises(InputError, match=re.escape("'0001.jpg'")):
        load_images(photos, folder)
    with pycolmap.Database.open(str(tmp_path / "x.db")) as database:
        camera = pycolmap.Camera(model="PINHOLE", width=64, height=48, params=[70, 71, 32, 24])
        camera_id = database.write_camera(camera)
        database.write_image(pycolmap.Image(name="other_a.jpg", camera_id=camera_id))
    with pytest.raises(InputError, match=r"names differ.*'other_a\.jpg' there, '0001\.jpg' here"):
        matches_from_database(tmp_path / "x.db", load_images(photos))
    shutil.rmtree(folder)
