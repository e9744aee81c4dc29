"""Convert a reconstruction to a COLMAP model and write the model files."""

from __future__ import annotations

import errno
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
import pycolmap

from mpsfm_core.data import DepthPrior, Float64, MappingProblem, PinholeCamera, Rig, UInt8, View
from mpsfm_core.data.errors import InputError
from mpsfm_core.dense.depth_range import depth_prior_from_points
from mpsfm_core.geometry import compose, invert, sample_nearest, transform
from mpsfm_core.geometry.pycolmap_conversion import (
    camera_key,
    colmap_from_pinhole,
    pinhole_from_colmap,
)
from mpsfm_core.inputs.colmap_files import check_binary_model
from mpsfm_core.inputs.undistortion import is_pinhole
from mpsfm_core.mapping.scene.reconstruction import Reconstruction, RegisteredImage

MIN_TRACK_LENGTH = 2
"""Minimum track length of exported points; points lifted from one depth map are not exported."""

_BLOCK = 1 << 20
"""Number of bytes per write in the test of the free disk space."""

Keypoints = Sequence[Float64]
"""Keypoints (n, 2) float64 of each registered image in pixels of the exported camera."""


def build_model(
    reconstruction: Reconstruction,
    cameras: Sequence[pycolmap.Camera],
    keypoints: Keypoints,
    colors: UInt8,
) -> pycolmap.Reconstruction:
    """Build a COLMAP model of the registered images.

    The COLMAP model has all keypoints, and the 3D points with at least :data:`MIN_TRACK_LENGTH`
    observations. COLMAP's image id is the image index in the mapping problem plus one.

    Args:
        reconstruction: poses, 3D points and tracks to convert.
        cameras: camera of each registered image; images with equal cameras share one COLMAP camera.
        keypoints: keypoints of each registered image in pixels of ``cameras``.
        colors: (p, 3) RGB colors of the 3D points.

    Returns:
        The COLMAP model, with reprojection errors in pixels of ``cameras``.
    """
    model = pycolmap.Reconstruction()
    ids: dict[str, int] = {}
    sensor_of = {
        name: (number, sensor)
        for number, rig in enumerate(reconstruction.rigs)
        for frame in rig.frames
        for sensor, name in enumerate(frame)
        if name is not None
    }
    rig_images: dict[str, tuple[RegisteredImage, pycolmap.Image]] = {}
    for image, camera, xy in zip(reconstruction.images, cameras, keypoints, strict=True):
        sensor = sensor_of.get(image.name)
        key = camera_key(camera) if sensor is None else f"{sensor}"
        if key not in ids:
            ids[key] = len(ids) + 1
            if sensor is None:
                model.add_camera_with_trivial_rig(_with_id(camera, ids[key]))
            else:
                model.add_camera(_with_id(camera, ids[key]))
        if sensor is not None:
            colmap_image = pycolmap.Image(
                name=image.name, keypoints=xy, camera_id=ids[key], image_id=image.index + 1
            )
            rig_images[image.name] = image, colmap_image
            continue
        pose = np.column_stack([image.rotation, image.translation])
        model.add_image_with_trivial_frame(
            pycolmap.Image(
                name=image.name, keypoints=xy, camera_id=ids[key], image_id=image.index + 1
            ),
            pycolmap.Rigid3d(pose),
        )
    for rig in reconstruction.rigs:
        _add_rig(model, rig, rig_images)
    for row, track in enumerate(_tracks(reconstruction)):
        if len(track) >= MIN_TRACK_LENGTH:
            elements = [pycolmap.TrackElement(image, keypoint) for image, keypoint in track]
            model.add_point3D(reconstruction.points[row], pycolmap.Track(elements), colors[row])
    model.update_point_3d_errors()
    return model


