"""File readers for results, matches, weights and datasets, each with a well-formed file."""

from __future__ import annotations

import io
import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path

import cv2
import h5py
import numpy as np
import pillow_heif
import pycolmap
import torch
from PIL import Image
from safetensors.torch import save as save_safetensors

from mpsfm_core.cli.remaining_time import RemainingTimeEstimator
from mpsfm_core.data import Features
from mpsfm_core.evaluation.importers import import_scene
from mpsfm_core.evaluation.overlap import overlap_from_model
from mpsfm_core.evaluation.scene_folder import read_scene
from mpsfm_core.inputs import video
from mpsfm_core.inputs.images import load_images
from mpsfm_core.inputs.intrinsics import read_intrinsics
from mpsfm_core.inputs.matches import matches_from_database, matches_from_hloc
from mpsfm_core.inputs.models import read_model, read_poses
from mpsfm_core.inputs.options import InputOptions, VideoOptions
from mpsfm_core.pipeline.dense_models import _point_depths
from mpsfm_core.providers.environments.codec import EncodedMessage, decode_message
from mpsfm_core.providers.environments.environment import Environment
from mpsfm_core.providers.uncertainty.calibration_file import load_calibration
from mpsfm_core.providers.weights import load_torch_state
from mpsfm_core.report.page import write_report
from mpsfm_core.report.viewing import read_scene as read_view
from mpsfm_core.results.depth_maps import read_depth_map
from mpsfm_core.results.exports.formats import export
from mpsfm_core.support.files import lock_output_folder

GOLDEN = Path(__file__).parents[1] / "golden" / "0.1.0"
_PHOTOS = ("0.png", "1.png")

Reader = Callable[[Path], object]
Table = dict[str, tuple[bytes, Reader]]
"""Relative file path -> the content of a well-formed file, and the reader of the file."""


def synthetic() -> pycolmap.Reconstruction:
    """Return a synthetic COLMAP model of three images and eight points."""
    pycolmap.set_random_seed(0)
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_cameras_per_rig = 1, 1
    options.num_frames_per_rig, options.num_points3D = 3, 8
    return pycolmap.synthesize_dataset(options)


def in_model(*readers: Reader) -> dict[str, Reader]:
    """Return a reader for each file of a COLMAP model, in a folder with well-formed other files."""

    def in_folder(text: bool, reader: Reader) -> Reader:
        def read(path: Path) -> None:
            data = path.read_bytes()
            (synthetic().write_text if text else synthetic().write_binary)(str(path.parent))
            path.write_bytes(data)
            reader(path.parent)

        return read

    names = ("cameras", "images", "points3D", "frames", "rigs")
    return {
        f"{reader.__name__}/{name}.{'txt' if text else 'bin'}": in_folder(text, reader)
        for reader in readers
        for text in (False, True)
        for name in names
    }


def poses(folder: Path) -> None:
    read_poses(folder)


def intrinsics(folder: Path) -> None:
    read_intrinsics(folder)


def exported(folder: Path) -> None:
    for format_name in ("colmap-text", "colmap-db", "glb"):
        export(folder, format_name)


def used(folder: Path) -> None:
    """Read a COLMAP model like the dense command, the viewers and the sampling of test sets."""
    model = read_model(folder)
    for image in model.images.values():
        _point_depths(model, image)
    overlap_from_model(model, [str(image.name) for image in model.images.values()])
    read_view(folder)


def model_files(*readers: Reader) -> Table:
    """Return the files of COLMAP models, once for each reader of a model folder."""
    made: dict[str, bytes] = {}
    with tempfile.TemporaryDirectory() as folder:
        synthetic().write_binary(folder)
        synthetic().write_text(folder)
        made = {path.name: path.read_bytes() for path in Path(folder).iterdir()}
    return {key: (made[Path(key).name], reader) for key, reader in in_model(*readers).items()}


def models() -> Table:
    """Return files of COLMAP models for all readers except those of poses and intrinsics."""
    return model_files(exported, used)


