"""Conversion of rendered, RGB-D, labeled and panoramic images to shards of training samples."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import replace
from itertools import islice
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np
from numpy.typing import NDArray
from rich.progress import Progress

from training.normals import normals_of_depth
from training.panoramas import compact_guess, views
from training.samples import EMPTY, HEIGHT, ROUGH, SURFACE, UNKNOWN, WIDTH, Sample, write_shard
from training.synthetic.make import draw_cameras, draw_samples

PER_SHARD = 240
_TEACHER_FOCAL = 0.888
"""Focal length relative to the image width in FastDepth's training data: 518.9 px of 640 px,
cropped to 304 of 333 pixels (Wofk et al., 2019).
"""
_EXACT = 1.0
"""Maximum reprojection error in pixels of COLMAP points that serve as true depth."""
_FIELD_DEG = 60.0
"""Horizontal field of view in degrees assumed for images without EXIF."""


def make_drawn(output: Path, shards: int, seed: int, workers: int, photos: Path | None) -> None:
    """Render all shards, up to number ``shards``, that do not exist in the folder ``output``.

    Each shard has :data:`PER_SHARD` samples. ``photos`` is a folder of pictures that are used as
    textures.
    """
    pictures = sorted(photos.rglob("*.jpg")) if photos else []
    wanted = [n for n in range(shards) if not (output / f"drawn-{seed}-{n:04d}").exists()]
    with Progress() as progress, ProcessPoolExecutor(workers) as pool:
        task = progress.add_task("drawing", total=shards, completed=shards - len(wanted))
        jobs = [pool.submit(_draw_shard, output, seed, n, pictures) for n in wanted]
        for job in as_completed(jobs):
            job.result()
            progress.advance(task)


def make_cameras(output: Path, files: int, per_file: int, seed: int, workers: int) -> None:
    """Render files of images with focal length and rotation that do not exist in ``output``."""
    output.mkdir(parents=True, exist_ok=True)
    with ProcessPoolExecutor(workers) as pool:
        names = ((number, output / f"cameras-{seed}-{number:04d}.npz") for number in range(files))
        jobs = [
            pool.submit(_draw_cameras, path, (seed, number), per_file)
            for number, path in names
            if not path.exists()
        ]
        for job in as_completed(jobs):
            job.result()


def make_real(output: Path, source: Path) -> None:
    """Convert each RGB-D scene to one shard of training samples.

    A scene folder has a ``scene.json`` (fx, fy, cx, cy in pixels, and ``metric``), and pairs of
    ``NAME.jpg`` and ``NAME.png``. The PNG stores z-depth in millimeters with 16 bits, 0 if unknown.
    """
    for description in sorted(source.rglob("scene.json")):
        name = "real-" + "-".join(description.parent.relative_to(source).parts)
        if not (output / name).exists():
            count = write_shard(output / name, _frames(description))
            print(f"{name}: {count} frames")  # noqa: T201


def make_triangulated(output: Path, images: Path, model: Path, name: str) -> None:
    """Convert images and their triangulated COLMAP points to the shard ``name``.

    ``model`` is the COLMAP reconstruction of ``images``. Depth has the length unit of this
    reconstruction.
    """
    import pycolmap

    def samples(folder: Path) -> Iterator[Sample]:
        pycolmap.undistort_images(folder, model, images)
        reconstruction = pycolmap.Reconstruction(folder / "sparse")
        for image in sorted(reconstruction.images.values(), key=lambda i: str(i.name)):
            picture = cv2.imread(str(folder / "images" / image.name))[..., ::-1]
            camera = np.array(image.camera.params, np.float32)
            seen = [
                reconstruction.points3D[p.point3D_id] for p in image.points2D if p.has_point3D()
            ]
            exact = [p.xyz for p in seen if p.error < _EXACT and p.track.length() > 2]
            points = image.cam_from_world() * np.array(exact).reshape(-1, 3)
            yield _sparse(picture, points, camera)

    if not (output / name).exists():
        with TemporaryDirectory() as folder:
            print(f"{name}: {write_shard(output / name, samples(Path(folder)))} photos")  # noqa: T201


def _sparse(
    image: NDArray[np.uint8], points: NDArray[np.float64], camera: NDArray[np.float32]
) -> Sample:
    """Create a sample from an image and its 3D points (n, 3), each drawn as 3 x 3 pixels."""
    blank = np.zeros(image.shape[:2], np.float32)
    sample = _fitted(image, blank, camera, metric=False)
    fx, fy, cx, cy = sample.camera
    points = points[points[:, 2] > 0]
    column = (fx * points[:, 0] / points[:, 2] + cx).astype(int)
    row = (fy * points[:, 1] / points[:, 2] + cy).astype(int)
    inside = (column > 0) & (column < WIDTH - 1) & (row > 0) & (row < HEIGHT - 1)
    for k in np.flatnonzero(inside)[np.argsort(-points[inside, 2])]:
        block = slice(row[k] - 1, row[k] + 2), slice(column[k] - 1, column[k] + 2)
        sample.depth[block] = points[k, 2]
    return replace(sample, kind=np.where(sample.depth > 0, SURFACE, UNKNOWN).astype(np.uint8))


def make_labelled(output: Path, photos: Path, teacher: Path, names: Sequence[str]) -> None:
    """Label the depth of indoor images with a depth network, one shard per folder.

    ``photos`` is a folder of folders with JPEGs and ``licence.json``, which has the horizontal
    field of view ``hfov_deg`` by file name (default 60). ``teacher`` is the ONNX file of the depth
    network, for example FastDepth. The depth network has the input (1, 3, 224, 224), RGB in 0..1,
    and the output (1, 1, 224, 224). ``names`` are prefixes of the images or image folders to label.

    The depth network assumes the camera of NYU Depth v2, so its depth is multiplied by the ratio of
    the focal lengths. All pixels have the kind ROUGH, which excludes depth edges of predicted
    labels from the loss.
    """
    teach = _teacher(teacher, 224)

    def label(image: NDArray[np.uint8], camera: NDArray[np.float32]) -> Sample:
        width = image.shape[1]
        depth = np.maximum(teach(image), 0.1) * (camera[0] / width / _TEACHER_FOCAL)
        sample = _fitted(image, depth.astype(np.float32), camera, metric=True)
        normals, kind = np.zeros_like(sample.normals), np.full_like(sample.kind, ROUGH)
        return replace(sample, normals=normals, kind=kind)

    _label(output, "real-labelled", photos, names, label)


def make_sky(output: Path, photos: Path, teacher: Path, names: Sequence[str]) -> None:
    """Label the sky in images with a segmentation network, and leave depth unknown.

    ``teacher`` is the ONNX file of the segmentation network. The segmentation network has the input
    (1, 3, 384, 384), RGB in 0..1, and its output (1, 1, 384, 384) is the sky probability. The image
    folders are organized as for :func:`make_labelled`.
    """
    teach = _teacher(teacher, 384)

    def label(image: NDArray[np.uint8], camera: NDArray[np.float32]) -> Sample:
        sky = teach(image)
        sample = _fitted(image, np.where(sky > 0.5, 1, 2).astype(np.float32), camera, metric=False)
        kind = np.where(sample.depth == 1, EMPTY, ROUGH).astype(np.uint8)
        nothing = np.zeros_like(sample.depth)
        return replace(sample, depth=nothing, normals=np.zeros_like(sample.normals), kind=kind)

    _label(output, "sky", photos, names, label)


def make_views(output: Path, panoramas: Path, teacher: Path) -> None:
    """Cut perspective images from panoramas, one shard each, with scale from the tripod height.

    ``panoramas`` is a folder of equirectangular JPEGs. ``teacher`` is an ONNX file of the compact
    network that predicts depth and normals.
    """
    guess = compact_guess(teacher)
    for path in sorted(panoramas.rglob("*.jpg")):
        name = f"view-{path.stem}"
        if not (output / name).exists():
            picture = np.ascontiguousarray(cv2.imread(str(path))[..., ::-1])
            rng = np.random.default_rng([ord(letter) for letter in path.stem])
            count = write_shard(output / name, views(picture, guess, rng))
            print(f"{name}: {count} views")  # noqa: T201


def _teacher(path: Path, side: int) -> Callable[[NDArray[np.uint8]], NDArray[np.float32]]:
    """Return a function that maps an image (h, w, 3) to the network output at its size (h, w)."""
    import onnxruntime

    session = onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    name = session.get_inputs()[0].name

    def teach(image: NDArray[np.uint8]) -> NDArray[np.float32]:
        small = cv2.resize(image, (side, side), interpolation=cv2.INTER_AREA)
        feed = {name: small.astype(np.float32).transpose(2, 0, 1)[None] / 255}
        return cv2.resize(session.run(None, feed)[0][0, 0], image.shape[1::-1])

    return teach


def _label(
    output: Path,
    prefix: str,
    photos: Path,
    names: Sequence[str],
    label: Callable[[NDArray[np.uint8], NDArray[np.float32]], Sample],
) -> None:
    for description in sorted(photos.rglob("licence.json")):
        folder = description.parent
        chosen = [
            path
            for path in sorted(folder.glob("*.jpg"))
            if any(name.startswith(tuple(names)) for name in (path.name, folder.name))
        ]
        name = f"{prefix}-{folder.name}"
        if chosen and not (output / name).exists():
            angles = json.loads(description.read_text(encoding="utf-8")).get("hfov_deg", {})
            labelled = (label(*_photo(p, angles.get(p.name, _FIELD_DEG))) for p in chosen)
            print(f"{name}: {write_shard(output / name, labelled)} photos")  # noqa: T201


def _photo(path: Path, field_deg: float) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    image = np.ascontiguousarray(cv2.imread(str(path))[..., ::-1])
    height, width = image.shape[:2]
    focal = width / 2 / np.tan(np.radians(field_deg) / 2)
    return image, np.array([focal, focal, width / 2, height / 2], np.float32)


def _draw_shard(output: Path, seed: int, number: int, photos: list[Path]) -> None:
    samples = draw_samples((seed, number), photos)
    write_shard(output / f"drawn-{seed}-{number:04d}", islice(samples, PER_SHARD))


def _draw_cameras(path: Path, seed: tuple[int, int], count: int) -> None:
    images, focals, rotations = zip(*islice(draw_cameras(seed), count), strict=True)
    part = path.with_suffix(".part")
    with part.open("wb") as file:
        np.savez(
            file,
            image=np.stack(images),
            focal=np.array(focals, np.float32),
            rotation=np.stack(rotations).astype(np.float32),
        )
    part.rename(path)


def _frames(description: Path) -> Iterator[Sample]:
    scene = json.loads(description.read_text(encoding="utf-8"))
    for path in sorted(description.parent.glob("*.png")):
        image, depth = cv2.imread(str(path.with_suffix(".jpg"))), cv2.imread(str(path), -1)
        if image is None or depth is None or image.shape[:2] != depth.shape:
            continue
        metres = depth.astype(np.float32) / 1000
        camera = np.array([scene[k] for k in ("fx", "fy", "cx", "cy")], np.float32)
        sample = _fitted(image[..., ::-1], metres, camera, bool(scene["metric"]))
        if (sample.kind == SURFACE).mean() > 0.2:
            yield sample


def _fitted(
    image: NDArray[np.uint8], depth: NDArray[np.float32], camera: NDArray[np.float32], metric: bool
) -> Sample:
    """Crop an image and its depth to the aspect ratio of training samples, and resize both."""
    height, width = depth.shape
    scale = max(WIDTH / width, HEIGHT / height)
    w, h = min(width, round(WIDTH / scale)), min(height, round(HEIGHT / scale))
    x, y = (width - w) // 2, (height - h) // 2
    image, depth = image[y : y + h, x : x + w], depth[y : y + h, x : x + w]
    ratio = np.array([WIDTH / w, HEIGHT / h], np.float32)
    camera = np.concatenate([camera[:2] * ratio, (camera[2:] - [x, y]) * ratio]).astype(np.float32)
    method = cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR
    image = cv2.resize(np.ascontiguousarray(image), (WIDTH, HEIGHT), interpolation=method)
    depth = cv2.resize(depth, (WIDTH, HEIGHT), interpolation=cv2.INTER_NEAREST_EXACT)
    kind = np.where(depth > 0, SURFACE, UNKNOWN).astype(np.uint8)
    return Sample(image, depth, normals_of_depth(depth, camera), kind, camera, metric)