def _add_rig(
    model: pycolmap.Reconstruction,
    rig: Rig,
    images: Mapping[str, tuple[RegisteredImage, pycolmap.Image]],
) -> None:
    """Add a rig to a COLMAP model, with its frames and images.

    The first sensor with an image is COLMAP's reference sensor, so its pose is the pose of a frame.
    """
    frames = [
        {s: images[name] for s, name in enumerate(frame) if name is not None and name in images}
        for frame in rig.frames
    ]
    cameras = {s: image.camera_id for members in frames for s, (_, image) in members.items()}
    if not cameras:
        return
    reference = min(cameras)
    colmap_rig = pycolmap.Rig(rig_id=max([0, *model.rigs]) + 1)
    colmap_rig.add_ref_sensor(model.cameras[cameras[reference]].sensor_id)
    rig_from_reference = invert(*rig.sensor_poses[reference])
    from_reference = {
        sensor: compose(rig.sensor_poses[sensor], rig_from_reference) for sensor in cameras
    }
    for sensor in sorted(cameras.keys() - {reference}):
        pose = pycolmap.Rigid3d(np.column_stack(from_reference[sensor]))
        colmap_rig.add_sensor(model.cameras[cameras[sensor]].sensor_id, pose)
    model.add_rig(colmap_rig)
    for members in filter(None, frames):
        frame_id = max([0, *model.frames]) + 1
        frame = pycolmap.Frame(frame_id=frame_id, rig_id=colmap_rig.rig_id)
        for _, image in members.values():
            frame.add_data_id(image.data_id)
            image.frame_id = frame_id
        sensor, (first, _) = next(iter(members.items()))
        pose = compose(invert(*from_reference[sensor]), (first.rotation, first.translation))
        frame.rig_from_world = pycolmap.Rigid3d(np.column_stack(pose))
        model.add_frame(frame)
        for _, image in members.values():
            model.add_image(image)
        model.register_frame(frame_id)


def build_pinhole_model(
    reconstruction: Reconstruction, problem: MappingProblem
) -> pycolmap.Reconstruction:
    """Build a COLMAP model of the undistorted views with black points; read no image.

    Cameras of the model are PINHOLE, or have the estimated distortion if the views were not
    undistorted with the estimate.
    """
    cameras = [
        colmap_from_pinhole(image.camera)
        if any(problem.images[image.index].distortion) or not image.distortion.any()
        else _with_distortion(image)
        for image in reconstruction.images
    ]
    keypoints = [problem.images[image.index].keypoints for image in reconstruction.images]
    black = np.zeros((len(reconstruction.points), 3), np.uint8)
    return build_model(reconstruction, cameras, keypoints, black)


def reconstruction_from_model(
    model: pycolmap.Reconstruction,
    cameras: Mapping[str, PinholeCamera],
    depth: Mapping[str, DepthPrior],
) -> Reconstruction:
    """Convert a COLMAP model to a reconstruction with depth maps.

    Args:
        model: COLMAP model with poses and points.
        cameras: Camera of the undistorted view by image name. An image without entry needs a camera
            without lens distortion in the COLMAP model.
        depth: Depth map by image name. An image without entry gets a constant depth map, whose
            standard deviation covers the depths of the points that the image observes.

    Raises:
        InputError: an image without entry in ``cameras`` has lens distortion, or an image without
            entry in ``depth`` observes no points.
    """
    point_ids = sorted(model.points3D)
    rows = {number: row for row, number in enumerate(point_ids)}
    points = np.array([model.points3D[number].xyz for number in point_ids]).reshape(-1, 3)
    registered = [model.images[number] for number in sorted(model.reg_image_ids())]
    images = []
    for index, image in enumerate(registered):
        name = str(image.name)
        camera = cameras.get(name)
        if camera is None and not is_pinhole(image.camera):
            raise InputError(f"image {name!r} has lens distortion; pass the images of the model")
        matrix = np.asarray(image.cam_from_world().matrix())
        observed = np.array(
            [
                rows.get(point.point3D_id, -1) if point.has_point3D() else -1
                for point in image.points2D
            ],
            dtype=np.int64,
        )
        seen = points[observed[observed >= 0]]
        depths = transform(matrix[:, :3], matrix[:, 3], seen)[:, 2]
        prior = depth.get(name) or depth_prior_from_points(depths)
        if prior is None:
            raise InputError(f"image {name!r} observes no points of the model; give its depth map")
        images.append(
            RegisteredImage(
                index,
                name,
                camera or pinhole_from_colmap(image.camera),
                matrix[:, :3].copy(),
                matrix[:, 3].copy(),
                observed,
                prior,
                1.0,
            )
        )
    errors = np.array([model.points3D[number].error for number in point_ids], dtype=np.float64)
    return Reconstruction(tuple(images), points, errors)