def results() -> Table:
    """Return files of result folders, of the cache, and of interrupted replacements."""

    def with_golden_files(name: str, reader: Reader) -> tuple[str, tuple[bytes, Reader]]:
        def read(path: Path) -> None:
            data = path.read_bytes()
            folder = path.parents[name.count("/")]
            shutil.copytree(GOLDEN, folder, dirs_exist_ok=True)
            path.write_bytes(data)
            reader(folder)

        return f"{reader.__name__}/{name}", ((GOLDEN / name).read_bytes(), read)

    def reported(folder: Path) -> None:
        write_report(folder / "out")

    def viewed(folder: Path) -> None:
        read_view(folder / "out")

    def exported_again(folder: Path) -> None:
        export(folder / "out", "glb")

    def mapped(folder: Path) -> None:
        read_depth_map(folder / "out" / "depth" / "0.png.npz")

    def calibrated(folder: Path) -> None:
        load_calibration(folder / "calibration.yaml")

    def timed(folder: Path) -> None:
        RemainingTimeEstimator(folder / "cache")

    def exchanged(folder: Path) -> None:
        with lock_output_folder(folder / "exchange"):
            pass

    def described(folder: Path) -> None:
        Environment(folder / "environment").describe()

    def framed(folder: Path) -> None:
        video._read_list(folder / "frames" / "frames.json")

    out = ("summary.json", "dense.ply", "depth/0.png.npz", "sparse/images.bin")
    page = ("views/matches.npz", "views/0.png.npz", "views/0.png.webp")
    return dict(
        [
            *(with_golden_files(f"out/{name}", reported) for name in (*out, *page)),
            *(with_golden_files(f"out/{name}", viewed) for name in ("summary.json", "dense.ply")),
            *(with_golden_files(f"out/{name}", exported_again) for name in out),
            with_golden_files("out/depth/0.png.npz", mapped),
            with_golden_files("calibration.yaml", calibrated),
            with_golden_files("cache/timings.json", timed),
            with_golden_files("exchange/.mpsfm-killed/ready.json", exchanged),
            with_golden_files("environment/providers.json", described),
            with_golden_files("frames/frames.json", framed),
        ]
    )


def write_photos(path: Path) -> Path:
    """Create a folder of two photos next to the mutated file."""
    folder = path.parent / "photos"
    folder.mkdir(exist_ok=True)
    for name in _PHOTOS:
        cv2.imwrite(str(folder / name), np.full((48, 64, 3), 128, np.uint8))
    return folder


def database(path: Path) -> None:
    pixels = np.random.default_rng(0).uniform(5, 40, (30, 2)).astype(np.float32)
    rows = np.repeat(np.arange(30, dtype=np.uint32)[:, None], 2, axis=1)
    with pycolmap.Database.open(str(path)) as written:
        camera = pycolmap.Camera(model="PINHOLE", width=64, height=48, params=[60, 60, 32, 24])
        number = written.write_camera(camera)
        ids = [written.write_image(pycolmap.Image(name=n, camera_id=number)) for n in _PHOTOS]
        for image in ids:
            written.write_keypoints(image, pixels)
        written.write_matches(*ids, rows)


def hloc_features(path: Path) -> None:
    with h5py.File(path, "w") as file:
        for name in _PHOTOS:
            file[f"{name}/keypoints"] = np.random.default_rng(0).uniform(5, 40, (30, 2))
            file[f"{name}/image_size"] = np.array([64, 48])


def hloc_matches(path: Path) -> None:
    with h5py.File(path, "w") as file:
        file["0.png/1.png/matches0"] = np.arange(30)
        file["0.png/1.png/matching_scores0"] = np.ones(30)


def clip(path: Path) -> None:
    codec = cv2.VideoWriter_fourcc(*("MJPG" if path.suffix == ".avi" else "mp4v"))
    writer = cv2.VideoWriter(str(path), codec, 10, (64, 48))
    rng = np.random.default_rng(0)
    for _ in range(6):
        writer.write(rng.integers(0, 255, (48, 64, 3), dtype=np.uint8))
    writer.release()


def of_others() -> Table:
    """Return match files, videos and phone photos with their readers."""

    def from_database(path: Path) -> None:
        matches_from_database(path, load_images(write_photos(path)))

    def from_features(path: Path) -> None:
        hloc_matches(path.with_name("matches.h5"))
        matches_from_hloc(path, path.with_name("matches.h5"), load_images(write_photos(path)))

    def from_matches(path: Path) -> None:
        hloc_features(path.with_name("features.h5"))
        matches_from_hloc(path.with_name("features.h5"), path, load_images(write_photos(path)))

    def frames(path: Path) -> None:
        video.choose_frames(path, VideoOptions())

    def masked(path: Path) -> None:
        folder = write_photos(path)
        load_images(folder, options=InputOptions(masks=path.parent)).view(0)

    def photo(path: Path) -> None:
        folder = write_photos(path)
        shutil.copy(path, folder)
        found = load_images(folder)
        found.view(len(found) - 1)

    heic = io.BytesIO()
    pillow_heif.from_pillow(Image.fromarray(np.full((48, 64, 3), 9, np.uint8))).save(heic)
    mask = cv2.imencode(".png", np.eye(48, 64, dtype=np.uint8) * 255)[1].tobytes()
    return {
        "a.db": (made(database, "a.db"), from_database),
        "intrinsics/a.db": (made(database, "a.db"), read_intrinsics),
        "features.h5": (made(hloc_features, "a.h5"), from_features),
        "matches.h5": (made(hloc_matches, "a.h5"), from_matches),
        "clip.avi": (made(clip, "clip.avi"), frames),
        "clip.mp4": (made(clip, "clip.mp4"), frames),
        "0.png.png": (mask, masked),
        "9.heic": (heic.getvalue(), photo),
    }


