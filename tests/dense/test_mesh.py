"""Tests of the mesh from depth maps of a room with known surfaces."""

from __future__ import annotations

import json
import struct
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import trimesh
from scipy.spatial import cKDTree
from typer.testing import CliRunner

from mpsfm_core.cli import build_app
from mpsfm_core.data import DepthPrior
from mpsfm_core.data.errors import InputError
from mpsfm_core.dense.fusion import find_seen_through, select_voters
from mpsfm_core.dense.mesh import TriangleMesh, mesh_depth_maps
from mpsfm_core.dense.mesh_visibility import find_observed_triangles
from mpsfm_core.dense.options import MeshOptions
from mpsfm_core.geometry import pixel_centers, unproject
from mpsfm_core.geometry.pycolmap_conversion import colmap_from_pinhole
from mpsfm_core.mapping.scene.reconstruction import Reconstruction
from mpsfm_core.results.colmap_model import build_model, write_model
from mpsfm_core.results.depth_maps import write_depth_maps
from mpsfm_core.results.obj import read_obj
from mpsfm_core.support.disk_arrays import store_on_disk
from mpsfm_core.testing.posed_room import CAMERA, PosedRoom

STD = 0.01


def measured(room: PosedRoom, std: float = STD, seed: int = 0) -> Reconstruction:
    """Return true depth with independent relative noise."""
    rng = np.random.default_rng(seed)
    images = []
    for image in room.reconstruction.images:
        true = room.truth[image.name]
        noisy = true * np.exp(std * rng.standard_normal(true.shape)).astype(np.float32)
        depth = DepthPrior.from_arrays(noisy, (max(std, 1e-3) * noisy) ** 2)
        images.append(replace(image, depth=depth))
    return replace(room.reconstruction, images=tuple(images))


def surface(room: PosedRoom) -> np.ndarray:
    """Return the world points of all true depth maps."""
    parts = []
    for image in room.reconstruction.images:
        local = unproject(CAMERA, pixel_centers(*CAMERA.size), room.truth[image.name])
        parts.append((local.reshape(-1, 3) - image.translation) @ image.rotation)
    return np.concatenate(parts)


@pytest.fixture(scope="module")
def mesh(room: PosedRoom) -> TriangleMesh:
    return mesh_depth_maps(measured(room), room.views.__getitem__, MeshOptions())


def test_mesh_is_accurate_and_complete(room: PosedRoom, mesh: TriangleMesh) -> None:
    truth = surface(room)
    depth = float(np.median(np.concatenate([t.ravel() for t in room.truth.values()])))
    pixel = depth / CAMERA.fx
    to_truth = cKDTree(truth).query(mesh.vertices)[0]
    assert np.median(to_truth) < pixel and np.quantile(to_truth, 0.95) < 3 * pixel
    to_mesh = cKDTree(mesh.vertices).query(truth)[0]
    assert (to_mesh < 4 * pixel).mean() > 0.95


def test_mesh_is_smoother_than_depth_maps(room: PosedRoom, mesh: TriangleMesh) -> None:
    image = room.reconstruction.images[0]
    local = mesh.vertices @ image.rotation.T + image.translation
    xy = CAMERA.fx * local[:, :2] / local[:, 2:] + (CAMERA.cx, CAMERA.cy)
    seen = ((xy > 2) & (xy < np.array(CAMERA.size) - 2)).all(axis=1)
    column, row = xy[seen].astype(int).T
    error = np.log(local[seen, 2] / room.truth[image.name][row, column])
    assert np.median(np.abs(error)) < 0.5 * STD


def test_triangles_face_cameras_and_have_image_colors(room: PosedRoom) -> None:
    mesh = mesh_depth_maps(measured(room, std=0.0), room.views.__getitem__, MeshOptions())
    corners = mesh.vertices[mesh.triangles]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    centers = [-(i.rotation.T @ i.translation) for i in room.reconstruction.images]
    towards = np.mean(centers, axis=0) - corners.mean(axis=1)
    area = np.linalg.norm(normals, axis=1)
    assert area[(normals * towards).sum(axis=1) > 0].sum() > 0.97 * area.sum()
    image = room.reconstruction.images[0]
    local = unproject(CAMERA, pixel_centers(*CAMERA.size), room.truth[image.name])
    points = (local - image.translation) @ image.rotation
    _, nearest = cKDTree(mesh.vertices).query(points[5:-5:9, 5:-5:9].reshape(-1, 3))
    seen = room.views[image.name].image[5:-5:9, 5:-5:9].reshape(-1, 3).astype(float)
    assert np.median(np.abs(mesh.colors[nearest] - seen)) < 20


def test_max_triangles_limits_mesh(room: PosedRoom, mesh: TriangleMesh) -> None:
    limit = len(mesh.triangles) // 4
    options = MeshOptions(max_triangles=limit)
    small = mesh_depth_maps(measured(room), room.views.__getitem__, options)
    assert 0.8 * limit < len(small.triangles) <= limit + 2
    assert np.median(cKDTree(surface(room)).query(small.vertices)[0]) < 0.05


