"""Tests of rendering and of the evaluation with held-out photos."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh
from typer.testing import CliRunner

from mpsfm_core.cli import build_app
from mpsfm_core.data import DepthPrior, PinholeCamera, View
from mpsfm_core.data.errors import InputError
from mpsfm_core.geometry import pixel_centers, rays, unproject
from mpsfm_core.geometry.pycolmap_conversion import colmap_from_pinhole
from mpsfm_core.geometry.rendering import Geometry, Rendering, render
from mpsfm_core.mapping.scene.reconstruction import MappingReport, MappingResult, hold_out
from mpsfm_core.results.colmap_model import build_model, write_model
from mpsfm_core.results.depth_maps import write_depth_maps
from mpsfm_core.results.held_out import compare_rendering, evaluate_held_out
from mpsfm_core.results.ply import read_ply, write_ply
from mpsfm_core.testing.posed_room import CAMERA, PosedRoom

IDENTITY = (np.eye(3), np.zeros(3))
NO_TRIANGLES = np.zeros((0, 3), np.int64)


def cast_rays(triangles: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Return the nearest z-depth along rays from the origin [Moeller and Trumbore 1997]."""
    a, b, c = (triangles[:, None, i] for i in range(3))
    normal = np.cross(directions[None], c - a)
    determinant = np.sum((b - a) * normal, axis=-1)
    u = np.sum(-a * normal, axis=-1) / determinant
    q = np.cross(-a, b - a)
    v = np.sum(directions[None] * q, axis=-1) / determinant
    distance = np.sum((c - a) * q, axis=-1) / determinant
    hit = (u >= 0) & (v >= 0) & (u + v <= 1) & (distance > 0)
    return np.where(hit, distance * directions[None, :, 2], np.inf).min(axis=0)


def test_rendered_mesh_agrees_with_ray_casting() -> None:
    mesh = trimesh.creation.icosphere(subdivisions=2)
    mesh.apply_translation((0.2, -0.1, 4.0))
    camera = PinholeCamera(48, 36, 60.0, 55.0, 20.0, 21.0)
    colors = np.arange(len(mesh.vertices) * 3).reshape(-1, 3).astype(np.uint8)
    rendering = render(Geometry(mesh.vertices, colors, mesh.faces), camera, IDENTITY)
    directions = rays(camera, pixel_centers(48, 36).reshape(-1, 2))
    depth = cast_rays(mesh.triangles, directions)
    agree = np.isfinite(depth) == rendering.covered.ravel()
    assert agree.mean() > 0.999 and rendering.covered.sum() > 300
    both = np.isfinite(depth) & rendering.covered.ravel()
    np.testing.assert_allclose(rendering.depth.ravel()[both], depth[both], rtol=1e-5)


def test_vertex_colors_are_interpolated_with_perspective() -> None:
    # The square is slanted, so the middle of its image is not the middle of the square.
    points = np.array([(-1.0, -1, 2), (1, -1, 6), (1, 1, 6), (-1, 1, 2)])
    colors = np.array([(0, 0, 0), (200, 0, 0), (200, 0, 0), (0, 0, 0)], np.uint8)
    camera = PinholeCamera(101, 101, 100.0, 100.0, 50.5, 50.5)
    triangles = np.array([(0, 1, 2), (0, 2, 3)])
    rendering = render(Geometry(points, colors, triangles), camera, IDENTITY)
    covered = rendering.covered[50]
    pixels = pixel_centers(101, 101)[50, covered]
    expected = 100 * (unproject(camera, pixels, rendering.depth[50, covered])[:, 0] + 1)
    np.testing.assert_allclose(rendering.colors[50, covered, 0], expected, atol=1e-2)


