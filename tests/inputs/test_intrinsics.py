"""Tests of cameras from intrinsics.yaml and COLMAP models, and of wrong camera files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pycolmap
import pytest

from mpsfm_core.data import PinholeCamera
from mpsfm_core.data.errors import InputError
from mpsfm_core.inputs.intrinsics import intrinsics_from_cameras, read_intrinsics

SIZE = (640, 480)


def read(tmp_path: Path, text: str):
    path = tmp_path / "intrinsics.yaml"
    path.write_text(text)
    return read_intrinsics(path)


def refused(tmp_path: Path, text: str, name: str = "a.jpg", size: tuple[int, int] = SIZE) -> str:
    with pytest.raises(InputError) as caught:
        read(tmp_path, text).camera(name, size)
    return str(caught.value)


PINHOLE = PinholeCamera(*SIZE, 500.0, 510.0, 320.0, 240.0)


def test_one_camera_object_is_for_all_images() -> None:
    camera = intrinsics_from_cameras(PINHOLE).camera("any.jpg", SIZE)
    assert (camera.model_name, camera.params.tolist()) == ("PINHOLE", [500, 510, 320, 240])
    with pytest.raises(InputError, match=r"cameras, camera 1, image 'any.jpg' \(480x640"):
        intrinsics_from_cameras(PINHOLE).camera("any.jpg", SIZE[::-1])


def test_equal_camera_objects_share_a_camera_and_names_need_no_suffix() -> None:
    radial = pycolmap.Camera.create_from_model_name(9, "SIMPLE_RADIAL", 600.0, *SIZE)
    given = intrinsics_from_cameras({"a": PINHOLE, "b": PINHOLE, "c": radial})
    found = given.for_images(["a.jpg", "b.jpg", "c.jpg"])
    ids = [found.camera(f"{name}.jpg", SIZE).camera_id for name in "abc"]
    assert ids == [1, 1, 2]
    with pytest.raises(InputError, match=r"cameras has no camera for image 'd\.jpg'"):
        found.camera("d.jpg", SIZE)


def test_wrong_camera_object_names_its_image() -> None:
    with pytest.raises(InputError, match="image 'a': expected a PinholeCamera"):
        intrinsics_from_cameras({"a": 500.0})


def test_cameras_of_a_model_in_memory_are_those_of_its_folder(tmp_path: Path) -> None:
    options = pycolmap.SyntheticDatasetOptions(num_rigs=1, num_cameras_per_rig=1, num_points3D=20)
    model = pycolmap.synthesize_dataset(options)
    model.write(tmp_path)
    name, camera = model.images[1].name, model.cameras[1]
    size = camera.width, camera.height
    in_memory, read_back = intrinsics_from_cameras(model), read_intrinsics(tmp_path)
    assert in_memory.camera(name, size).params.tolist() == camera.params.tolist()
    assert in_memory.entries == read_back.entries


def test_default_models(tmp_path: Path) -> None:
    cameras = read(tmp_path, "1: {params: [500, 510, 320, 240], images: [a.jpg]}\n"
                             "2: {params: [500, 320, 240], images: all}")  # fmt: skip
    first, second = cameras.camera("a.jpg", SIZE), cameras.camera("b/c.jpg", SIZE)
    assert (first.model_name, first.camera_id) == ("PINHOLE", 1)
    assert first.params.tolist() == [500, 510, 320, 240]
    assert (second.model_name, second.camera_id) == ("SIMPLE_PINHOLE", 2)
    assert (second.width, second.height) == SIZE


@pytest.mark.parametrize(
    ("model", "params"),
    [
        ("OPENCV", [500, 500, 320, 240, 0.1, 0.01, 0, 0]),
        ("SIMPLE_RADIAL_FISHEYE", [300, 320, 240, 0.01]),
        ("THIN_PRISM_FISHEYE", [300, 300, 320, 240, 0, 0, 0, 0, 0, 0, 0, 0]),
    ],
)
def test_every_colmap_camera_model_is_read(tmp_path: Path, model: str, params: list[float]) -> None:
    camera = read(tmp_path, f"7: {{model: {model}, params: {params}}}").camera("a.jpg", SIZE)
    assert (camera.model_name, camera.params.tolist()) == (model, params)


def test_wrong_size_names_everything(tmp_path: Path) -> None:
    text = "3: {params: [500, 500, 320, 240], width: 640, height: 480, images: all}"
    message = refused(tmp_path, text, "x/y.jpg", (480, 640))
    for part in ("intrinsics.yaml", "camera 3", "'x/y.jpg'", "480x640", "640x480"):
        assert part in message


@pytest.mark.parametrize(
    ("params", "hint"),
    [
        ([1000, 1000, 640, 480], "outside"),  # of an image twice as large
        ([250, 250, 160, 120], "320x240"),  # of one half as large
        ([30, 30, 320, 240], "focal length"),
        ([9000, 9000, 320, 240], "focal length"),
    ],
)
def test_implausible_intrinsics(tmp_path: Path, params: list[float], hint: str) -> None:
    assert hint in refused(tmp_path, f"1: {{params: {params}, images: all}}")


def test_declared_size_allows_an_odd_principal_point(tmp_path: Path) -> None:
    text = "1: {params: [250, 250, 160, 120], width: 640, height: 480, images: all}"
    assert read(tmp_path, text).camera("a.jpg", SIZE).principal_point_x == 160


@pytest.mark.parametrize(
    ("text", "hint"),
    [
        ("", "expected cameras by number"),
        ("[1, 2]", "expected cameras by number"),
        ("1: [", "not valid YAML"),
        ("a: {params: [1, 2, 3]}", "must be a number"),
        ("1: 5", "expected a mapping"),
        ("1: {parms: [1, 2, 3]}", "did you mean 'params'"),
        ("1: {params: 5}", "list of numbers"),
        ("1: {params: [1, 2, x]}", "list of numbers"),
        ("1: {params: [1, 2]}", "need a 'model'"),
        ("1: {model: OPENVC, params: [1, 2, 3]}", "did you mean 'OPENCV'"),
        ("1: {model: OPENCV, params: [1, 2, 3]}", "has the parameters fx, fy, cx, cy"),
        ("1: {params: [1, 2, 3], width: 5}", "'width' and 'height'"),
        ("1: {params: [1, 2, 3], images: a.jpg}", "'all' or a list"),
        ("{1: {params: [1, 2, 3]}, 2: {params: [1, 2, 3]}}", "only one camera"),
        (
            "{1: {params: [1, 2, 3], images: [a]}, 2: {params: [1, 2, 3], images: [a]}}",
            "two cameras, 1 and 2",
        ),
    ],
)
def test_wrong_intrinsics_files_raise(tmp_path: Path, text: str, hint: str) -> None:
    assert hint in refused(tmp_path, text)


def test_image_without_camera(tmp_path: Path) -> None:
    message = refused(tmp_path, "1: {params: [500, 320, 240], images: [a.jpeg]}")
    assert "no camera for image 'a.jpg'" in message and "did you mean 'a.jpeg'" in message


def test_missing_intrinsics_file_raises(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="cannot be read"):
        read_intrinsics(tmp_path / "none.yaml")


def test_spherical_images_are_refused(tmp_path: Path) -> None:
    message = refused(tmp_path, "1: {model: EQUIRECTANGULAR, params: [640, 480], images: all}")
    assert "cannot be undistorted" in message


@pytest.fixture
def model() -> pycolmap.Reconstruction:
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_cameras_per_rig, options.num_frames_per_rig = 2, 1, 2
    options.num_points3D = 10
    options.camera_model_id = pycolmap.CameraModelId.SIMPLE_RADIAL
    options.camera_params = [1280, 512, 384, 0.05]
    return pycolmap.synthesize_dataset(options)


@pytest.mark.parametrize("form", ["binary", "text", "cameras.txt"])
def test_colmap_model(tmp_path: Path, model: pycolmap.Reconstruction, form: str) -> None:
    if form == "binary":
        model.write_binary(tmp_path)
    else:
        model.write_text(tmp_path)
    found = read_intrinsics(tmp_path / "cameras.txt" if form == "cameras.txt" else tmp_path)
    assert len(model.images) == 4
    for image in model.images.values():
        size = image.camera.width, image.camera.height
        camera = found.camera(image.name, size)
        assert camera.camera_id == image.camera_id
        assert np.allclose(camera.params, image.camera.params)
    with pytest.raises(InputError, match="no camera for image"):
        found.camera("other.jpg", SIZE)


def test_single_camera_is_used_for_all_images(tmp_path: Path) -> None:
    path = tmp_path / "cameras.txt"
    path.write_text("# comment\n1 PINHOLE 640 480 500 500 320 240\n")
    assert read_intrinsics(path).camera("any.jpg", SIZE).camera_id == 1
    path.write_text("1 PINHOLE 640\n")
    with pytest.raises(InputError, match=r"cameras\.txt, camera 1"):
        read_intrinsics(path)


def test_folder_without_colmap_model_raises(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no COLMAP model"):
        read_intrinsics(tmp_path)


def test_intrinsics_of_shared_scenes_equal_their_true_models(shared_data: Path) -> None:
    for folder in sorted((shared_data / "data").iterdir()):
        if (folder / "gt").is_dir():
            given = read_intrinsics(folder / "intrinsics.yaml")
            truth = read_intrinsics(folder / "gt")
            name = sorted((folder / "images").iterdir())[0].name
            camera = truth.camera(name, truth.entries[0].size)
            size = camera.width, camera.height
            assert np.allclose(given.camera(name, size).params, camera.params, atol=1e-3)
