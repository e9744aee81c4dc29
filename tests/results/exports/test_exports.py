"""Tests of every export format with the program or library that reads the format."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
import trimesh

from mpsfm_core.data.errors import InputError
from mpsfm_core.geometry import angle_between_deg
from mpsfm_core.inputs.nerfstudio import read_transforms
from mpsfm_core.providers import ExportFormat
from mpsfm_core.providers.registry import Registry
from mpsfm_core.results.exports.formats import FORMATS, export
from mpsfm_core.results.ply import read_normals, read_ply

REGISTERED = ["2.webp.jpg", "a/0.png", "a/1.jpg"]
"""Names of the undistorted photos; the fourth photo is only tentatively registered."""


def model_of(result: Path) -> pycolmap.Reconstruction:
    return pycolmap.Reconstruction(str(result / "sparse"))


def median_error(image, camera, depth, points) -> float:
    """Return the median relative depth error of a depth map at the projections of points."""
    local = image.cam_from_world() * points
    scale = depth.shape[1] / camera.width
    column, row = (camera.img_from_cam(local) * scale).astype(int).T
    inside = (row >= 0) & (row < depth.shape[0]) & (column >= 0) & (column < depth.shape[1])
    seen = inside & (local[:, 2] > 0)
    return float(np.median(np.abs(depth[row[seen], column[seen]] / local[seen, 2] - 1)))


@pytest.mark.parametrize("chosen", FORMATS, ids=lambda chosen: chosen.name)
def test_every_format_writes_its_files_without_tentative_images(
    result: Path, tmp_path: Path, chosen: ExportFormat
) -> None:
    described = export(result, chosen.name, tmp_path / "out")
    written = sorted(path.name for path in (tmp_path / "out").iterdir())
    assert written == sorted((*chosen.entries, "export.json"))
    assert described["left_out"] == ["guess.png"]
    assert described["images"] == 3
    assert described["metres_per_unit"] == 1.0
    saved = json.loads((tmp_path / "out" / "export.json").read_text())
    assert saved == {key: value for key, value in described.items() if key != "output"}


def test_plugins_add_formats(result: Path, tmp_path: Path, install_plugin) -> None:
    install_plugin(
        "mpsfm-count",
        """
        from mpsfm_core import hookimpl
        from mpsfm_core.providers import ExportFormat

        @hookimpl
        def mpsfm_export_formats():
            write = f"{__name__}:write"
            count = ExportFormat("count", "how many", ("n.txt",), write, align_gravity=True)
            return [count, ExportFormat("broken", "", (), f"{__name__}:nothing")]

        def write(source, folder):
            (folder / "n.txt").write_text(f"{len(source.names)} {source.z_is_up}")
        """,
    )
    export(result, "count", tmp_path / "out")
    assert (tmp_path / "out" / "n.txt").read_text() == "3 True"
    with pytest.raises(InputError, match="'broken' cannot be written: AttributeError"):
        export(result, "broken", tmp_path / "out")
    with pytest.raises(InputError, match="no format 'rerun'; pip install mpsfm-rerun"):
        export(result, "rerun", tmp_path / "out", registry=Registry())


def tracked_points(model: pycolmap.Reconstruction) -> list[pycolmap.Point3D]:
    """Return the points with observations, sorted by id."""
    return [point for _, point in sorted(model.points3D.items()) if point.track.length()]


@pytest.mark.parametrize("turn", [True, False])
def test_gsplat_reads_the_folder(result: Path, tmp_path: Path, turn: bool) -> None:
    """Read the folder step by step like gsplat's examples/datasets/colmap.py."""
    export(result, "gsplat", tmp_path, turn=turn)
    model = pycolmap.Reconstruction(str(tmp_path / "sparse" / "0"))
    names = [model.images[i].name for i in model.reg_image_ids()]
    assert sorted(names) == REGISTERED
    folder = tmp_path / "images"
    files = [path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()]
    assert sorted(files) == REGISTERED
    assert {camera.model_name for camera in model.cameras.values()} == {"PINHOLE"}
    for image in model.images.values():
        camera = model.cameras[image.camera_id]
        assert cv2.imread(str(folder / image.name)).shape == (camera.height, camera.width, 3)
    tracked = tracked_points(model)
    assert len(tracked) == 60
    assert max(point.error for point in tracked) < 1e-3
    ids = sorted(i for i in model.points3D if not model.points3D[i].track.length())
    dense = np.array([model.points3D[i].xyz for i in ids])
    points, _ = read_ply(tmp_path / "sparse" / "0" / "points3D.ply")
    np.testing.assert_allclose(dense, points, atol=1e-5)
    assert len(dense) == len(read_ply(result / "dense.ply")[0])
    colors = np.array([point.color for point in model.points3D.values()])
    assert colors.std(axis=0).min() > 1