def test_texture_is_sampled_with_perspective() -> None:
    points = np.array([(-1.0, -1, 2), (1, -1, 6), (1, 1, 6), (-1, 1, 2)])
    uv = np.array([(0, 0), (1, 0), (1, 1), (0, 1)], np.float32)
    ramp = np.repeat(np.arange(200, dtype=np.uint8)[None, :, None], 3, axis=2).repeat(50, axis=0)
    camera = PinholeCamera(101, 101, 100.0, 100.0, 50.5, 50.5)
    gray = np.zeros((4, 3), np.uint8)
    square = Geometry(points, gray, np.array([(0, 1, 2), (0, 2, 3)]), uv, ramp)
    rendering = render(square, camera, IDENTITY)
    covered = rendering.covered[50]
    pixels = pixel_centers(101, 101)[50, covered]
    x = unproject(camera, pixels, rendering.depth[50, covered])[:, 0]
    np.testing.assert_allclose(rendering.colors[50, covered, 0], 100 * (x + 1) - 0.5, atol=2.5)


def test_nearest_point_covers_a_square() -> None:
    points = np.array([(0.0, 0, 2), (0, 0, 4)])
    colors = np.array([(9, 8, 7), (1, 2, 3)], np.uint8)
    camera = PinholeCamera(21, 21, 20.0, 20.0, 10.5, 10.5)
    rendering = render(
        Geometry(points, colors, NO_TRIANGLES), camera, IDENTITY, np.array([0.1, 1.0])
    )
    near = rendering.depth == 2
    assert near.sum() == 9 and near[9:12, 9:12].all()  # 20 px / 2 * 0.1 = 1 px on each side
    assert rendering.depth[np.isfinite(rendering.depth) & ~near].tolist() == [4.0] * (11 * 11 - 9)
    assert np.allclose(rendering.colors[near], (9, 8, 7))


def test_points_of_one_surface_are_blended() -> None:
    points = np.array([(-0.05, 0, 2), (0.05, 0, 2.05), (0, 0, 3)])
    colors = np.array([(100, 0, 0), (200, 0, 0), (0, 255, 0)], np.uint8)
    camera = PinholeCamera(21, 21, 20.0, 20.0, 10.5, 10.5)
    rendering = render(Geometry(points, colors, NO_TRIANGLES), camera, IDENTITY, np.full(3, 0.1))
    red, green, _ = rendering.colors[10, 10]
    assert red == pytest.approx(150, abs=2) and green == 0


def test_points_behind_the_camera_are_invisible() -> None:
    points = np.array([(0.0, 0, -2), (1, 0, -2), (0, 1, -2)])
    colors = np.zeros((3, 3), np.uint8)
    for triangles in (NO_TRIANGLES, np.array([(0, 1, 2)])):
        assert not render(Geometry(points, colors, triangles), CAMERA, IDENTITY).covered.any()


def photo(seed: int = 0) -> np.ndarray:
    noise = np.random.default_rng(seed).integers(0, 255, (15, 20, 3), np.uint8)
    return cv2.resize(noise, CAMERA.size, interpolation=cv2.INTER_CUBIC)


def test_comparison_ignores_exposure_but_not_content() -> None:
    image, depth = photo(), np.ones(photo().shape[:2], np.float32)
    view = View("a.png", image, CAMERA)
    dark = compare_rendering(Rendering(0.5 * image.astype(np.float32) + 20, depth), view)
    other = compare_rendering(Rendering(photo(1).astype(np.float32), depth), view)
    assert dark["psnr"] is not None and dark["psnr"] > 60 and dark["covered"] == 1
    assert dark["ssim"] == pytest.approx(1, abs=1e-3)
    assert other["psnr"] is not None and other["psnr"] < 20
    assert other["ssim"] is not None and other["ssim"] < 0.5


def test_comparison_measures_coverage_and_depth() -> None:
    depth = np.full((120, 160), 3.0, np.float32)
    depth[:, 80:] = np.inf
    mask = np.ones((120, 160), np.bool_)
    mask[60:] = False
    view = View("a.png", photo(), CAMERA, mask)
    known = DepthPrior.from_arrays(np.full((60, 80), 2.5, np.float32))
    metrics = compare_rendering(Rendering(photo().astype(np.float32), depth), view, known)
    assert metrics["covered"] == 0.5
    assert metrics["depth_error"] == pytest.approx(0.2) and metrics["depth_close"] == 0
    empty = Rendering(np.zeros((120, 160, 3), np.float32), np.full_like(depth, np.inf))
    assert compare_rendering(empty, view, known) == {
        "covered": 0,
        **dict.fromkeys(("psnr", "ssim", "depth_error", "depth_close")),
    }


