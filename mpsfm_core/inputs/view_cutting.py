"""Cut panoramas and fisheye images into perspective views, which form rigs.

Usage::

    cutter = ViewCutter(make_panorama_camera(4096))   # or a fisheye camera
    views = cutter.cut(pixels)                         # one image for each of cutter.rotations
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path, PurePosixPath
from typing import NamedTuple

import cv2
import numpy as np
import pycolmap

from mpsfm_core.data import Bool, Float32, Float64, PinholeCamera, Pose, Rig, UInt8
from mpsfm_core.data.errors import InputError
from mpsfm_core.geometry import compose, inside, pixel_centers, rays
from mpsfm_core.geometry.fisheye import (
    find_visible_angles_deg,
    make_fisheye_view_rotations,
    measure_field_of_view_deg,
    project_wide,
)
from mpsfm_core.geometry.panorama import make_panorama_camera, make_view_camera, make_view_rotations
from mpsfm_core.geometry.pycolmap_conversion import camera_key
from mpsfm_core.inputs.image_decoding import (
    check_decodable,
    check_size,
    decode_rgb,
    read_bytes,
    upright_size,
)
from mpsfm_core.inputs.image_header import read_header
from mpsfm_core.inputs.images import find_known_cameras
from mpsfm_core.inputs.intrinsics import Cameras
from mpsfm_core.inputs.masks import find_masks, orient_masks
from mpsfm_core.inputs.options import InputOptions
from mpsfm_core.inputs.panorama import find_projection, has_panorama_size
from mpsfm_core.inputs.undistortion import is_pinhole
from mpsfm_core.support.files import write_file
from mpsfm_core.support.jpeg import encode_jpeg

MAX_FIELD_OF_VIEW_DEG = 120.0
"""Largest field of view of an image that is undistorted as a whole. An undistorted image with a
larger field of view has stretched corners or loses its border. [ours]"""


class CutImages(NamedTuple):
    """Perspective views of panoramas or fisheye images on disk, and copies of other images."""

    folder: Path
    """Folder of the views ``camera<number>/<name of the image>.jpg``, and of the copies of images
    that are not cut, under their own names."""
    cameras: dict[str, PinholeCamera | pycolmap.Camera]
    """Known camera of each view and copied image by name."""
    rigs: tuple[Rig, ...]
    """Rigs of the views. The pose of a frame without a rig of the caller is the pose of the cut
    image, for panoramas with x right, y down and z to the middle of the panorama."""
    masks: Path | None
    """Folder of the masks of the views, None if all pixels of all views are used."""
    view_names: dict[str, tuple[str, ...]]
    """Names of the views of each image, or its own name if the image is copied."""
    cutters: dict[str, ViewCutter | None]
    """Views of each image, None if the image is copied."""


class ViewCutter:
    """Perspective views of 90 degrees that cover the images of a panorama or fisheye camera.

    Attributes:
        camera: Camera of all views.
        rotations: (n, 3, 3) rotation ``view_from_camera`` of each view.
        tiling: Numbers of the views that cover all directions with the least overlap.
    """

    def __init__(self, image_camera: pycolmap.Camera, nadir_angle_deg: float = 0.0) -> None:
        """Compute the pixel maps of all views.

        Args:
            image_camera: Camera of the images, of COLMAP's EQUIRECTANGULAR or a fisheye model.
            nadir_angle_deg: Angle from the downward direction (y) up to which pixels are masked.
        """
        self.is_panorama = bool(image_camera.is_spherical())
        self.camera: PinholeCamera
        self.rotations: Float64
        visible_deg = 180.0
        if self.is_panorama:
            self.camera, self.rotations = (
                make_view_camera(image_camera.width),
                make_view_rotations(),
            )
        else:
            visible_deg = float(find_visible_angles_deg(image_camera).max())
            self.camera = make_view_camera(2 * np.pi * image_camera.mean_focal_length())
            self.rotations = make_fisheye_view_rotations(visible_deg)
        self.tiling = range(0, len(self.rotations), 2 if self.is_panorama else 1)
        self._maps: list[Float32] = []
        self._valid: list[Bool] = []
        size = image_camera.width, image_camera.height
        directions = rays(self.camera, pixel_centers(self.camera.width, self.camera.height))
        directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
        for rotation in self.rotations:
            turned = directions @ rotation
            pixels = project_wide(image_camera, turned.reshape(-1, 3))
            pixels = pixels.reshape((*turned.shape[:2], 2))
            valid = inside(pixels, size) & (turned[..., 2] >= np.cos(np.radians(visible_deg)))
            valid &= turned[..., 1] <= np.cos(np.radians(nadir_angle_deg))
            self._maps.append((pixels - 0.5).astype(np.float32))
            self._valid.append(valid)

    def cut(self, image: UInt8, numbers: Iterable[int] | None = None) -> list[UInt8]:
        """Cut an image into views, which are black outside of the image.

        Args:
            image: (h, w) or (h, w, 3) image.
            numbers: Numbers of the views to cut, by default all.
        """
        border = cv2.BORDER_WRAP if self.is_panorama else cv2.BORDER_CONSTANT
        maps = self._maps if numbers is None else [self._maps[number] for number in numbers]
        return [
            np.asarray(cv2.remap(image, m, None, cv2.INTER_LINEAR, borderMode=border), np.uint8)
            for m in maps
        ]

    def cut_mask(self, mask: Bool) -> list[Bool]:
        """Return the mask (h, w) of each view, False at pixels that are not used.

        Args:
            mask: (h, w) mask of the image, False at pixels that are not used.
        """
        source, border = mask.astype(np.uint8), cv2.BORDER_WRAP
        return [
            valid & (cv2.remap(source, pixels, None, cv2.INTER_NEAREST, borderMode=border) > 0)
            for pixels, valid in zip(self._maps, self._valid, strict=True)
        ]


def are_panoramas(folder: Path, names: Sequence[str]) -> bool:
    """Return True if the images of a folder are equirectangular panoramas of 360 x 180 degrees.

    All images must be twice as wide as high, and more than half of them must be recognized as
    panoramas by XMP data or by their pixels, because pixels do not show every panorama.

    Args:
        folder: Folder of the images.
        names: Names of the images below the folder.
    """
    num_recognized = 0
    for name in names:
        path = folder / name
        try:
            data = read_bytes(path)
            header = read_header(data)
            if not has_panorama_size(*upright_size(data, header, path)):
                return False
            num_recognized += find_projection(header, check_decodable(data, path)) is not None
        except InputError:
            return False
    return 2 * num_recognized > len(names)


def find_wide_cameras(
    folder: Path, names: Sequence[str], cameras: Path | Cameras, options: InputOptions
) -> dict[str, pycolmap.Camera]:
    """Return the known camera of each image, empty if no field of view is above the limit.

    Args:
        folder: Folder of the images.
        names: Names of the images below the folder.
        cameras: Cameras of the images, as for :func:`~mpsfm_core.inputs.images.load_images`.
        options: Options of reading images.
    """
    known = find_known_cameras(folder, names, cameras, options)
    by_key = {camera_key(camera): camera for camera in known.values()}
    wide = {key: _is_wide(camera) for key, camera in by_key.items()}
    return known if any(wide.values()) else {}


def _is_wide(camera: pycolmap.Camera) -> bool:
    """Return True if the field of view of a camera is above the limit."""
    return not is_pinhole(camera) and measure_field_of_view_deg(camera) > MAX_FIELD_OF_VIEW_DEG


def cut_images(
    folder: Path,
    names: Sequence[str],
    output: Path,
    masks_output: Path,
    options: InputOptions,
    *,
    cameras: Mapping[str, pycolmap.Camera] | None = None,
    rigs: Sequence[Rig] = (),
    progress: Callable[[int, int], None] | None = None,
) -> CutImages:
    """Cut all panoramas or wide-angle images of a folder into views, and write the views.

    The files of an earlier call are removed, because the images may have changed.

    Args:
        folder: Folder of the images.
        names: Names of the images below the folder.
        output: Folder of the views, which contains nothing else.
        masks_output: Folder of the masks of the views, which contains nothing else.
        options: Options with masks of the images, the masked angle around the nadir, and the
            maximum number of pixels of an image.
        cameras: Known camera of each image, or None for equirectangular panoramas. Images with a
            field of view of at most :data:`MAX_FIELD_OF_VIEW_DEG` are copied.
        rigs: Rigs of the images, whose sensors are replaced by those of the views.
        progress: Function that receives the number of cut images and their total number.

    Raises:
        InputError: An image or mask cannot be decoded, a panorama is not twice as wide as high, or
            a rig with a wide-angle camera has an unknown relative pose.
    """
    for written in (output, masks_output):
        if written.is_dir():
            shutil.rmtree(written)
    masks = {} if options.masks is None else find_masks(options.masks, names, folder)
    writes_masks = cameras is not None or bool(masks) or options.nadir_angle_deg > 0
    known: dict[str, PinholeCamera | pycolmap.Camera] = {}
    cutters: dict[str, ViewCutter | None] = {}
    frames: dict[str, tuple[str, ...]] = {}
    cutter_of: dict[str, ViewCutter | None] = {}
    for number, name in enumerate(names, start=1):
        path = folder / name
        data = read_bytes(path)
        check_size(data, path, options.max_pixels)
        header = read_header(data)
        size = upright_size(data, header, path)
        camera = _panorama_camera(path, size) if cameras is None else cameras[name]
        key = camera_key(camera)
        if key not in cutters:
            is_cut = cameras is None or _is_wide(camera)
            cutters[key] = ViewCutter(camera, options.nadir_angle_deg) if is_cut else None
        cutter = cutters[key]
        mask = np.ones(size[::-1], dtype=np.bool_)
        if name in masks:
            mask = _read_mask(name, masks[name], size, header.orientation, options)
        if cutter is None:
            view_names: tuple[str, ...] = (name,)
            view_masks = [mask]
            write_file(_with_parent(output / name), data)
        else:
            stem = PurePosixPath(name).with_suffix("").as_posix()
            view_names = tuple(f"camera{view}/{stem}.jpg" for view in range(len(cutter.rotations)))
            view_masks = cutter.cut_mask(mask)
            for view_name, view in zip(
                view_names, cutter.cut(decode_rgb(data, header, path)), strict=True
            ):
                _write_jpeg(output / view_name, view)
        if view_names[0] in known:
            raise InputError(f"images of {folder}: two images have the name of {name!r}")
        known |= dict.fromkeys(view_names, camera if cutter is None else cutter.camera)
        if writes_masks:
            for view_name, view_mask in zip(view_names, view_masks, strict=True):
                _write_mask(masks_output / f"{view_name}.png", view_mask)
        frames[name], cutter_of[name] = view_names, cutter
        if progress is not None:
            progress(number, len(names))
    view_rigs = _make_rigs(frames, cutter_of, rigs)
    used_masks = masks_output if writes_masks else None
    return CutImages(output, known, view_rigs, used_masks, frames, cutter_of)


def _read_mask(
    name: str, path: Path, size: tuple[int, int], orientation: int, options: InputOptions
) -> Bool:
    """Read the upright mask (h, w) of an image of the given upright size."""
    oriented, faults = orient_masks(
        {name: path},
        {name: size},
        {name: orientation},
        options.mask_orientation,
        options.max_pixels,
    )
    if faults:
        raise InputError(faults[name])
    return oriented[name].read(options.max_pixels)


def _make_rigs(
    frames: Mapping[str, tuple[str, ...]],
    cutters: Mapping[str, ViewCutter | None],
    rigs: Iterable[Rig],
) -> tuple[Rig, ...]:
    """Return the rigs of the views.

    Args:
        frames: Names of the views of each image.
        cutters: Views of each image, None for an image that is not cut.
        rigs: Rigs of the images.
    """
    made: list[Rig] = []
    in_rig: set[str] = set()
    for rig in rigs:
        in_rig.update(rig.image_names)
        if all(cutters[name] is None for name in rig.image_names):
            made.append(rig)
            continue
        if not rig.is_calibrated:
            raise InputError(
                f"rigs: a camera of the rig of {rig.image_names[0]} has a field of view above "
                f"{MAX_FIELD_OF_VIEW_DEG:g} degrees, so all relative poses of the rig must be "
                "known; add 'cam_from_rig_rotation' and 'cam_from_rig_translation' of every camera"
            )
        made.append(_expand_rig(rig, frames, cutters))
    separate: dict[int, list[str]] = {}
    for name, cutter in cutters.items():
        if cutter is not None and name not in in_rig:
            separate.setdefault(id(cutter), []).append(name)
    for names in separate.values():
        made.append(Rig(_view_poses(cutters[names[0]]), tuple(frames[name] for name in names)))
    return tuple(made)


def _expand_rig(
    rig: Rig, frames: Mapping[str, tuple[str, ...]], cutters: Mapping[str, ViewCutter | None]
) -> Rig:
    """Replace each sensor of a rig by the views of its images."""
    sensors: list[Pose] = []
    columns: list[list[tuple[str | None, ...]]] = []
    for sensor, pose in enumerate(rig.sensor_poses):
        names = [frame[sensor] for frame in rig.frames]
        poses = [_view_poses(cutters[name]) for name in names if name is not None]
        if not poses:
            continue
        if any(len(other) != len(poses[0]) for other in poses):
            raise InputError(
                f"rigs: the images of one camera of the rig of {rig.image_names[0]} have different "
                "fields of view; give one camera in --intrinsics for all images of a camera"
            )
        sensors += [compose(view, pose) for view in poses[0]]
        missing = (None,) * len(poses[0])
        columns.append([missing if name is None else frames[name] for name in names])
    rows = zip(*columns, strict=True)
    return Rig(tuple(sensors), tuple(tuple(n for part in row for n in part) for row in rows))


def _view_poses(cutter: ViewCutter | None) -> tuple[Pose, ...]:
    """Return the pose ``view_from_image`` of each view of an image."""
    rotations = [np.eye(3)] if cutter is None else cutter.rotations
    return tuple((rotation, np.zeros(3)) for rotation in rotations)


def _panorama_camera(path: Path, size: tuple[int, int]) -> pycolmap.Camera:
    """Return the camera of a panorama; raise InputError if it is not twice as wide as high."""
    if not has_panorama_size(*size):
        raise InputError(
            f"image {path} has {size[0]} x {size[1]} pixels, but an equirectangular panorama is "
            "twice as wide as high; remove the image or use --projection perspective"
        )
    return make_panorama_camera(*size)


def _with_parent(path: Path) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    return path


def _write_jpeg(path: Path, rgb: UInt8) -> None:
    """Write RGB pixels as a JPEG file."""
    bgr = np.asarray(cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR), np.uint8)
    write_file(_with_parent(path), encode_jpeg(bgr))


def _write_mask(path: Path, mask: Bool) -> None:
    """Write a mask as a PNG file, black at pixels that are not used."""
    pixels = np.where(mask, 255, 0).astype(np.uint8)
    write_file(_with_parent(path), cv2.imencode(".png", pixels)[1].tobytes())
