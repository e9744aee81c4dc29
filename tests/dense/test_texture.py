"""Tests of mesh textures from photos of a room with known surfaces."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from mpsfm_core.data import DepthPrior, PinholeCamera, View
from mpsfm_core.data.errors import InputError
from mpsfm_core.dense import texture
from mpsfm_core.dense.mesh import TriangleMesh, mesh_depth_maps
from mpsfm_core.dense.options import MeshOptions
from mpsfm_core.dense.seam_leveling import level_seams
from mpsfm_core.dense.texture import TexturedMesh, _pack, build_texture
from mpsfm_core.dense.texture_views import NO_VIEW, find_neighbors, select_texture_views
from mpsfm_core.geometry import sample_nearest, transform
from mpsfm_core.geometry.rasterization import rasterize
from mpsfm_core.mapping.scene.reconstruction import Reconstruction, RegisteredImage
from mpsfm_core.results.obj import read_obj, write_obj
from mpsfm_core.testing.posed_room import CAMERA, PosedRoom


@pytest.fixture(scope="module")
def exact(room: PosedRoom) -> Reconstruction:
    images = []
    for image in room.reconstruction.images:
        true = room.truth[image.name]
        images.append(replace(image, depth=DepthPrior.from_arrays(true, (0.001 * true) ** 2)))
    return replace(room.reconstruction, images=tuple(images))


@pytest.fixture(scope="module")
def mesh(room: PosedRoom, exact: Reconstruction) -> TriangleMesh:
    return mesh_depth_maps(exact, room.views.__getitem__, MeshOptions())


def render_texture(textured: TexturedMesh, image: RegisteredImage) -> tuple[np.ndarray, np.ndarray]:
    """Return the colors (h, w, 3) of the textured mesh in an image, and the covered pixels."""
    local = transform(image.rotation, image.translation, textured.vertices)
    depth, uv = rasterize(local, textured.uv, textured.triangles, CAMERA.params, CAMERA.size)
    xy = uv * textured.texture.shape[1::-1] - 0.5
    xy = xy.astype(np.float32)
    colors = cv2.remap(textured.texture, xy[..., 0], xy[..., 1], cv2.INTER_LINEAR)
    return colors.astype(float), np.isfinite(depth)


def color_error(room: PosedRoom, textured: TexturedMesh, image: RegisteredImage) -> float:
    colors, covered = render_texture(textured, image)
    return float(np.abs(colors - room.views[image.name].image)[covered].mean())


def test_texture_shows_the_photos(
    room: PosedRoom, exact: Reconstruction, mesh: TriangleMesh
) -> None:
    textured = build_texture(mesh, exact, room.views.__getitem__, 4096)
    assert textured.uv.min() >= 0 and textured.uv.max() <= 1
    assert len(textured.triangles) == len(mesh.triangles)
    for image in exact.images:
        local = transform(image.rotation, image.translation, mesh.vertices)
        depth, colors = rasterize(
            local, mesh.colors.astype(np.float32), mesh.triangles, CAMERA.params, CAMERA.size
        )
        photo = room.views[image.name].image
        vertex_error = np.abs(colors - photo)[np.isfinite(depth)].mean()
        assert color_error(room, textured, image) < 0.7 * vertex_error


def test_texture_is_not_larger_than_max_size(
    room: PosedRoom, exact: Reconstruction, mesh: TriangleMesh
) -> None:
    textured = build_texture(mesh, exact, room.views.__getitem__, 128)
    assert max(textured.texture.shape) <= 128
    errors = [color_error(room, textured, image) for image in exact.images]
    assert np.mean(errors) < 35


def seam_differences(textured: TexturedMesh) -> np.ndarray:
    """Return the color differences (n, 3) of the charts on both sides of the seams."""
    _, numbers = np.unique(textured.vertices, axis=0, return_inverse=True)
    order = np.argsort(numbers.ravel(), kind="stable")
    xy = textured.uv[order] * textured.texture.shape[1::-1]
    blurred = cv2.GaussianBlur(textured.texture, (0, 0), 2.0)
    colors = sample_nearest(blurred, xy).astype(float)
    same = numbers.ravel()[order][1:] == numbers.ravel()[order][:-1]
    differences: np.ndarray = np.abs(colors[1:] - colors[:-1])[same]
    return differences


def test_exposure_of_photos_is_leveled(
    room: PosedRoom, exact: Reconstruction, mesh: TriangleMesh, monkeypatch: pytest.MonkeyPatch
) -> None:
    views = dict(room.views)
    dark = (0.6 * views["0.png"].image).astype(np.uint8)
    views["0.png"] = View("0.png", dark, CAMERA)
    leveled = seam_differences(build_texture(mesh, exact, views.__getitem__, 4096))
    monkeypatch.setattr(texture, "level_seams", lambda colors, *_: np.zeros_like(colors))
    original = seam_differences(build_texture(mesh, exact, views.__getitem__, 4096))
    assert len(leveled) > 100
    assert np.mean(leveled) < 0.6 * np.mean(original)


def test_level_seams_makes_charts_equal() -> None:
    # Two charts of one triangle each share two mesh vertices.
    colors = np.repeat([[100.0], [120.0]], 3, axis=0).repeat(3, axis=1)
    vertices = np.array([0, 1, 2, 1, 2, 3])
    offsets = level_seams(colors, vertices, np.array([[0, 1, 2], [3, 4, 5]]))
    assert np.allclose(colors + offsets, 110, atol=0.1)


def test_neighbors_share_an_edge() -> None:
    triangles = np.array([[0, 1, 2], [2, 1, 3], [4, 5, 6]])
    assert find_neighbors(triangles).tolist() == [[-1, 1, -1], [0, -1, -1], [-1, -1, -1]]


def test_packed_rectangles_do_not_overlap() -> None:
    sizes = np.random.default_rng(0).integers(1, 40, (300, 2))
    origin, height = _pack(sizes, 256)
    used = np.zeros((height, 256), int)
    for (x, y), (w, h) in zip(origin, sizes, strict=True):
        used[y : y + h, x : x + w] += 1
    assert used.max() == 1 and used.sum() == sizes.prod(axis=1).sum()


def _square(z: float, half: float) -> np.ndarray:
    return np.array([[-half, -half, z], [half, -half, z], [half, half, z], [-half, half, z]])


def test_hidden_and_turned_triangles_have_no_view() -> None:
    camera = PinholeCamera(100, 100, 100.0, 100.0, 50.0, 50.0)
    vertices = np.concatenate([_square(2, 0.2), _square(4, 0.2), _square(5, 1.0)])
    front = np.array([[0, 3, 2], [0, 2, 1]])
    turned = (front + 8)[:, ::-1]
    triangles = np.concatenate([front, front + 4, turned])
    depth = DepthPrior.from_arrays(np.ones((100, 100), np.float32))
    image = RegisteredImage(
        0, "a.png", camera, np.eye(3), np.zeros(3), np.zeros(0, np.int64), depth, 1.0
    )
    black = View("a.png", np.zeros((100, 100, 3), np.uint8), camera)
    labels = select_texture_views(vertices, triangles, [image], {"a.png": black}.__getitem__)
    assert labels.tolist() == [0, 0, NO_VIEW, NO_VIEW, NO_VIEW, NO_VIEW]


@pytest.mark.parametrize(("blur_px", "chosen"), [(0.5, 1), (3.0, 0)])
def test_blurred_photo_is_chosen_only_if_it_is_much_nearer(blur_px: float, chosen: int) -> None:
    camera = PinholeCamera(100, 100, 100.0, 100.0, 50.0, 50.0)
    x, y = np.meshgrid(np.linspace(-0.4, 0.4, 9), np.linspace(-0.4, 0.4, 9))
    vertices = np.stack([x.ravel(), y.ravel(), np.full(81, 2.0)], axis=1)
    corners = np.arange(81).reshape(9, 9)
    a, b, c, d = (
        corners[row : row + 8, column : column + 8].ravel()
        for row, column in ((0, 0), (0, 1), (1, 0), (1, 1))
    )
    triangles = np.concatenate([np.stack([a, c, d], axis=1), np.stack([a, d, b], axis=1)])
    photo = np.random.default_rng(0).integers(0, 255, (100, 100, 3), np.uint8)
    photos = cv2.GaussianBlur(photo, (0, 0), 0.5), cv2.GaussianBlur(photo, (0, 0), blur_px)
    depth = DepthPrior.from_arrays(np.ones((100, 100), np.float32))
    images = [
        RegisteredImage(
            k, str(k), camera, np.eye(3), np.array([0, 0, shift]), np.zeros(0, np.int64), depth, 1.0
        )
        for k, shift in enumerate((0.0, -0.2))
    ]
    views = {str(k): View(str(k), picture, camera) for k, picture in enumerate(photos)}
    labels = select_texture_views(vertices, triangles, images, views.__getitem__)
    assert (labels == chosen).all()


def test_texture_that_is_too_small_is_an_error(
    room: PosedRoom, exact: Reconstruction, mesh: TriangleMesh
) -> None:
    with pytest.raises(InputError, match="max_texture_size"):
        build_texture(mesh, exact, room.views.__getitem__, 16)


def test_obj_is_read_as_written(tmp_path: Path) -> None:
    vertices = np.concatenate([_square(2, 0.5), _square(3, 0.5)])
    triangles = np.array([[0, 1, 2], [4, 5, 6]])
    uv = np.random.default_rng(0).uniform(size=(8, 2)).astype(np.float32)
    picture, filled = np.full((20, 30, 3), (200, 100, 50), np.uint8), np.array([False, True])
    write_obj(tmp_path / "a.obj", TexturedMesh(vertices, triangles, uv, picture, filled))
    mesh = read_obj(tmp_path / "a.obj")
    assert np.allclose(mesh.vertices[mesh.triangles], vertices[triangles])
    assert np.allclose(mesh.uv[mesh.triangles], uv[triangles], atol=1e-6)
    assert np.abs(mesh.texture.astype(int) - picture).max() < 4
    assert mesh.filled.tolist() == filled.tolist()
    assert (tmp_path / "a.obj").read_text().count("usemtl closed_holes") == 1


def test_obj_with_quads_and_negative_indices_is_read(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "t.png"), np.zeros((4, 4, 3), np.uint8))
    (tmp_path / "m.mtl").write_text("newmtl a\nmap_Kd t.png\n")
    text = "mtllib m.mtl\nv 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvt 0 0\nvt 1 0\n"
    (tmp_path / "a.obj").write_text(f"{text}usemtl a\nf 1/1/1 2/2/1 3/-1/1 -1/1/1\n")
    mesh = read_obj(tmp_path / "a.obj")
    corners = mesh.vertices[mesh.triangles]
    assert corners.tolist() == [
        [[0, 0, 0], [1, 0, 0], [1, 1, 0]],
        [[0, 0, 0], [1, 1, 0], [0, 1, 0]],
    ]
    assert mesh.uv[mesh.triangles][0].tolist() == [[0, 1], [1, 1], [1, 1]]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("v 0 0 0\n", "has no faces"),
        ("v 0 0 0\nf 1 1 1\n", "not an OBJ file with texture coordinates"),
        ("v 0 0 0\nvt 0 0\nf 1/1 2/1 1/1\n", "without vertex"),
        ("mtllib no.mtl\nv 0 0 0\nvt 0 0\nf 1/1 1/1 1/1\n", "no.mtl: No such file"),
    ],
)
def test_wrong_obj_is_an_error(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "a.obj").write_text(text)
    with pytest.raises(InputError, match=message):
        read_obj(tmp_path / "a.obj")
