"""The reconstruction as a COLMAP model."""

from __future__ import annotations

import errno
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pycolmap

from mpsfm_core.data import Float64, UInt8, View
from mpsfm_core.geometry import sample_nearest
from mpsfm_core.geometry.pycolmap_conversion import camera_key
from mpsfm_core.inputs.colmap_files import check_binary_model
from mpsfm_core.mapping.scene.reconstruction import Reconstruction

MIN_TRACK_LENGTH = 2
"""COLMAP and its users take a point for triangulated: one seen once, lifted from depth, is not."""

_BLOCK = 1 << 20

Keypoints = Sequence[Float64]
"""For each registered image its keypoints (n, 2), float64, in the pixels of the model's camera."""


def build_model(
    reconstruction: Reconstruction,
    cameras: Sequence[pycolmap.Camera],
    keypoints: Keypoints,
    colors: UInt8,
) -> pycolmap.Reconstruction:
    """A model of the registered images, with all keypoints and the points seen at least twice.

    ``cameras``: for each registered image; equal ones become one camera of the model. ``colors``:
    (p, 3) RGB of the points. Image ids are positions in the problem plus one. Point errors are
    reprojection errors in the pixels of ``cameras``.
    """
    model = pycolmap.Reconstruction()
    ids: dict[str, int] = {}
    for image, camera, xy in zip(reconstruction.images, cameras, keypoints, strict=True):
        key = camera_key(camera)
        if key not in ids:
            ids[key] = len(ids) + 1
            model.add_camera_with_trivial_rig(_with_id(camera, ids[key]))
        pose = np.column_stack([image.rotation, image.translation])
        model.add_image_with_trivial_frame(
            pycolmap.Image(
                name=image.name, keypoints=xy, camera_id=ids[key], image_id=image.index + 1
            ),
            pycolmap.Rigid3d(pose),
        )
    for row, track in enumerate(_tracks(reconstruction)):
        if len(track) >= MIN_TRACK_LENGTH:
            elements = [pycolmap.TrackElement(image, keypoint) for image, keypoint in track]
            model.add_point3D(reconstruction.points[row], pycolmap.Track(elements), colors[row])
    model.update_point_3d_errors()
    return model


def write_model(folder: Path, model: pycolmap.Reconstruction, *, text: bool = False) -> None:
    """Write a model, binary or text.

    Raises ``OSError`` when the disk has no room or fails. COLMAP's writer does not notice either,
    so the room is tried before and the files are measured after.
    """
    folder.mkdir(parents=True, exist_ok=True)
    keypoints = sum(image.num_points2D() for image in model.images.values())
    records = model.num_images() + model.num_cameras() + model.num_points3D()
    observations = model.compute_num_observations()
    _try_room(
        folder / "room", 512 * records + (32 if not text else 96) * (keypoints + observations)
    )
    try:
        (model.write_text if text else model.write_binary)(str(folder))
    except (RuntimeError, ValueError) as error:
        raise OSError(errno.EIO, f"COLMAP cannot write {folder.name}/: {error}") from error
    if not (_whole_text if text else _whole_binary)(folder, model):
        raise OSError(errno.EIO, f"the disk did not take all of {folder.name}/")


def average_point_colors(
    reconstruction: Reconstruction, keypoints: Keypoints, view_of: Callable[[str], View]
) -> UInt8:
    """Mean RGB colour (p, 3) of each point over its observations, black without any.

    ``keypoints``: of each registered image, in the pixels of its view.
    """
    total = np.zeros((len(reconstruction.points), 3))
    count = np.zeros(len(reconstruction.points))
    for image, xy in zip(reconstruction.images, keypoints, strict=True):
        seen = image.point_ids >= 0
        rows = image.point_ids[seen]
        np.add.at(total, rows, sample_nearest(view_of(image.name).image, xy[seen]))
        np.add.at(count, rows, 1)
    return np.round(total / np.maximum(count, 1)[:, None]).astype(np.uint8)


def _whole_binary(folder: Path, model: pycolmap.Reconstruction) -> bool:
    try:
        check_binary_model(folder)
    except (OSError, ValueError):
        return False
    params = sum(len(camera.params) for camera in model.cameras.values())
    size = (folder / "cameras.bin").stat().st_size
    return bool(size == 8 + 24 * model.num_cameras() + 8 * params)


def _whole_text(folder: Path, model: pycolmap.Reconstruction) -> bool:
    wanted = {
        "cameras.txt": model.num_cameras(),
        "images.txt": 2 * model.num_reg_images(),
        "points3D.txt": model.num_points3D(),
        "frames.txt": model.num_reg_frames(),
        "rigs.txt": model.num_rigs(),
    }
    for name, count in wanted.items():
        data = (folder / name).read_bytes()
        lines = [line for line in data.split(b"\n")[:-1] if not line.startswith(b"#")]
        if not data.endswith(b"\n") or len(lines) != count:
            return False
    return True


def _try_room(path: Path, size: int) -> None:
    """Raise ``OSError`` unless a file of this many bytes can be written."""
    try:
        with path.open("wb") as file:
            for start in range(0, size, _BLOCK):
                file.write(bytes(min(_BLOCK, size - start)))
    finally:
        path.unlink(missing_ok=True)


def _with_id(camera: pycolmap.Camera, camera_id: int) -> pycolmap.Camera:
    return pycolmap.Camera({**camera.todict(), "camera_id": camera_id})


def _tracks(reconstruction: Reconstruction) -> list[list[tuple[int, int]]]:
    """For each point its observations: (image id of the model, keypoint row)."""
    tracks: list[list[tuple[int, int]]] = [[] for _ in reconstruction.points]
    for image in reconstruction.images:
        for keypoint in np.flatnonzero(image.point_ids >= 0):
            tracks[image.point_ids[keypoint]].append((image.index + 1, int(keypoint)))
    return tracks