@pytest.mark.parametrize(
    ("format_name", "file"), [("gsplat", "sparse/0/points3D.ply"), ("nerfstudio", "sparse_pc.ply")]
)
def test_initial_points_have_normals_in_the_exported_world(
    result: Path, tmp_path: Path, format_name: str, file: str
) -> None:
    """The order of the properties is the one that OpenSplat requires."""
    described = export(result, format_name, tmp_path, turn=True)
    header = (tmp_path / file).read_bytes().partition(b"end_header")[0].decode().splitlines()
    names = [line.split()[-1] for line in header if line.startswith("property")]
    assert names == ["x", "y", "z", "nx", "ny", "nz", "red", "green", "blue"]
    matrix = np.array(described["world_from_model"])[:3, :3]
    rotation = matrix / np.cbrt(np.linalg.det(matrix))
    expected = read_normals(result / "dense.ply") @ rotation.T
    np.testing.assert_allclose(read_normals(tmp_path / file), expected, atol=1e-5)
    assert np.linalg.norm(expected, axis=1).mean() > 0.8


def test_gaussians_have_position_color_and_size(result: Path, tmp_path: Path) -> None:
    export(result, "gsplat", tmp_path, turn=False)
    data = (tmp_path / "gaussians.ply").read_bytes()
    header, _, body = data.partition(b"end_header\n")
    fields = [line.split()[-1].decode() for line in header.splitlines() if b"property" in line]
    rows = np.frombuffer(body, "<f4").reshape(-1, len(fields))
    points, colors = read_ply(result / "dense.ply")
    assert len(rows) == len(points)
    column = {name: rows[:, index] for index, name in enumerate(fields)}
    np.testing.assert_allclose(rows[:, :3], points, atol=1e-6)
    red = 0.28209479177387814 * column["f_dc_0"] + 0.5
    np.testing.assert_allclose(red * 255, colors[:, 0], atol=1e-3)
    nearest = np.median(np.exp(column["scale_0"]))
    assert 0.001 < nearest < 0.2  # meters in a room, in images of 80 x 60 pixels
    assert (column["rot_0"] == 1).all()


@pytest.mark.parametrize("turn", [True, False])
def test_maps_lift_to_the_surfaces_of_the_exported_world(
    result: Path, tmp_path: Path, turn: bool
) -> None:
    export(result, "gsplat", tmp_path, turn=turn)
    model = pycolmap.Reconstruction(str(tmp_path / "sparse" / "0"))
    image = model.find_image_with_name("a/0.png")
    with np.load(tmp_path / "maps" / "a" / "0.png.npz") as maps:
        camera = model.cameras[image.camera_id]
        scale = maps["depth"].shape[1] / camera.width
        assert maps["camera"][0] == pytest.approx(camera.focal_length_x * scale)
        points = np.array([point.xyz for point in model.points3D.values()])
        assert median_error(image, camera, maps["depth"], points) < 0.01
        length = np.linalg.norm(maps["normals"][maps["normals_valid"]], axis=1)
        np.testing.assert_allclose(length, 1, atol=1e-3)
        assert np.median(maps["depth_std"] / maps["depth"]) == pytest.approx(0.01, rel=0.01)
        assert (maps["normals_std"][maps["normals_valid"]] > 0).all()