@pytest.fixture(scope="module")
def result_folder(room: PosedRoom, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a result folder with a cloud of true depth from all images but the held-out one."""
    folder = tmp_path_factory.mktemp("result")
    model = hold_out(MappingResult((room.reconstruction,), MappingReport()), 4).reconstructions[0]
    assert [image.name for image in model.images if image.held_out] == ["0.png"]
    assert [image.name for image in model.dense_images] == ["1.png", "2.png", "3.png"]
    points, colors = [], []
    for image in model.images:
        path = folder / "images" / image.name
        path.parent.mkdir(exist_ok=True)
        cv2.imwrite(str(path), room.views[image.name].image[..., ::-1])
        if not image.held_out:
            depth = room.truth[image.name]
            local = unproject(CAMERA, pixel_centers(*CAMERA.size), depth).reshape(-1, 3)
            points.append((local - image.translation) @ image.rotation)
            colors.append(room.views[image.name].image.reshape(-1, 3))
    write_ply(folder / "dense.ply", np.concatenate(points), np.concatenate(colors))
    cameras, no_pixels = [colmap_from_pinhole(CAMERA)] * 4, [np.zeros((0, 2))] * 4
    built = build_model(model, cameras, no_pixels, np.zeros((0, 3), np.uint8))
    write_model(folder / "sparse", built)
    write_depth_maps(folder / "depth", model)
    images = {"held_out": ["0.png"], "unconfirmed": {}}
    summary = {"format_version": 1, "status": "success", "images": images}
    (folder / "summary.json").write_text(json.dumps(summary))
    return folder


def test_command_renders_recorded_held_out_photos(result_folder: Path, room: PosedRoom) -> None:
    output = CliRunner().invoke(build_app(), ["evaluate", str(result_folder), "--held-out"])
    assert output.exit_code == 0, output.output
    report = json.loads(output.stdout)["held_out"]
    assert report["images"] == ["0.png"] and report["independent"] is True
    cloud = report["geometries"]["dense.ply"]
    # The depth map of the held-out photo has a relative std of 15 %; the cloud has none.
    true = room.truth["0.png"]
    wrong = room.reconstruction.images[0].depth.depth
    assert cloud["depth_error"] == pytest.approx(np.median(np.abs(true / wrong - 1)), abs=0.01)
    assert cloud["covered"] > 0.9 and cloud["psnr"] > 17
    assert cloud["per_image"]["0.png"]["psnr"] == cloud["psnr"]


def test_worse_geometry_renders_worse(result_folder: Path, tmp_path: Path) -> None:
    points, colors = read_ply(result_folder / "dense.ply")
    write_ply(tmp_path / "shifted.ply", points + 0.2, colors)
    good, bad = (
        evaluate_held_out(result_folder, geometry=path)["geometries"][path.name]
        for path in (result_folder / "dense.ply", tmp_path / "shifted.ply")
    )
    assert good["psnr"] > bad["psnr"] + 3 and good["ssim"] > bad["ssim"] + 0.1


def test_photos_of_the_geometry_are_not_called_independent(result_folder: Path) -> None:
    report = evaluate_held_out(result_folder, names=["0.png", "1.png"])
    assert report["images"] == ["0.png", "1.png"] and report["independent"] is False
    foreign = evaluate_held_out(result_folder, geometry=result_folder / "dense.ply")
    assert foreign["independent"] is None


def test_missing_input_is_named(result_folder: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"no pose for photo '7\.png'; did you mean"):
        evaluate_held_out(result_folder, names=["7.png"])
    empty = tmp_path / "empty.ply"
    write_ply(empty, np.zeros((0, 3)), np.zeros((0, 3), np.uint8))
    with pytest.raises(InputError, match="no points to render"):
        evaluate_held_out(result_folder, geometry=empty)
    run = CliRunner().invoke(build_app(), ["evaluate", str(result_folder)])
    assert run.exit_code == 2 and "GT is missing" in run.output
