"""Tests that no malformed file can crash a file reader, block it or exhaust its memory."""

from __future__ import annotations

import contextlib
import io
import json
import logging
import shutil
import sqlite3
import struct
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mpsfm_core.config import load_config
from mpsfm_core.data import DepthPrior
from mpsfm_core.data.errors import InputError, MpsfmError, WeightsError
from mpsfm_core.evaluation.prior_quality import read_depth
from mpsfm_core.evaluation.records import read_record
from mpsfm_core.evaluation.scene_folder import _read_sets
from mpsfm_core.extraction.cache import Cache, content_key
from mpsfm_core.inputs.image_header import is_cut_jpeg, read_declared_num_pixels, read_header
from mpsfm_core.inputs.image_search import read_image_list
from mpsfm_core.inputs.images import load_images
from mpsfm_core.inputs.intrinsics import read_intrinsics
from mpsfm_core.inputs.models import read_model, read_poses
from mpsfm_core.mapping.state import flatten_state, unflatten_state
from mpsfm_core.pipeline import checkpoints
from mpsfm_core.providers.builtin.map_files import read_arrays
from mpsfm_core.providers.registry import Registry
from mpsfm_core.providers.uncertainty.calibration_file import read_values
from mpsfm_core.providers.weights import WeightStore
from mpsfm_core.report.page import write_report
from mpsfm_core.results.depth_maps import read_depth_map
from mpsfm_core.results.exports.formats import export
from mpsfm_core.results.ply import read_ply
from mpsfm_core.support import npz
from mpsfm_core.support.yaml_text import parse_yaml

from .mutation import WELL_FORMED, failures
from .readers import GOLDEN, TABLES, intrinsics, model_files, of_others, poses, used

QUICK, SLOW, FURTHER = 12, 110, 25

_IMAGE = np.random.default_rng(0).integers(0, 255, (24, 32, 3), dtype=np.uint8)
_TAGS = [(0x0112, 3, 1, 6), (0xA405, 3, 1, 28)]
_EXIF = b"Exif\0\0II*\0" + struct.pack("<IH", 8, len(_TAGS))
_EXIF += b"".join(struct.pack("<HHII", *tag) for tag in _TAGS) + bytes(4)


def encoded(suffix: str) -> bytes:
    image = np.tile(_IMAGE, (4, 4, 1)) if suffix == ".jp2" else _IMAGE
    return cv2.imencode(suffix, image)[1].tobytes()


def with_exif() -> bytes:
    data = encoded(".jpg")
    return data[:2] + b"\xff\xe1" + struct.pack(">H", len(_EXIF) + 2) + _EXIF + data[2:]


def archive(**arrays: Any) -> bytes:
    file = io.BytesIO()
    np.savez(file, **arrays)
    return file.getvalue()


def as_photo(path: Path) -> None:
    """Read a mutated file as one of three photos."""
    for name in ("a.png", "b.png"):
        (path.parent / name).write_bytes(encoded(".png"))
    found = load_images(path.parent)
    for index in range(len(found)):
        found.view(index)


def as_config(registry: Registry) -> Callable[[Path], object]:
    return lambda path: load_config(path, registry=registry)


def as_cache_entry(path: Path) -> None:
    cache, key = Cache(path.parent), content_key(1)
    place = cache.folder / "depth" / key[:2] / f"{key}.npz"
    place.parent.mkdir(parents=True, exist_ok=True)
    path.replace(place)
    cache.load("depth", key, DepthPrior)


def as_state(path: Path) -> None:
    """Read a mutated file as a checkpoint of a mapping problem."""
    unflatten_state(checkpoints.read_checkpoint(path)[1])


def as_hashes(path: Path) -> None:
    store = WeightStore(path.parent, offline=True)
    store.cache_dir.mkdir(exist_ok=True)
    path.replace(store.cache_dir / "hashes.json")
    store.resolve("https://example.org/a.onnx")


def as_onnx(path: Path) -> None:
    from mpsfm_onnx.model import _open

    from mpsfm_core.providers import ProviderContext

    _open(path, ProviderContext(lambda uri, sha256=None: Path(uri), "cpu", 1, 0))