def test_nerfstudio_has_depth_of_every_frame_and_keeps_gravity(
    result: Path, tmp_path: Path
) -> None:
    export(result, "nerfstudio", tmp_path)
    transforms = json.loads((tmp_path / "transforms.json").read_text())
    assert transforms["orientation_override"] == "none"
    assert transforms["camera_model"] == "OPENCV"
    points, _ = read_ply(tmp_path / transforms["ply_file_path"])
    assert len(points) == len(read_ply(result / "dense.ply")[0])
    poses = read_transforms(tmp_path / "transforms.json")
    for frame in transforms["frames"]:
        assert (tmp_path / frame["file_path"]).is_file()
        depth = np.load(tmp_path / frame["depth_file_path"]) * 0.001
        image = poses.find_image_with_name(frame["file_path"])
        camera = poses.cameras[image.camera_id]
        assert median_error(image, camera, depth, points) < 0.01


def test_nerfstudio_points_have_the_layout_that_opensplat_reads(
    result: Path, tmp_path: Path
) -> None:
    """OpenSplat reads positions, normals if the header has them, and then three colors."""
    export(result, "nerfstudio", tmp_path, turn=False)
    data = (tmp_path / "sparse_pc.ply").read_bytes()
    header, _, body = data.partition(b"end_header\n")
    assert header.startswith(b"ply\nformat binary_little_endian 1.0\nelement vertex")
    rows = np.frombuffer(body, [("xyz", "<f4", 3), ("normal", "<f4", 3), ("rgb", "u1", 3)])
    points, colors = read_ply(result / "dense.ply")
    np.testing.assert_allclose(rows["xyz"], points, atol=1e-6)
    np.testing.assert_array_equal(rows["rgb"], colors)


def test_colmap_reads_the_text_model(result: Path, tmp_path: Path) -> None:
    export(result, "colmap-text", tmp_path)
    model, original = pycolmap.Reconstruction(str(tmp_path)), model_of(result)
    assert model.num_reg_images() == 3
    for number, point in model.points3D.items():
        np.testing.assert_allclose(point.xyz, original.points3D[number].xyz)


def test_colmap_maps_from_the_database(result: Path, tmp_path: Path) -> None:
    export(result, "colmap-db", tmp_path / "db")
    path = tmp_path / "db" / "database.db"
    with pycolmap.Database.open(str(path)) as database:
        assert database.num_images() == 4  # the tentative image has no matches
        assert database.num_verified_image_pairs() == 3
    options = pycolmap.IncrementalPipelineOptions()
    options.ba_refine_focal_length = options.ba_refine_extra_params = False
    options.random_seed, options.num_threads = 0, 1
    options.mapper.init_min_tri_angle = 5
    options.mapper.init_min_num_inliers = 30
    photos = result.parent / "photos"
    models = pycolmap.incremental_mapping(str(path), str(photos), str(tmp_path), options)
    assert [model.num_reg_images() for model in models.values()] == [3]
    assert models[0].compute_mean_reprojection_error() < 0.1


def test_trimesh_reads_the_glb(result: Path, tmp_path: Path) -> None:
    """Tested by hand: Blender 5.0 shows colored points and a camera for each photo."""
    export(result, "glb", tmp_path)
    scene = trimesh.load(tmp_path / "scene.glb")
    points, colors = read_ply(result / "dense.ply")
    cloud = scene.geometry["points"]
    assert isinstance(cloud, trimesh.PointCloud)
    np.testing.assert_array_equal(np.asarray(cloud.colors)[:, :3], colors)
    described = json.loads((tmp_path / "export.json").read_text())
    turned = pycolmap.Sim3d(np.array(described["world_from_model"])) * points
    np.testing.assert_allclose(cloud.vertices, turned[:, [0, 2, 1]] * [1, 1, -1], atol=1e-5)
    cameras = {"2.webp", "a/0.png", "a/1.jpg"}
    assert cameras <= set(scene.graph.nodes)
    model = model_of(result)
    for name in cameras:
        center = model.find_image_with_name(name).projection_center()
        turned = pycolmap.Sim3d(np.array(described["world_from_model"])) * center
        place = scene.graph[name][0][:3, 3]
        np.testing.assert_allclose(place, turned[[0, 2, 1]] * [1, 1, -1], atol=1e-5)


