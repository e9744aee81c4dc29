"""Tests of written point clouds and depth maps, read with other libraries."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pycolmap
import pytest
import trimesh

from mpsfm_core.data import PinholeCamera
from mpsfm_core.data.errors import InputError
from mpsfm_core.geometry import pixel_centers, rays
from mpsfm_core.results.depth_maps import write_depth_maps
from mpsfm_core.results.ply import read_mesh, write_ply


def test_written_ply_is_read_by_pycolmap(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    points = rng.normal(size=(50, 3)).astype(np.float32).astype(np.float64)
    colors = rng.integers(0, 256, (50, 3)).astype(np.uint8)
    write_ply(tmp_path / "a.ply", points, colors)
    model = pycolmap.Reconstruction()
    model.import_PLY(str(tmp_path / "a.ply"))
    found = sorted((tuple(p.xyz), tuple(p.color)) for p in model.points3D.values())
    assert found == sorted((tuple(p), tuple(c)) for p, c in zip(points, colors, strict=True))


@pytest.mark.parametrize("encoding", ["ascii", "binary_little_endian"])
def test_triangles_of_other_libraries_are_read(tmp_path: Path, encoding: str) -> None:
    mesh = trimesh.creation.box()
    mesh.export(tmp_path / "a.ply", encoding=encoding.removesuffix("_little_endian"))
    assert f"format {encoding} 1.0" in (tmp_path / "a.ply").read_bytes().decode("latin-1")
    np.testing.assert_array_equal(read_mesh(tmp_path / "a.ply")[2], mesh.faces)


def test_mesh_of_colmaps_poisson_meshing_is_read(tmp_path: Path) -> None:
    sphere = trimesh.creation.icosphere(subdivisions=3)
    normals = np.asarray(sphere.vertex_normals, np.float32)
    gray = np.full((len(normals), 3), 128, np.uint8)
    write_ply(tmp_path / "a.ply", np.asarray(sphere.vertices), gray, normals)
    options = pycolmap.PoissonMeshingOptions(depth=5, trim=0.0)
    pycolmap.poisson_meshing(tmp_path / "a.ply", tmp_path / "b.ply", options)
    points, _, triangles = read_mesh(tmp_path / "b.ply")
    assert len(triangles) > 500
    radii = np.linalg.norm(points[triangles], axis=2)
    assert np.abs(radii - 1).max() < 0.1


def test_written_triangles_are_read_and_clouds_have_none(tmp_path: Path) -> None:
    points, colors = np.eye(3), np.zeros((3, 3), np.uint8)
    write_ply(tmp_path / "a.ply", points, colors, triangles=np.array([(0, 1, 2), (2, 1, 0)]))
    assert read_mesh(tmp_path / "a.ply")[2].tolist() == [[0, 1, 2], [2, 1, 0]]
    write_ply(tmp_path / "b.ply", points, colors)
    assert read_mesh(tmp_path / "b.ply")[2].shape == (0, 3)


def test_damaged_triangles_raise(tmp_path: Path) -> None:
    points, colors = np.eye(3), np.zeros((3, 3), np.uint8)
    write_ply(tmp_path / "a.ply", points, colors, triangles=np.array([(0, 1, 3)]))
    with pytest.raises(InputError, match="index of a missing vertex"):
        read_mesh(tmp_path / "a.ply")
    (tmp_path / "b.ply").write_bytes((tmp_path / "a.ply").read_bytes()[:-2])
    with pytest.raises(InputError, match="is cut off: the header has 1 faces"):
        read_mesh(tmp_path / "b.ply")


def test_empty_ply_has_a_header(tmp_path: Path) -> None:
    write_ply(tmp_path / "a.ply", np.zeros((0, 3)), np.zeros((0, 3), np.uint8))
    assert b"element vertex 0\n" in (tmp_path / "a.ply").read_bytes()


def test_depth_map_file_suffices_to_unproject_it(solved, tmp_path: Path) -> None:
    write_depth_maps(tmp_path, solved.best)
    for image in solved.best.images:
        with np.load(tmp_path / f"{image.name}.npz") as stored:
            data = dict(stored)
        height, width = data["depth"].shape
        assert {data[key].dtype for key in ("depth", "variance")} == {np.dtype(np.float32)}
        np.testing.assert_array_equal(data["depth"], image.depth.depth)
        camera = PinholeCamera(width, height, *data["camera"])
        local = rays(camera, pixel_centers(width, height)) * data["depth"][..., None]
        rotation, translation = data["cam_from_world"][:, :3], data["cam_from_world"][:, 3]
        world = (local[data["valid"]] - translation) @ rotation
        # The room is 6 x 5 x 2.6 m around the origin.
        assert (np.abs(world) < [3.01, 2.51, 2.61]).all()
        assert (world[:, 2] > -0.01).all()