_TRANSFORMS = json.dumps(
    {
        "fl_x": 30.0, "fl_y": 30.0, "cx": 16.0, "cy": 12.0, "w": 32, "h": 24,
        "camera_model": "OPENCV", "k1": 0.1,
        "frames": [
            {"file_path": f"{n}.png", "transform_matrix": np.eye(4).tolist()} for n in range(3)
        ],
    }
).encode()  # fmt: skip
_CONFIG = b"extends: default\nfeatures: {use: sift}\nmatcher: {use: mutual-nearest}\n\
depth:\n  use: files\n  options: {directory: /tmp, relative_std: 0.02}\n\
normals: {use: from-depth}\nruntime: {workers: 1, seed: 3}\nmapping:\n  max_runs: 2\n"
_PLY = b"ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty float y\n\
property float z\nend_header\n0 0 1\n1 2 3\n"
_PLY_BINARY = _PLY[: _PLY.index(b"0 0 1")].replace(b"ascii", b"binary_little_endian") + bytes(24)
_RECORD = json.dumps({
    "scene": "a", "bucket": "b", "index": 0, "method": "m", "estimated": {"a": list(range(12))},
    "others": [], "truth": {"a": list(range(12))},
}).encode()  # fmt: skip


def readers(registry: Registry) -> dict[str, tuple[bytes, Callable[[Path], object]]]:
    """Return for each file name the content of a well-formed file, and its reader."""
    depth = np.ones((4, 5), np.float32)
    state = flatten_state({"a": np.arange(20.0), "b": [1, {"c": depth, "d": "x"}]})
    header = np.frombuffer(b'{"code": "", "version": "", "registered": 1, "time": ""}', np.uint8)
    entry = archive(depth=depth, valid=depth > 0, variance=depth, metric=np.array(True))
    images = {
        f"c{s}": encoded(s) for s in (".jpg", ".png", ".tif", ".webp", ".bmp", ".jp2", ".ppm")
    }
    return {
        **{name: (data, as_photo) for name, data in images.items()},
        "exif.jpg": (with_exif(), as_photo),
        "config.yaml": (_CONFIG, as_config(registry)),
        "intrinsics.yaml": (b"1: {model: OPENCV, params: [30, 30, 16, 12, 0, 0, 0, 0], "
                            b"width: 32, height: 24, images: [a.png, b.png]}\n", read_intrinsics),
        "transforms.json": (_TRANSFORMS, lambda path: (read_poses(path), read_intrinsics(path))),
        **model_files(poses, intrinsics),
        "cloud.ply": (_PLY, read_ply),
        "binary.ply": (_PLY_BINARY, read_ply),
        "depth.npz": (entry, lambda path: read_arrays(path, "depth")),
        "depth.npy": (io_npy(depth), lambda path: read_arrays(path, "depth")),
        "depth.png": (cv2.imencode(".png", depth.astype(np.uint16))[1].tobytes(), read_depth),
        "entry.npz": (entry, as_cache_entry),
        "state.npz": (archive(header=header, **state), as_state),
        "calibration.yaml": (b"kind: depth\ncalibration: {scale: 1.5}\nprovenance: {a: b}\n",
                             lambda path: read_values(path, "depth")),
        "testsets.yaml": (b"minimal:\n- images: [a, b]\ntriplets:\n  x:\n  - [a, b, c]\n",
                          lambda path: list(_read_sets(path))),
        "record.json": (_RECORD, read_record),
        "hashes.json": (b'{"https://example.org/a.onnx": {"sha256": "00", "stamp": [1, 2]}}',
                        as_hashes),
        "list.txt": (b"# photos\na.png\nb.png\n", read_image_list),
    }  # fmt: skip


def io_npy(array: np.ndarray) -> bytes:
    file = io.BytesIO()
    np.save(file, array)
    return file.getvalue()


@pytest.fixture(scope="module")
def registry() -> Registry:
    return Registry.discover()


@pytest.fixture(autouse=True)
def quiet() -> Any:
    logging.disable(logging.CRITICAL)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield
    logging.disable(logging.NOTSET)


def check(registry: Registry, numbers: range) -> None:
    table = readers(registry)
    found = [
        fault
        for name, (seed, reader) in table.items()
        for fault in failures(reader, name, seed, numbers)
    ]
    assert not found, "\n".join(found)


def test_well_formed_files_are_read(tmp_path: Path, registry: Registry) -> None:
    for name, (data, reader) in readers(registry).items():
        path = tmp_path / name.replace(".", "_") / name
        path.parent.mkdir(parents=True)
        path.write_bytes(data)
        # The readers ignore unknown downloads and runs.
        if name not in ("hashes.json", "record.json"):
            reader(path)


