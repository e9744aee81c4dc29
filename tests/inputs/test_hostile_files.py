"""Tests that each damaged or malicious input file causes one error that names the file.

Damaged photos are tested in test_images.py and test_pixels.py. MP-SfM never reads GLB files; these
tests pass GLB files where another format is expected.
"""

from __future__ import annotations

import json
import sqlite3
import struct
from collections.abc import Callable
from pathlib import Path

import cv2
import h5py
import numpy as np
import pycolmap
import pytest

from mpsfm_core.data.errors import InputError
from mpsfm_core.inputs.images import load_images
from mpsfm_core.inputs.intrinsics import read_intrinsics
from mpsfm_core.inputs.matches import matches_from_database, matches_from_hloc
from mpsfm_core.inputs.models import read_model
from mpsfm_core.inputs.nerfstudio import read_transforms
from mpsfm_core.inputs.options import InputOptions, VideoOptions
from mpsfm_core.inputs.video import choose_frames
from mpsfm_core.report.viewing import read_scene
from mpsfm_core.results.exports.source import ExportSource
from mpsfm_core.results.ply import read_ply

NAMES = ("0.png", "1.png")
Damage = Callable[[Path], object]


@pytest.fixture(scope="module")
def photos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("photos")
    picture = np.random.default_rng(0).integers(0, 255, (48, 64, 3)).astype(np.uint8)
    for name in NAMES:
        cv2.imwrite(str(folder / name), picture)
    return folder


def refused(load: Callable[[], object], path: Path) -> None:
    with pytest.raises(InputError) as caught:
        load()
    message = str(caught.value)
    assert path.name in message
    assert len(message) < 600
    assert "Traceback" not in message


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def emptied(path: Path) -> None:
    path.write_bytes(b"")


def text_instead(path: Path) -> None:
    path.write_text("<html>404</html>\n" * 100)


def noise_instead(path: Path) -> None:
    path.write_bytes(np.random.default_rng(1).bytes(20_000))