def weights() -> Table:
    """Return weight files, and messages of a provider process in another environment."""
    tensors = {"a.weight": torch.ones(3, 4), "b": torch.arange(5)}
    pickled = io.BytesIO()
    torch.save({"model": tensors}, pickled)
    said = {"features": Features(np.ones((4, 2)), np.ones((4, 8), np.float32)), "path": Path("a")}
    packed = EncodedMessage(said)
    block = np.zeros(packed.size, np.uint8)
    packed.write(memoryview(block))
    return {
        "a.pt": (pickled.getvalue(), load_torch_state),
        "a.safetensors": (save_safetensors(tensors), load_torch_state),
        "message": (packed.text, lambda path: decode_message(path.read_bytes(), block, copy=True)),
    }


def datasets() -> Table:
    """Return test set files, and text files of public datasets."""

    def scene(path: Path) -> None:
        shutil.copytree(GOLDEN / "out" / "sparse", path.parent / "gt", dirs_exist_ok=True)
        (path.parent / "images").mkdir(exist_ok=True)
        for number in range(3):
            cv2.imwrite(str(path.parent / "images" / f"{number}.png"), np.zeros((12, 16), np.uint8))
        read_scene(path.parent)

    def imported(kind: str, *names: str) -> Reader:
        """Return a reader of a text file in a dataset whose photos have `names`."""

        def read(path: Path) -> None:
            source = path.parents[1] if kind == "scannet" else path.parent
            for name in names:
                (source / name).parent.mkdir(parents=True, exist_ok=True)
                cv2.imwrite(str(source / name), np.full((48, 64, 3), 9, np.uint8))
            if kind == "scannet":
                for text in ("pose/0.txt", "pose/1.txt", "intrinsic/intrinsic_color.txt"):
                    (source / text).parent.mkdir(exist_ok=True)
                    if source / text != path:
                        (source / text).write_text(matrix)
            if kind == "7-scenes":
                path.with_name("frame-000001.pose.txt").write_text(matrix)
            with tempfile.TemporaryDirectory() as target:
                import_scene(kind, source, Path(target) / "scene")

        return read

    matrix = "\n".join(" ".join(map(str, row)) for row in np.eye(4).tolist()) + "\n"
    line = "0.9 1.2 0.5 0.5 0 0 1 0 0 0 0 1 0 0 0 0 1 0"
    realestate = f"https://example.org\n0 {line}\n1 {line}\n"
    log = "".join(f"{n} {n} 0\n{matrix}" for n in range(2))
    stems = [f"frame-00000{n}.color.png" for n in range(2)]
    return {
        "testsets.yaml": ((GOLDEN / "testsets.yaml").read_bytes(), scene),
        "realestate/realestate.txt": (
            realestate.encode(),
            imported("realestate10k", "0.png", "1.png"),
        ),
        "temple/a_COLMAP_SfM.log": (
            log.encode(),
            imported("tanks-and-temples", "images/0.png", "images/1.png"),
        ),
        "seven/frame-000000.pose.txt": (matrix.encode(), imported("7-scenes", *stems)),
        "scannet/pose/0.txt": (
            matrix.encode(),
            imported("scannet", "color/0.jpg", "color/1.jpg"),
        ),
        "scannet/intrinsic/intrinsic_color.txt": (
            matrix.encode(),
            imported("scannet", "color/0.jpg", "color/1.jpg"),
        ),
    }


def made(write: Callable[[Path], None], name: str) -> bytes:
    """Return the bytes of a file that `write` writes to a path."""
    with tempfile.TemporaryDirectory() as folder:
        write(Path(folder) / name)
        return (Path(folder) / name).read_bytes()


TABLES = {table.__name__: table for table in (models, results, of_others, weights, datasets)}