def test_mesh_of_scene_with_many_voxels_has_larger_voxels(
    room: PosedRoom, monkeypatch: pytest.MonkeyPatch
) -> None:
    sizes = []

    def simplify(points: np.ndarray, faces: np.ndarray, target_count: int) -> tuple[Any, Any]:
        sizes.append(len(faces))
        return points, faces

    monkeypatch.setattr("fast_simplification.simplify", simplify)
    for limit in (4000, 1000):
        options = MeshOptions(max_triangles=limit)
        mesh_depth_maps(measured(room, std=0.0), room.views.__getitem__, options)
    assert limit < sizes[1] < 0.5 * sizes[0] and sizes[1] < 8 * limit


def test_mesh_from_stored_maps_is_equal(
    room: PosedRoom, mesh: TriangleMesh, tmp_path: Path
) -> None:
    with store_on_disk(tmp_path, in_memory=0):
        again = mesh_depth_maps(measured(room), room.views.__getitem__, MeshOptions())
    for expected, actual in zip(mesh, again, strict=True):
        np.testing.assert_array_equal(actual, expected)


def test_mesh_ignores_uncertain_wrong_map(room: PosedRoom) -> None:
    exact = measured(room)
    wrong = exact.images[1].depth
    vague = DepthPrior.from_arrays(wrong.depth * 1.04, (0.05 * wrong.depth) ** 2)
    images = list(exact.images)
    images[1] = replace(images[1], depth=vague)
    bent = replace(exact, images=tuple(images))
    mesh = mesh_depth_maps(bent, room.views.__getitem__, MeshOptions())
    to_truth = cKDTree(surface(room)).query(mesh.vertices)[0]
    assert np.median(to_truth) < 0.25 * 0.04 * np.median(wrong.depth)


def hole_distance(room: PosedRoom, points: np.ndarray) -> np.ndarray:
    """Return the distance (n,) of points to the center of a hole, in radii of the hole."""
    center = surface(room).reshape(-1, CAMERA.height, CAMERA.width, 3)[0, 20, 50]
    radius = 8 * room.truth["0.png"][20, 50] / CAMERA.fx
    distance: np.ndarray = np.linalg.norm(points - center, axis=-1) / radius
    return distance


def with_hole(room: PosedRoom, step: float = 1.0) -> Reconstruction:
    """Return true depth with an uncertain hole, 16 pixels wide, and a depth step around it."""
    distance = hole_distance(room, surface(room)).reshape(-1, CAMERA.height, CAMERA.width)
    images = []
    for image, hole in zip(measured(room, std=0.0).images, distance < 1, strict=True):
        depth, variance = image.depth.depth.copy(), np.asarray(image.depth.variance).copy()
        depth[hole] *= step
        variance[hole] = (0.3 * depth[hole]) ** 2
        images.append(replace(image, depth=DepthPrior.from_arrays(depth, variance)))
    return replace(room.reconstruction, images=tuple(images))


def test_mesh_closes_and_marks_hole_where_depth_continues(room: PosedRoom) -> None:
    mesh = mesh_depth_maps(with_hole(room), room.views.__getitem__, MeshOptions())
    distance, pixel = hole_distance(room, mesh.vertices), room.truth["0.png"][20, 50] / CAMERA.fx
    assert mesh.filled[distance < 0.8].all() and (distance < 0.8).sum() > 20
    assert not mesh.filled[(distance > 1.2) & (distance < 2)].any()
    assert mesh.filled_triangles.sum() > 20
    assert cKDTree(surface(room)).query(mesh.vertices[mesh.filled])[0].max() < 2 * pixel
    to_mesh = cKDTree(mesh.vertices).query(surface(room)[hole_distance(room, surface(room)) < 1])
    assert to_mesh[0].max() < 3 * pixel


@pytest.mark.parametrize(("max_hole_px", "step"), [(0, 1.0), (8, 1.0), (32, 0.8), (32, 1.25)])
def test_mesh_does_not_close_wide_hole_or_hole_with_step(
    room: PosedRoom, max_hole_px: float, step: float
) -> None:
    options = MeshOptions(max_hole_px=max_hole_px)
    mesh = mesh_depth_maps(with_hole(room, step), room.views.__getitem__, options)
    assert (hole_distance(room, mesh.vertices) > 0.7).all()


def test_find_seen_through_nearer_pixels_than_surface_excluded(room: PosedRoom) -> None:
    images = list(measured(room, std=0.0).images)
    masks = [np.ones(image.depth.shape, np.bool_) for image in images]
    voters = select_voters(images)
    assert np.mean(find_seen_through(images, voters, masks, masks, 0.02)[0]) < 0.1
    near = images[0].depth.depth.copy()
    near[10:20, 40:60] *= 0.8
    images[0] = replace(images[0], depth=DepthPrior.from_arrays(near, (0.3 * near) ** 2))
    seen_through = find_seen_through(images, select_voters(images), masks, masks, 0.02)[0]
    assert seen_through[10:20, 40:60].mean() > 0.9