def write_model(folder: Path, model: pycolmap.Reconstruction, *, text: bool = False) -> None:
    """Write a COLMAP model as binary or text files.

    COLMAP's writer does not report a full disk. The free disk space is therefore tested before
    writing, and the file sizes are checked after writing.

    Raises:
        OSError: the disk is full or writing fails.
    """
    folder.mkdir(parents=True, exist_ok=True)
    keypoints = sum(image.num_points2D() for image in model.images.values())
    records = model.num_images() + model.num_cameras() + model.num_points3D()
    observations = model.compute_num_observations()
    _check_free_space(
        folder / "free_space", 512 * records + (32 if not text else 96) * (keypoints + observations)
    )
    try:
        (model.write_text if text else model.write_binary)(str(folder))
    except (RuntimeError, ValueError) as error:
        raise OSError(errno.EIO, f"COLMAP cannot write {folder.name}/: {error}") from error
    if not (_is_text_complete if text else _is_binary_complete)(folder, model):
        raise OSError(errno.EIO, f"the files of {folder.name}/ are incomplete: is the disk full?")


def average_point_colors(
    reconstruction: Reconstruction, keypoints: Keypoints, view_of: Callable[[str], View]
) -> UInt8:
    """Average the image colors of each point over its observations.

    Args:
        reconstruction: 3D points and their observations.
        keypoints: keypoints of each registered image in pixels of the undistorted view.
        view_of: function that returns the undistorted view of an image name.

    Returns:
        (p, 3) uint8 RGB colors; 3D points without an observation are black.
    """
    total = np.zeros((len(reconstruction.points), 3))
    count = np.zeros(len(reconstruction.points))
    for image, xy in zip(reconstruction.images, keypoints, strict=True):
        observed = image.point_ids >= 0
        rows = image.point_ids[observed]
        np.add.at(total, rows, sample_nearest(view_of(image.name).image, xy[observed]))
        np.add.at(count, rows, 1)
    return np.round(total / np.maximum(count, 1)[:, None]).astype(np.uint8)


def _is_binary_complete(folder: Path, model: pycolmap.Reconstruction) -> bool:
    try:
        check_binary_model(folder)
    except (OSError, ValueError):
        return False
    params = sum(len(camera.params) for camera in model.cameras.values())
    size = (folder / "cameras.bin").stat().st_size
    return bool(size == 8 + 24 * model.num_cameras() + 8 * params)


def _is_text_complete(folder: Path, model: pycolmap.Reconstruction) -> bool:
    num_records = {
        "cameras.txt": model.num_cameras(),
        "images.txt": 2 * model.num_reg_images(),
        "points3D.txt": model.num_points3D(),
        "frames.txt": model.num_reg_frames(),
        "rigs.txt": model.num_rigs(),
    }
    for name, count in num_records.items():
        data = (folder / name).read_bytes()
        lines = [line for line in data.split(b"\n")[:-1] if not line.startswith(b"#")]
        if not data.endswith(b"\n") or len(lines) != count:
            return False
    return True


def _check_free_space(path: Path, size: int) -> None:
    """Raise ``OSError`` unless the disk has space for a file of the given size in bytes."""
    try:
        with path.open("wb") as file:
            for start in range(0, size, _BLOCK):
                file.write(bytes(min(_BLOCK, size - start)))
    finally:
        path.unlink(missing_ok=True)


def _with_distortion(image: RegisteredImage) -> pycolmap.Camera:
    """Return the estimated camera of an image whose view was not undistorted with the estimate."""
    pinhole, model = image.camera, image.camera_model
    if model.is_fisheye:
        return colmap_from_pinhole(pinhole)
    intrinsics = pinhole.params.copy()
    if not model.has_aspect:
        intrinsics[:2] = (pinhole.fx * pinhole.fy) ** 0.5
    params = model.to_params(intrinsics, image.distortion)
    return pycolmap.Camera(
        model=model.value, width=pinhole.width, height=pinhole.height, params=params
    )


def _with_id(camera: pycolmap.Camera, camera_id: int) -> pycolmap.Camera:
    return pycolmap.Camera({**camera.todict(), "camera_id": camera_id})


def _tracks(reconstruction: Reconstruction) -> list[list[tuple[int, int]]]:
    """Return the observations of each 3D point as pairs of image id and keypoint index."""
    tracks: list[list[tuple[int, int]]] = [[] for _ in reconstruction.points]
    for image in reconstruction.images:
        for keypoint in np.flatnonzero(image.point_ids >= 0):
            tracks[image.point_ids[keypoint]].append((image.index + 1, int(keypoint)))
    return tracks