def test_some_mutated_files_are_rejected(registry: Registry) -> None:
    check(registry, range(QUICK))


@pytest.mark.slow
def test_many_mutated_files_are_rejected(registry: Registry) -> None:
    check(registry, range(QUICK, SLOW))


@pytest.mark.slow
@pytest.mark.parametrize("table", TABLES)
def test_readers_of_mutated_other_files_have_no_fault(table: str) -> None:
    found = [
        fault
        for name, (seed, reader) in TABLES[table]().items()
        for fault in failures(reader, name, seed, range(WELL_FORMED, FURTHER))
    ]
    assert not found, "\n".join(found)


def test_earlier_faults_of_other_files_are_fixed(tmp_path: Path) -> None:
    """Test a pair without images, a summary without times, a model without points, and a name."""
    table = of_others()
    path = tmp_path / "a.db"
    path.write_bytes(table["a.db"][0])
    with contextlib.closing(sqlite3.connect(path)) as database, database:
        database.execute("CREATE TABLE other AS SELECT * FROM matches")
        database.execute("UPDATE other SET pair_id = NULL")
        database.execute("DROP TABLE matches")
        database.execute("ALTER TABLE other RENAME TO matches")
    with pytest.raises(InputError, match=r"a\.db, matches: None is not a pair id"):
        table["intrinsics/a.db"][1](path)
    out = Path(shutil.copytree(GOLDEN / "out", tmp_path / "out"))
    (out / "sparse" / "points3D.bin").write_bytes(bytes(8))
    with pytest.raises(InputError, match="out: the results are damaged"):
        write_report(out)
    used(out)
    images = out / "sparse" / "images.bin"
    assert b"0.png\0" in images.read_bytes()
    images.write_bytes(images.read_bytes().replace(b"0.png\0", b"\x85.png\0"))
    with pytest.raises(InputError, match="the COLMAP model cannot be read: 'utf-8' codec"):
        poses(out)
    shutil.copy(GOLDEN / "out" / "sparse" / "images.bin", images)
    summary = json.loads((out / "summary.json").read_text())
    summary["stages"] = {"mapping": {}}
    (out / "summary.json").write_text(json.dumps(summary))
    with pytest.raises(InputError, match="out: the results are damaged"):
        write_report(out)