def test_mesh_without_valid_pixels_raises(room: PosedRoom) -> None:
    none = [
        replace(i, depth=DepthPrior(i.depth.depth, i.depth.variance, np.zeros_like(i.depth.valid)))
        for i in room.reconstruction.images
    ]
    with pytest.raises(InputError, match="no pixel of the depth maps is certain"):
        mesh_depth_maps(
            replace(room.reconstruction, images=tuple(none)),
            room.views.__getitem__,
            MeshOptions(),
        )


def test_mesh_without_libraries_raises(room: PosedRoom, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "skimage.measure", None)
    with pytest.raises(InputError, match=r"mpsfm-core\[mesh\]"):
        mesh_depth_maps(measured(room), room.views.__getitem__, MeshOptions())


@pytest.fixture
def result(room: PosedRoom, tmp_path: Path) -> Path:
    """Create a folder with a model, depth maps with a hole, and images."""
    exact = with_hole(room)
    nothing = np.zeros((0, 2))
    cameras, colors = [colmap_from_pinhole(CAMERA)] * len(exact.images), np.zeros((0, 3), np.uint8)
    built = build_model(exact, cameras, [nothing] * len(exact.images), colors)
    write_model(tmp_path / "sparse", built)
    write_depth_maps(tmp_path / "depth", exact)
    (tmp_path / "images").mkdir()
    for name, view in room.views.items():
        cv2.imwrite(str(tmp_path / "images" / name), view.image[..., ::-1])
    return tmp_path


def read_gltf(path: Path) -> dict[str, Any]:
    data = path.read_bytes()
    described: dict[str, Any] = json.loads(data[20 : 20 + struct.unpack("<I", data[12:16])[0]])
    return described


def test_mesh_command_writes_ply_glb_and_obj(result: Path) -> None:
    done = CliRunner().invoke(build_app(), ["mesh", str(result), "--set", "max_triangles=2000"])
    assert done.exit_code == 0, done.output
    ply = trimesh.load(result / "mesh.ply", process=False)
    glb = trimesh.load(result / "mesh.glb", process=False)
    obj = trimesh.load(result / "mesh.obj", process=False)
    surface, holes = glb.geometry.values()
    assert 1000 < len(ply.faces) <= 2002 and len(surface.faces) + len(holes.faces) == len(ply.faces)
    assert ply.area == pytest.approx(surface.area + holes.area, rel=1e-4)
    filled = ply.metadata["_ply_raw"]["vertex"]["data"]["filled"].ravel() > 0
    assert filled[ply.faces].any(axis=1).sum() == len(holes.faces) > 0
    assert holes.visual.material.name == "closed_holes"
    assert obj.area == pytest.approx(ply.area, rel=1e-4)
    assert np.allclose(obj.bounds, ply.bounds, atol=1e-4)
    assert len(np.unique(ply.visual.vertex_colors, axis=0)) > 100
    texture = cv2.imread(str(result / "mesh.jpg"), cv2.IMREAD_COLOR_RGB)
    assert np.array_equal(texture, np.asarray(surface.visual.material.baseColorTexture))
    primitives = read_gltf(result / "mesh.glb")["meshes"][0]["primitives"]
    for primitive in primitives:
        assert primitive["mode"] == 4 and {"POSITION", "TEXCOORD_0"} == set(primitive["attributes"])
    textured = read_obj(result / "mesh.obj")
    assert textured.filled.sum() == len(holes.faces)
    # trimesh flips v, so its texture coordinates start at the lower left corner.
    read = textured.uv[textured.triangles[~textured.filled]]
    assert np.allclose(surface.visual.uv[surface.faces], read * (1, -1) + (0, 1), atol=1e-5)


def test_mesh_command_without_texture(result: Path) -> None:
    options = [f"--set={name}=0" for name in ("max_texture_size", "max_hole_px")]
    (result / "mesh.obj").write_text("old")
    done = CliRunner().invoke(build_app(), ["mesh", str(result), *options])
    assert done.exit_code == 0, done.output
    assert not (result / "mesh.obj").exists()
    [primitive] = read_gltf(result / "mesh.glb")["meshes"][0]["primitives"]
    assert {"POSITION", "COLOR_0"} == set(primitive["attributes"])


def test_mesh_command_without_depth_maps_fails(result: Path) -> None:
    for path in (result / "depth").iterdir():
        path.unlink()
    done = CliRunner().invoke(build_app(), ["mesh", str(result)])
    assert done.exit_code == 2 and "has no depth maps" in done.output


def test_find_observed_triangles_omits_hidden_and_reversed_triangles(room: PosedRoom) -> None:
    image = replace(room.reconstruction.images[0], rotation=np.eye(3), translation=np.zeros(3))
    square = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], np.float64)
    vertices = np.concatenate([0.3 * square + (0, 0, 3), 0.3 * square + (0, 0, 9)])
    front = np.array([[0, 2, 1], [0, 3, 2]])
    observed = find_observed_triangles(vertices, np.concatenate([front, front + 4]), [image])
    np.testing.assert_array_equal(observed, [True, True, False, False])
    assert not find_observed_triangles(vertices, front[:, ::-1], [image]).any()