def test_aligned_exports_have_gravity_down_and_a_centered_origin(
    result: Path, tmp_path: Path
) -> None:
    described = export(result, "gsplat", tmp_path)
    assert "gravity from cameras and surfaces" in described["orientation"]
    turned = np.array(described["world_from_model"])
    truth = np.array([0.0, 0.0, 1.0])  # z is up in the synthetic room
    assert angle_between_deg(turned[:, :3] @ truth, np.array([0, 0, 1.0])) < 0.5
    model = pycolmap.Reconstruction(str(tmp_path / "sparse" / "0"))
    middle = np.median([point.xyz for point in tracked_points(model)], axis=0)
    np.testing.assert_allclose(middle, 0, atol=1e-9)


def test_aligned_export_is_in_meters_if_the_scale_is_known(result: Path, tmp_path: Path) -> None:
    """An uncertain metric scale changes rendered formats only, not the exported COLMAP model."""
    folder = tmp_path / "result"
    shutil.copytree(result, folder)
    summary = json.loads((folder / "summary.json").read_text())
    metric = {"metres_per_unit": 2.0, "spread": 0.4, "num_images": 3, "trusted": False}
    summary["reconstructions"] = [{"metric_scale": metric}]
    (folder / "summary.json").write_text(json.dumps(summary))
    assert export(folder, "colmap-text")["metres_per_unit"] == 2.0
    described = export(folder, "gsplat")
    assert described["metres_per_unit"] == 1.0
    assert described["scale_spread"] == 0.4
    exported = folder / "exports" / "gsplat"
    model = pycolmap.Reconstruction(str(exported / "sparse" / "0"))
    points = np.array([point.xyz for point in tracked_points(model)])
    before = np.array([p.xyz for _, p in sorted(model_of(result).points3D.items())])
    lengths = [np.linalg.norm(cloud[1:] - cloud[0], axis=1) for cloud in (points, before)]
    np.testing.assert_allclose(lengths[0], 2 * lengths[1], rtol=1e-6)
    image = model.find_image_with_name("a/0.png")
    with np.load(exported / "maps" / "a" / "0.png.npz") as maps:
        camera = model.cameras[image.camera_id]
        assert median_error(image, camera, maps["depth"], points) < 0.01
        assert np.median(maps["depth_std"] / maps["depth"]) == pytest.approx(0.01, rel=0.01)


def test_colmap_model_is_exported_with_given_photos(result: Path, tmp_path: Path) -> None:
    folder = tmp_path / "elsewhere"
    folder.mkdir()
    model_of(result).write_binary(str(folder))
    with pytest.raises(InputError, match="give it with --images"):
        export(folder, "gsplat")
    described = export(folder, "gsplat", photos=result.parent / "photos")
    assert described["images"] == 4  # a COLMAP model marks no tentative image
    assert described["metres_per_unit"] is None
    assert "gravity from how the cameras are held" in described["orientation"]
    assert not (folder / "exports" / "gsplat" / "maps").exists()


def test_repeated_export_replaces_only_the_earlier_export(result: Path, tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("mine")
    (tmp_path / "images").mkdir()
    (tmp_path / "images" / "old.png").write_text("")
    export(result, "gsplat", tmp_path)
    assert (tmp_path / "notes.txt").read_text() == "mine"
    assert not (tmp_path / "images" / "old.png").exists()


def test_unknown_format_suggests_the_nearest_format(result: Path) -> None:
    with pytest.raises(InputError, match="did you mean 'gsplat'"):
        export(result, "gsplt")