def noise_inside(path: Path) -> None:
    data = bytearray(path.read_bytes())
    data[len(data) // 4 :] = np.random.default_rng(1).bytes(len(data) - len(data) // 4)
    path.write_bytes(data)


def sql(statement: str) -> Damage:
    def damage(path: Path) -> None:
        with sqlite3.connect(path) as database:
            database.execute(statement)
        database.close()

    return damage


def good_database(path: Path) -> None:
    with pycolmap.Database.open(str(path)) as database:
        camera = pycolmap.Camera(model="PINHOLE", width=64, height=48, params=[60, 60, 32, 24])
        camera_id = database.write_camera(camera)
        ids = [database.write_image(pycolmap.Image(name=n, camera_id=camera_id)) for n in NAMES]
        xy = np.random.default_rng(0).uniform(5, 40, (30, 2)).astype(np.float32)
        for number in ids:
            database.write_keypoints(number, xy)
        rows = np.repeat(np.arange(30, dtype=np.uint32)[:, None], 2, axis=1)
        database.write_matches(*ids, rows)


@pytest.mark.parametrize(
    "damage",
    [
        emptied,
        text_instead,
        noise_instead,
        cut,
        noise_inside,
        sql("DROP TABLE keypoints"),
        sql("UPDATE keypoints SET rows = 1000000000"),
        sql("UPDATE keypoints SET data = NULL"),
        sql("UPDATE keypoints SET rows = 'many'"),
        sql("UPDATE keypoints SET data = zeroblob(239) || x'ff', rows = 30"),
        sql("UPDATE cameras SET model = 99"),
        sql("UPDATE cameras SET params = x'00'"),
        sql("UPDATE cameras SET width = -1"),
        sql("UPDATE images SET camera_id = 7"),
        sql("UPDATE images SET name = 'other.png' || image_id"),
        sql("UPDATE matches SET data = x'ffffffff00000000', rows = 1"),
        sql("UPDATE matches SET cols = 3, rows = 20"),
        sql("DELETE FROM matches"),
    ],
    ids=lambda damage: getattr(damage, "__name__", ""),
)
def test_damaged_database_raises(photos: Path, tmp_path: Path, damage: Damage) -> None:
    path = tmp_path / "matches.db"
    good_database(path)
    images = load_images(photos)
    assert len(matches_from_database(path, images).matches[0, 1]) == 30
    damage(path)
    refused(lambda: matches_from_database(path, images), path)


def test_missing_database_raises(photos: Path, tmp_path: Path) -> None:
    path = tmp_path / "matches.db"
    refused(lambda: read_intrinsics(path), path)
    assert not path.exists()


def features(change: Callable[[h5py.File], object]) -> Damage:
    def damage(path: Path) -> None:
        with h5py.File(path, "a") as file:
            change(file)

    return damage


def replaced(name: str, value: object) -> Damage:
    def change(file: h5py.File) -> None:
        del file[name]
        file[name] = value

    return features(change)


@pytest.mark.parametrize(
    ("file", "damage"),
    [
        ("feats.h5", emptied),
        ("feats.h5", text_instead),
        ("feats.h5", cut),
        ("feats.h5", replaced("0.png/keypoints", np.zeros((30, 3)))),
        ("feats.h5", replaced("0.png/keypoints", np.full((30, 2), np.nan))),
        ("feats.h5", replaced("0.png/keypoints", "none")),
        ("feats.h5", replaced("0.png/image_size", np.array([640, 480]))),
        ("feats.h5", replaced("0.png/image_size", np.array([np.nan, 1]))),
        ("feats.h5", features(lambda f: f["0.png/keypoints"].attrs.create("uncertainty", -1.0))),
        ("feats.h5", features(lambda f: [f.move(name, f"x{name}") for name in NAMES])),
        ("matches.h5", noise_instead),
        ("matches.h5", cut),
        ("matches.h5", replaced("0.png/1.png/matches0", np.zeros(30))),
        ("matches.h5", replaced("0.png/1.png/matches0", np.arange(1000))),
        ("matches.h5", replaced("0.png/1.png/matches0", np.full(30, 30))),
        ("matches.h5", replaced("0.png/1.png/matching_scores0", np.zeros(7))),
        ("matches.h5", replaced("0.png/1.png/matching_scores0", np.full(30, np.inf))),
        ("matches.h5", features(lambda f: f.clear())),
    ],
)
def test_damaged_hloc_files_raise(photos: Path, tmp_path: Path, file: str, damage: Damage) -> None:
    xy = np.random.default_rng(0).uniform(5, 40, (30, 2))
    with h5py.File(tmp_path / "feats.h5", "w") as written:
        for name in NAMES:
            written[f"{name}/keypoints"] = xy
            written[f"{name}/image_size"] = np.array([64, 48])
    with h5py.File(tmp_path / "matches.h5", "w") as written:
        written["0.png/1.png/matches0"] = np.arange(30)
        written["0.png/1.png/matching_scores0"] = np.ones(30)
    paths = tmp_path / "feats.h5", tmp_path / "matches.h5"
    images = load_images(photos)
    assert len(matches_from_hloc(*paths, images).matches[0, 1]) == 30
    damage(tmp_path / file)
    refused(lambda: matches_from_hloc(*paths, images), tmp_path / file)


FRAME = {
    "file_path": "0.png",
    "transform_matrix": np.eye(4).tolist(),
    **{"w": 64, "h": 48, "fl_x": 60},
}


@pytest.mark.parametrize(
    "content",
    [
        "",
        "\x00\x01\x02",
        "{",
        "[" * 100_000,
        "null",
        json.dumps({"frames": {}}),
        json.dumps({"frames": [7]}),
        json.dumps({"frames": [{**FRAME, "transform_matrix": [[1, 2], [3]]}]}),
        json.dumps({"frames": [{**FRAME, "transform_matrix": (1e300 * np.eye(4)).tolist()}]}),
        json.dumps({"frames": [{**FRAME, "transform_matrix": np.full((4, 4), np.nan).tolist()}]}),
        json.dumps({"frames": [{**FRAME, "fl_x": "wide"}]}),
        json.dumps({"frames": [{**FRAME, "fl_x": -5}]}),
        json.dumps({"frames": [{**FRAME, "w": 1e30}]}),
        json.dumps({"frames": [FRAME, FRAME]}),
    ],
    ids=range(14),
)
def test_damaged_transforms_raise(tmp_path: Path, content: str) -> None:
    path = tmp_path / "transforms.json"
    path.write_text(content)
    refused(lambda: read_transforms(path), path)


@pytest.mark.parametrize("damage", [emptied, text_instead, noise_instead, noise_inside])
@pytest.mark.parametrize("name", ["v.avi", "v.mp4"])
def test_damaged_videos_raise(tmp_path: Path, name: str, damage: Damage) -> None:
    path = tmp_path / name
    codec = cv2.VideoWriter_fourcc(*("MJPG" if name == "v.avi" else "mp4v"))
    writer = cv2.VideoWriter(str(path), codec, 10, (64, 48))
    for _ in range(10):
        writer.write(np.zeros((48, 64, 3), np.uint8))
    writer.release()
    damage(path)
    refused(lambda: choose_frames(path, VideoOptions()), path)


@pytest.mark.parametrize("damage", [emptied, text_instead, cut, noise_inside])
def test_damaged_mask_raises(photos: Path, tmp_path: Path, damage: Damage) -> None:
    mask = tmp_path / "0.png.png"
    cv2.imwrite(str(mask), np.random.default_rng(0).integers(0, 255, (48, 64)).astype(np.uint8))
    damage(mask)
    refused(lambda: load_images(photos, options=InputOptions(masks=tmp_path)), mask)


def test_mask_of_another_size_raises(photos: Path, tmp_path: Path) -> None:
    mask = tmp_path / "0.png.png"
    cv2.imwrite(str(mask), np.zeros((10, 10), np.uint8))
    refused(lambda: load_images(photos, options=InputOptions(masks=tmp_path)), mask)


@pytest.mark.parametrize("suffix", [".heic", ".dng"])
@pytest.mark.parametrize("damage", [emptied, text_instead, noise_instead])
def test_damaged_heic_and_raw_photos_raise(tmp_path: Path, suffix: str, damage: Damage) -> None:
    for number in range(2):
        damage(tmp_path / f"{number}{suffix}")
    refused(lambda: load_images(tmp_path), tmp_path / f"0{suffix}")


@pytest.fixture
def result(model: pycolmap.Reconstruction, tmp_path: Path) -> Path:
    model.write_binary(str(tmp_path))
    name = model.images[1].name
    (tmp_path / "depth" / name).parent.mkdir(parents=True, exist_ok=True)
    ones = np.ones((3, 4), np.float32)
    np.savez(
        tmp_path / "depth" / f"{name}.npz",
        depth=ones,
        variance=ones,
        valid=ones > 0,
        camera=np.array([4.0, 4.0, 2.0, 1.5]),
        cam_from_world=np.eye(4)[:3],
    )
    return tmp_path


def objects_inside(path: Path) -> None:
    np.savez(path, depth=np.array([print], dtype=object))


def negative(path: Path) -> None:
    ones = np.ones((3, 4), np.float32)
    np.savez(path, depth=-ones, variance=ones, valid=ones > 0, camera=np.ones(4))


@pytest.mark.parametrize(
    "damage", [emptied, text_instead, cut, noise_inside, objects_inside, negative]
)
def test_damaged_depth_map_of_results_raises(result: Path, damage: Damage) -> None:
    (path,) = (result / "depth").rglob("*.npz")
    name = path.relative_to(result / "depth").as_posix().removesuffix(".npz")
    assert ExportSource.read(result).maps(name) is not None
    damage(path)
    refused(lambda: ExportSource.read(result).maps(name), path)


@pytest.mark.parametrize("content", ["", "{", "[]", '{"status": "failed"}', "[" * 100_000])
def test_damaged_summary_raises(result: Path, content: str) -> None:
    (result / "summary.json").write_text(content)
    refused(lambda: ExportSource.read(result), result / "summary.json")


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"ply\nformat ascii 1.0\nend_header\n",
        b"ply\nformat binary_little_endian 1.0\nelement vertex 999999999\nproperty float x\n"
        b"property float y\nproperty float z\nend_header\n\x00",
        b"ply\nformat binary_little_endian 1.0\nelement vertex 1\nproperty float x\nend_header\n",
        b"ply\nformat binary_little_endian 1.0\nelement vertex 1\nproperty float x\n"
        b"property float y\nproperty float z\nend_header\n\xff\xff\xff\xff\x00\x00\x00\x00"
        + bytes(4),
        b"ply\nformat binary_little_endian 1.0\nelement vertex 1\nproperty float x\n"
        b"property float x\nproperty float y\nproperty float z\nend_header\n" + bytes(16),
    ],
    ids=range(6),
)
def test_damaged_point_cloud_raises(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "dense.ply"
    path.write_bytes(content)
    refused(lambda: read_ply(path), path)


GLB_READERS: dict[str, Callable[[Path], object]] = {
    "photos.glb": load_images,
    "model.glb": read_model,
    "result.glb": ExportSource.read,
    "scene.glb": read_scene,
    "intrinsics.glb": read_intrinsics,
    "intrinsics.db": read_intrinsics,
    "transforms.json": read_transforms,
    "cloud.ply": read_ply,
    "video.mp4": lambda path: choose_frames(path, VideoOptions()),
}


def untouched(path: Path) -> None:
    """Leave the file unchanged: well-formed, but of another format than the reader expects."""


@pytest.mark.parametrize("damage", [untouched, emptied, cut, noise_inside])
@pytest.mark.parametrize("name", GLB_READERS)
def test_glb_file_in_place_of_other_formats_raises(
    tmp_path: Path, name: str, damage: Damage
) -> None:
    text = b'{"asset": {"version": "2.0"}, "meshes": [{"primitives": [{"attributes": {}}]}]}'
    text += b" " * (-len(text) % 4)
    path = tmp_path / name
    path.write_bytes(
        struct.pack("<4sII", b"glTF", 2, 28 + len(text) + 8)
        + struct.pack("<I4s", len(text), b"JSON")
        + text
        + struct.pack("<I4s", 8, b"BIN\0")
        + b"\xff" * 8
    )
    damage(path)
    refused(lambda: GLB_READERS[name](path), path)