def test_compressed_file_size_is_limited(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(npz, "MAX_BYTES", 1_000_000)
    path = tmp_path / "depth.npz"
    np.savez_compressed(path, depth=np.zeros((1000, 1000), np.float32))
    with pytest.raises(InputError, match="unpacks to 4 megabytes, but only 1 "):
        read_arrays(path, "depth")
    with pytest.raises(InputError, match="unpacks to 4 megabytes, but only 1 "):
        read_depth_map(path)
    # The array has the size that its header declares.
    np.savez(path, depth=np.zeros((1000, 1000), np.float32))
    assert read_arrays(path, "depth")["depth"].shape == (1000, 1000)
    image = tmp_path / "large.png"
    image.write_bytes(encoded(".png")[:16] + struct.pack(">II", 40_000, 40_000))
    with pytest.raises(InputError, match="has 1600 million pixels"):
        read_arrays(image, "depth")
    with pytest.raises(InputError, match="has 1600 million pixels"):
        read_depth(image)


def test_export_stays_in_output_folder(tmp_path: Path) -> None:
    out = Path(shutil.copytree(GOLDEN / "out", tmp_path / "out"))
    model = read_model(out)
    for name in ("../../0.png", "/tmp/0.png", "a/../../0.png"):
        model.images[1].name = name
        model.write_binary(str(out / "sparse"))
        with pytest.raises(
            InputError, match=r"the name of image .* is not below the images folder"
        ):
            export(out, "gsplat")


def network(*nodes: Any, initializers: Any = (), domain: str = "") -> Any:
    onnx = pytest.importorskip("onnx", reason="needs onnx")
    pytest.importorskip("mpsfm_onnx.model", reason="needs mpsfm-onnx and onnxruntime")
    tensor = onnx.helper.make_tensor_value_info
    graph = onnx.helper.make_graph(
        list(nodes), "g", [tensor("x", 1, [1, 3])], [tensor("y", 1, None)], list(initializers)
    )
    opset = [onnx.helper.make_opsetid("", 17)]
    opset += [onnx.helper.make_opsetid(domain, 1)] if domain else []
    return onnx.helper.make_model(graph, opset_imports=opset, ir_version=8)


def test_mutated_networks() -> None:
    onnx = pytest.importorskip("onnx", reason="needs onnx")
    node = onnx.helper.make_node("Add", ["x", "x"], ["y"])
    assert not list(failures(as_onnx, "net.onnx", network(node).SerializeToString(), range(60)))


@pytest.mark.parametrize("place", ["../secret.bin", "a/../../secret.bin", "absolute", "link.bin"])
def test_network_with_external_path_is_rejected(place: str, tmp_path: Path) -> None:
    onnx = pytest.importorskip("onnx", reason="needs onnx")
    secret = tmp_path / "secret.bin"
    secret.write_bytes(np.ones(3, np.float32).tobytes())
    (tmp_path / "models" / "a").mkdir(parents=True)
    (tmp_path / "models" / "link.bin").symlink_to(secret)
    weights = onnx.TensorProto(name="w", data_type=1, dims=[3], data_location=1)
    weights.external_data.add(key="location", value=str(secret) if place == "absolute" else place)
    node = onnx.helper.make_node("Add", ["x", "w"], ["y"])
    path = tmp_path / "models" / "net.onnx"
    path.write_bytes(network(node, initializers=[weights]).SerializeToString())
    with pytest.raises(WeightsError, match=r"net\.onnx cannot be opened as an ONNX model"):
        as_onnx(path)


def test_network_with_custom_operators_is_rejected(tmp_path: Path) -> None:
    onnx = pytest.importorskip("onnx", reason="needs onnx")
    node = onnx.helper.make_node("Run", ["x"], ["y"], domain="evil")
    path = tmp_path / "net.onnx"
    path.write_bytes(network(node, domain="evil").SerializeToString())
    with pytest.raises(WeightsError, match="cannot be opened as an ONNX model"):
        as_onnx(path)


@given(st.binary(max_size=200) | st.binary(max_size=60).map(lambda b: b"\xff\xd8\xff\xe1" + b))
def test_any_bytes_have_a_header(data: bytes) -> None:
    header = read_header(data)
    assert 1 <= header.orientation <= 8
    header.focal_px(32, 24)
    read_declared_num_pixels(data)
    is_cut_jpeg(data)


@given(st.text(max_size=60))
def test_any_text_is_yaml_or_refused(text: str) -> None:
    try:
        parse_yaml(text, "x.yaml")
    except MpsfmError as error:
        assert "x.yaml" in str(error)


FOUND = {
    "cloud.ply": [b"ply\nelement vertex 1\nproperty float x\nend_header\n0\n",
                  b"ply\nformat ascii 1.0\nelement vertex\nend_header\n"],
    "depth.npz": [b"PK\x03\x04" + b"\xff" * 40],
    "depth.npy": [b"\x93NUMPY\x01\x00\x0a\x00{'descr': [\n", b"\x93NUMPY\x01\x00\x02\x00{("],
    "entry.npz": [b"\x93NUMPY\x01\x00\x02\x00{("],
    "config.yaml": [b"[" * 3000], "intrinsics.yaml": [b"[" * 3000, b"1: 2001-99-99\n"],
    "testsets.yaml": [b"[" * 3000], "calibration.yaml": [b"{" * 3000],
    "transforms.json": [b"[" * 100_000], "record.json": [b"[" * 100_000, b"[]", b"1"],
    "hashes.json": [b"", b"{", b"[1]", b'{"a": 1}', b"\xff", b"[" * 100_000],
    # COLMAP reads these counts without end.
    "poses/points3D.bin": [b"\xff" * 8, b"\x01" + bytes(50) + b"\xff" * 8],
    "poses/frames.bin": [b"\x01" + bytes(71) + b"\xff" * 4],
    "poses/images.bin": [b"\x01" + bytes(7)],
    "state.npz": [b"", b"PK\x05\x06" + bytes(18)],
}  # fmt: skip
"""Malformed contents that crashed or blocked a reader in the past."""


@pytest.mark.parametrize("name", FOUND)
def test_malformed_files_of_earlier_faults_are_refused(
    name: str, tmp_path: Path, registry: Registry
) -> None:
    _, reader = readers(registry)[name]
    for number, data in enumerate(FOUND[name]):
        path = tmp_path / str(number) / name
        path.parent.mkdir(parents=True)
        path.write_bytes(data)
        if name == "entry.npz":
            reader(path)  # is computed again
            continue
        with pytest.raises(MpsfmError):
            reader(path)
