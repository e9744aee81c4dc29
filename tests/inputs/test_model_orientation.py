"""Tests of models, cameras and keypoints in stored pixels, for all EXIF orientations."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
from PIL import Image
from typer.testing import CliRunner

from mpsfm_core.cli import build_app
from mpsfm_core.data import Float64, PinholeCamera
from mpsfm_core.data.errors import InputError
from mpsfm_core.geometry import rotation_angle_deg
from mpsfm_core.inputs.image_decoding import apply_orientation_to_pixels, orient
from mpsfm_core.inputs.images import load_images
from mpsfm_core.inputs.matches import matches_from_database
from mpsfm_core.inputs.model_orientation import orient_camera, orientation_matrix
from mpsfm_core.inputs.models import read_model, read_poses
from mpsfm_core.support.npz import write_npz
from mpsfm_core.testing.synthetic.scenes import arc_poses, project, room_scene

CAMERA = PinholeCamera(160, 120, 140.0, 145.0, 83.0, 57.0)
POSES = arc_poses(4, 12.0)
NAMES = tuple(f"{number}.jpg" for number in range(4))
INVERSE = {1: 1, 2: 2, 3: 3, 4: 4, 5: 5, 6: 8, 7: 7, 8: 6}
"""EXIF orientation of the inverse transform, by EXIF orientation."""
MIRRORED = (2, 4, 5, 7)
ALL = range(1, 9)


@pytest.fixture(scope="module")
def rendered() -> tuple[list[np.ndarray], Float64, list[Float64]]:
    """Return upright images, points (n, 3), and the pixels of the points in each image."""
    scene = room_scene()
    rng = np.random.default_rng(0)
    points = scene.sample(CAMERA, POSES[0], rng.uniform([40, 30], [120, 90], (60, 2))).points
    images = [scene.render(CAMERA, pose).rgb for pose in POSES]
    return images, points, [project(CAMERA, pose, points)[0] for pose in POSES]


def write_photos(folder: Path, images: list[np.ndarray], flags: tuple[int, ...]) -> Path:
    """Write upright images as photos with the given EXIF orientations."""
    folder.mkdir(parents=True)
    for name, rgb, flag in zip(NAMES, images, flags, strict=True):
        exif = Image.Exif()
        exif[0x0112] = flag
        Image.fromarray(orient(rgb, INVERSE[flag])).save(folder / name, exif=exif, quality=95)
    return folder


def upright_model(
    rendered: tuple[list[np.ndarray], Float64, list[Float64]], *, colored: bool = True
) -> pycolmap.Reconstruction:
    """Return the true model of the upright images."""
    images, points, pixels = rendered
    model = pycolmap.Reconstruction()
    camera = pycolmap.Camera(
        model="OPENCV", width=160, height=120, params=[*CAMERA.params, 0.0, 0.0, 0.0, 0.0],
        camera_id=1,
    )  # fmt: skip
    model.add_camera_with_trivial_rig(camera)
    for number, (name, pose, xy) in enumerate(zip(NAMES, POSES, pixels, strict=True), start=1):
        image = pycolmap.Image(name=name, keypoints=xy, camera_id=1, image_id=number)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pose))
    for row, point in enumerate(points):
        track = pycolmap.Track([pycolmap.TrackElement(i + 1, row) for i in range(len(NAMES))])
        x, y = pixels[0][row].astype(int)
        color = images[0][y, x] if colored else np.zeros(3, np.uint8)
        model.add_point3D(point, track, color)
    return model


def stored_model(
    upright: pycolmap.Reconstruction, flags: tuple[int, ...]
) -> pycolmap.Reconstruction:
    """Return the model of the stored pixels, as COLMAP reconstructs it. This conversion does not
    use the code under test."""
    model = pycolmap.Reconstruction()
    mirror = np.diag([1.0, 1.0, -1.0]) if flags[0] in MIRRORED else np.eye(3)
    for number, flag in enumerate(flags, start=1):
        inverse = INVERSE[flag]
        image = upright.images[number]
        xy = np.array([point.xy for point in image.points2D])
        corners = np.array([[0.0, 0.0], [160.0, 120.0], [CAMERA.cx, CAMERA.cy], [160.0, 0.0]])
        moved = apply_orientation_to_pixels(corners, (160, 120), inverse)
        width, height = (120, 160) if flag >= 5 else (160, 120)
        focal = [145.0, 140.0] if flag >= 5 else [140.0, 145.0]
        camera = pycolmap.Camera(
            model="OPENCV", width=width, height=height, camera_id=number,
            params=[*focal, *moved[2], 0.0, 0.0, 0.0, 0.0],
        )  # fmt: skip
        model.add_camera_with_trivial_rig(camera)
        # Axes of the stored image in upright pixel axes, from how corners move.
        axes = np.eye(3)
        x_axis = apply_orientation_to_pixels(
            np.array([[0.0, 0.0], [1.0, 0.0]]), (160, 120), inverse
        )
        y_axis = apply_orientation_to_pixels(
            np.array([[0.0, 0.0], [0.0, 1.0]]), (160, 120), inverse
        )
        axes[:2, 0], axes[:2, 1] = x_axis[1] - x_axis[0], y_axis[1] - y_axis[0]
        pose = image.cam_from_world().matrix()
        pose = np.column_stack([axes @ pose[:, :3] @ mirror, axes @ pose[:, 3]])
        new = pycolmap.Image(
            name=image.name, camera_id=number, image_id=number,
            keypoints=apply_orientation_to_pixels(xy, (160, 120), inverse),
        )  # fmt: skip
        model.add_image_with_trivial_frame(new, pycolmap.Rigid3d(pose))
    for point in upright.points3D.values():
        elements = [pycolmap.TrackElement(e.image_id, e.point2D_idx) for e in point.track.elements]
        model.add_point3D(mirror @ point.xyz, pycolmap.Track(elements), point.color)
    model.update_point_3d_errors()
    assert model.compute_mean_reprojection_error() < 1e-6
    return model


def write(model: pycolmap.Reconstruction, folder: Path) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    model.write_binary(str(folder))
    return folder


def check_upright(model: pycolmap.Reconstruction, truth: pycolmap.Reconstruction) -> None:
    """Check that relative rotations, cameras and keypoints are those of the upright model."""
    assert {image.name for image in model.images.values()} == set(NAMES)
    first, true_first = (m.find_image_with_name(NAMES[0]).cam_from_world() for m in (model, truth))
    for name in NAMES:
        image, true_image = model.find_image_with_name(name), truth.find_image_with_name(name)
        camera = model.cameras[image.camera_id]
        assert (camera.width, camera.height) == (160, 120)
        np.testing.assert_allclose(camera.params[:4], CAMERA.params, atol=1e-9)
        relative = image.cam_from_world() * first.inverse()
        true_relative = true_image.cam_from_world() * true_first.inverse()
        difference = relative.rotation.matrix() @ true_relative.rotation.matrix().T
        assert rotation_angle_deg(difference) < 1e-5
        np.testing.assert_allclose(relative.translation, true_relative.translation, atol=1e-9)
        xy = np.array([point.xy for point in image.points2D])
        np.testing.assert_allclose(xy, [p.xy for p in true_image.points2D], atol=1e-9)
    model.update_point_3d_errors()
    assert model.compute_mean_reprojection_error() < 1e-6


@pytest.mark.parametrize("flag", ALL)
@pytest.mark.parametrize("colored", [True, False])
def test_model_of_stored_pixels_is_turned_upright(
    rendered, tmp_path: Path, flag: int, colored: bool
) -> None:
    photos = write_photos(tmp_path / "photos", rendered[0], (flag,) * 4)
    truth = upright_model(rendered, colored=colored)
    folder = write(stored_model(truth, (flag,) * 4), tmp_path / "model")
    check_upright(read_model(folder, photos), truth)
    assert len(read_poses(folder, photos)) == 4


@pytest.mark.parametrize("flag", ALL)
def test_model_of_upright_pixels_stays(rendered, tmp_path: Path, flag: int) -> None:
    """Some versions of COLMAP apply EXIF orientation, so colors decide whether a model is
    upright."""
    photos = write_photos(tmp_path / "photos", rendered[0], (flag,) * 4)
    truth = upright_model(rendered)
    check_upright(read_model(write(truth, tmp_path / "model"), photos), truth)


@pytest.mark.parametrize("flags", [(1, 3, 6, 8), (3, 3, 1, 1), (6, 1, 1, 1), (8, 3, 8, 3)])
def test_mixed_rotations_are_turned(rendered, tmp_path: Path, flags: tuple[int, ...]) -> None:
    photos = write_photos(tmp_path / "photos", rendered[0], flags)
    for colored in (True, False):
        truth = upright_model(rendered, colored=colored)
        folder = write(stored_model(truth, flags), tmp_path / f"model{colored}")
        check_upright(read_model(folder, photos), truth)


@pytest.mark.parametrize("flag", MIRRORED)
def test_mirrored_photos_among_others_are_refused(rendered, tmp_path: Path, flag: int) -> None:
    photos = write_photos(tmp_path / "photos", rendered[0], (flag, 1, 1, 1))
    truth = upright_model(rendered)
    folder = write(stored_model(truth, (flag,) * 4), tmp_path / "model")
    with pytest.raises(InputError, match=r"mirrored.*exiftool"):
        read_model(folder, photos)


def test_models_of_our_results_are_upright(rendered, tmp_path: Path) -> None:
    photos = write_photos(tmp_path / "photos", rendered[0], (3,) * 4)
    truth = upright_model(rendered, colored=False)
    write(truth, tmp_path / "out" / "sparse")
    (tmp_path / "out" / "summary.json").write_text("{}")
    for folder in (tmp_path / "out", tmp_path / "out" / "sparse"):
        check_upright(read_model(folder, photos), truth)


@pytest.mark.parametrize("flag", ALL)
@pytest.mark.parametrize("source", ["model", "text", "database", "cameras.txt"])
def test_cameras_of_stored_pixels_are_turned(
    rendered, tmp_path: Path, flag: int, source: str
) -> None:
    photos = write_photos(tmp_path / "photos", rendered[0], (flag,) * 4)
    model = stored_model(upright_model(rendered), (flag,) * 4)
    path = write(model, tmp_path / "model")
    if source in ("text", "cameras.txt"):
        path = tmp_path / "text"
        path.mkdir()
        model.write_text(str(path))
        path = path if source == "text" else path / "cameras.txt"
    elif source == "database":
        path = tmp_path / "x.db"
        with pycolmap.Database.open(str(path)) as database:
            for image in model.images.values():
                database.write_camera(model.cameras[image.camera_id], use_camera_id=True)
                described = pycolmap.Image(
                    name=image.name, camera_id=image.camera_id, image_id=image.image_id
                )
                database.write_image(described, use_image_id=True)
    for image in load_images(photos, path):
        assert image.original_size == (160, 120)
        np.testing.assert_allclose(image.camera.params[:4], CAMERA.params, atol=1e-9)


@pytest.mark.parametrize("flag", ALL)
def test_keypoints_of_a_database_are_turned(rendered, tmp_path: Path, flag: int) -> None:
    photos = write_photos(tmp_path / "photos", rendered[0], (flag,) * 4)
    model = stored_model(upright_model(rendered), (flag,) * 4)
    path = tmp_path / "x.db"
    with pycolmap.Database.open(str(path)) as database:
        for image in model.images.values():
            database.write_camera(model.cameras[image.camera_id], use_camera_id=True)
            described = pycolmap.Image(
                name=image.name, camera_id=image.camera_id, image_id=image.image_id
            )
            database.write_image(described, use_image_id=True)
            xy = np.array([point.xy for point in image.points2D], np.float32)
            database.write_keypoints(image.image_id, xy)
        rows = np.arange(60, dtype=np.uint32)
        database.write_matches(1, 2, np.stack([rows, rows], axis=1))
    imported = matches_from_database(path, load_images(photos, path))
    for xy, expected in zip(imported.keypoints, rendered[2], strict=True):
        np.testing.assert_allclose(xy, expected, atol=1e-3)


@pytest.mark.parametrize("flag", ALL)
@pytest.mark.parametrize(
    ("model", "params"),
    [
        ("SIMPLE_RADIAL", [140, 83, 57, 0.1]),
        ("OPENCV", [140, 145, 83, 57, 0.1, -0.05, 0.01, -0.02]),
        ("FULL_OPENCV", [140, 145, 83, 57, 0.1, -0.05, 0.01, -0.02, 0.01, 0.02, 0.01, 0.005]),
        ("OPENCV_FISHEYE", [140, 145, 83, 57, 0.1, -0.05, 0.01, -0.02]),
        ("THIN_PRISM_FISHEYE", [140, 145, 83, 57, 0.1, -0.05, 0.01, -0.02, 0, 0, 0.003, -0.002]),
    ],
)
def test_distorted_cameras_see_the_same_pixels(flag: int, model: str, params: list[float]) -> None:
    camera = pycolmap.Camera(model=model, width=160, height=120, params=params)
    rays = np.random.default_rng(0).uniform([-0.5, -0.4, 1], [0.5, 0.4, 1], (50, 3))
    expected = apply_orientation_to_pixels(camera.img_from_cam(rays), (160, 120), flag)
    turned = orient_camera(camera, flag)
    np.testing.assert_allclose(
        turned.img_from_cam(rays @ orientation_matrix(flag).T), expected, atol=1e-9
    )


def test_photos_of_a_stored_model_look_like_its_points(rendered, tmp_path: Path) -> None:
    """Upright views and projected points of the imported model have the same colors."""
    photos = write_photos(tmp_path / "photos", rendered[0], (3, 3, 6, 6))
    truth = upright_model(rendered)
    folder = write(stored_model(truth, (3, 3, 6, 6)), tmp_path / "model")
    model, images = read_model(folder, photos), load_images(photos, folder)
    for index, source in enumerate(images):
        image = model.find_image_with_name(source.name)
        xy = source.view_pixels(np.array([point.xy for point in image.points2D]))
        view = cv2.GaussianBlur(images.view(index).image, (3, 3), 0)
        seen = view[xy[:, 1].astype(int), xy[:, 0].astype(int)].astype(int)
        colors = np.array([model.points3D[p.point3D_id].color for p in image.points2D])
        assert np.median(np.abs(seen - colors)) < 20


@pytest.mark.parametrize("flag", (3, 6))
def test_evaluate_rotates_truth_and_depth_of_rotated_photos(
    rendered, tmp_path: Path, flag: int
) -> None:
    """The result is upright; COLMAP's model and sensor depth refer to stored pixels."""
    photos = write_photos(tmp_path / "photos", rendered[0], (flag,) * 4)
    truth = upright_model(rendered)
    result = tmp_path / "result"
    write(truth, result / "sparse")
    (result / "summary.json").write_text(json.dumps({"photos": str(photos)}))
    gt = write(stored_model(truth, (flag,) * 4), tmp_path / "gt")
    ramp = np.arange(60 * 80, dtype=np.uint16).reshape(60, 80) + 500
    for name in NAMES:
        arrays = {"depth": ramp / np.float32(1000), "valid": ramp > 0}
        write_npz(result / "depth" / f"{name}.npz", **arrays)
        stored = orient(ramp, INVERSE[flag])
        (tmp_path / "depth").mkdir(exist_ok=True)
        cv2.imwrite(str(tmp_path / "depth" / Path(name).with_suffix(".png")), stored)
    arguments = ["evaluate", str(result), str(gt), "--gt-depth", str(tmp_path / "depth")]
    done = CliRunner().invoke(build_app(), arguments)
    assert done.exit_code == 0, done.output
    report = json.loads(done.stdout)
    assert report["registered"] == 4 and report["auc"]["1"] > 99
    assert report["depth"]["median_scaled"]["abs_rel"] < 1e-3
    (result / "summary.json").write_text("{}")
    unknown = json.loads(CliRunner().invoke(build_app(), arguments).stdout)
    assert unknown["auc"]["20"] < 60
    known = CliRunner().invoke(build_app(), [*arguments, "--photos", str(photos)])
    assert json.loads(known.stdout)["auc"] == report["auc"]
