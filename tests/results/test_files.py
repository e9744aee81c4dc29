"""Tests of written point clouds and depth maps, read with other libraries."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pycolmap

from mpsfm_core.data import PinholeCamera
from mpsfm_core.geometry import pixel_centers, rays
from mpsfm_core.results.depth_maps import write_depth_maps
from mpsfm_core.results.ply import write_ply


def test_written_ply_is_read_by_pycolmap(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    points = rng.normal(size=(50, 3)).astype(np.float32).astype(np.float64)
    colors = rng.integers(0, 256, (50, 3)).astype(np.uint8)
    write_ply(tmp_path / "a.ply", points, colors)
    model = pycolmap.Reconstruction()
    model.import_PLY(str(tmp_path / "a.ply"))
    found = sorted((tuple(p.xyz), tuple(p.color)) for p in model.points3D.values())
    assert found == sorted((tuple(p), tuple(c)) for p, c in zip(points, colors, strict=True))


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
