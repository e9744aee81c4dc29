"""Read cameras from ``intrinsics.yaml``, COLMAP files or ``transforms.json``.

The file ``intrinsics.yaml`` maps camera numbers to camera parameters::

    1:
      model: OPENCV            # any camera model of COLMAP; default PINHOLE (SIMPLE_PINHOLE for 3)
      params: [600, 600, 320, 240, 0.1, 0, 0, 0]
      width: 640               # optional, checked against the images
      height: 480
      images: all              # or a list of names; "all": images that no list names
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeAlias

import pycolmap
import yaml

from mpsfm_core.data import PinholeCamera
from mpsfm_core.data.errors import InputError, did_you_mean
from mpsfm_core.geometry.pycolmap_conversion import camera_key, colmap_from_pinhole
from mpsfm_core.inputs.colmap_database import read_database
from mpsfm_core.inputs.model_orientation import orient_camera, stored_size
from mpsfm_core.inputs.models import match_names, read_image_lines, read_model
from mpsfm_core.inputs.text_files import read_text_file

Camera: TypeAlias = PinholeCamera | pycolmap.Camera
Cameras: TypeAlias = Camera | Mapping[str, Camera] | pycolmap.Reconstruction
"""Cameras of the caller: one camera of all images, a camera by image name, or a COLMAP model."""

_DEFAULT_MODELS = {3: "SIMPLE_PINHOLE", 4: "PINHOLE"}
_NUM_ORIENTATIONS = 8
"""Number of EXIF orientations, 1 to 8."""
_KEYS = ("model", "params", "width", "height", "images")
_MIN_FOCAL_RATIO, _MAX_FOCAL_RATIO = 0.1, 10.0
"""Bounds of focal length over longer image side [COLMAP min/max_focal_length_ratio]."""
_CENTRAL = (0.8, 1.25)
"""Plausible ratios of principal point to image center, per axis."""
_SAME_SCALE = 0.1
"""Maximum relative difference between the x and y ratios of principal point to image center, if the
camera is for an image of another size."""


def choose_cameras(cameras: Cameras | None, intrinsics: str | Path | None) -> Path | Cameras | None:
    """Return the cameras or the file with the cameras, of which the caller gives at most one.

    Raises:
        TypeError: both are given.
    """
    if cameras is not None and intrinsics is not None:
        raise TypeError("give cameras or the file intrinsics, not both")
    return cameras if intrinsics is None else Path(intrinsics)


@dataclass(frozen=True)
class CameraEntry:
    """One camera of an intrinsics file."""

    camera_id: int
    """Number of the camera in the intrinsics file."""
    model: str
    """Name of the COLMAP camera model."""
    params: tuple[float, ...]
    """Camera parameters in COLMAP's order, in pixels."""
    size: tuple[int, int] | None
    """Image (width, height) of the camera in pixels, None if the file has no size."""
    images: frozenset[str] | None
    """Names of the images of the camera, None for all images that no other camera lists."""
    is_stored: bool = False
    """True if a camera, whose size fits the image before and after EXIF rotation, describes the
    image before EXIF rotation [COLMAP]."""


@dataclass(frozen=True)
class Intrinsics:
    """All cameras of an intrinsics file, or of the calling program."""

    source: Path | str
    """Path of the intrinsics file, or name of an argument, for error messages."""
    entries: tuple[CameraEntry, ...]

    def for_images(self, names: Iterable[str]) -> Intrinsics:
        """Return the cameras with their listed image names replaced by matching names of the run.

        The function :func:`~mpsfm_core.inputs.models.match_names` matches the image names.
        """
        listed = {image for entry in self.entries for image in entry.images or ()}
        new_names: dict[str, set[str]] = {}
        for name, listed_name in match_names(names, listed).items():
            new_names.setdefault(listed_name, set()).add(name)
        entries = (
            entry
            if entry.images is None
            else replace(
                entry, images=entry.images.union(*(new_names.get(i, ()) for i in entry.images))
            )
            for entry in self.entries
        )
        return Intrinsics(self.source, tuple(entries))

    @property
    def max_id(self) -> int:
        """Return the largest camera number, including numbers of cameras after EXIF rotation."""
        return self._max_file_id + _NUM_ORIENTATIONS * len(self.entries)

    @property
    def _max_file_id(self) -> int:
        return max((entry.camera_id for entry in self.entries), default=0)

    def usual_camera(
        self, name: str, size: tuple[int, int], orientation: int = 1
    ) -> pycolmap.Camera | None:
        """Return the camera that lists an image, else the only camera of the image size.

        Returns:
            The camera, or None if no camera lists the image and its size does not determine one.

        Raises:
            InputError: as :meth:`camera`.
        """
        if any(name in (entry.images or ()) for entry in self.entries):
            return self.camera(name, size, orientation)
        sizes = (size, stored_size(size, orientation))
        same = [entry for entry in self.entries if entry.size in sizes]
        return self._checked(same[0], name, size, orientation) if len(same) == 1 else None

    def camera(self, name: str, size: tuple[int, int], orientation: int = 1) -> pycolmap.Camera:
        """Return the camera of an image after EXIF rotation.

        Args:
            name: name of the image.
            size: (width, height) of the image after EXIF rotation.
            orientation: EXIF orientation of the image; a camera for the pixels before EXIF rotation
                is rotated.

        Raises:
            InputError: the file has no camera for the image, or its camera is for images of another
                size.
        """
        return self._checked(self._entry(name), name, size, orientation)

    def _checked(
        self, entry: CameraEntry, name: str, size: tuple[int, int], orientation: int
    ) -> pycolmap.Camera:
        """Return a camera for an image; raise :class:`InputError` if the camera does not fit."""
        width, height = entry.size or size
        camera = pycolmap.Camera(
            model=entry.model,
            width=width,
            height=height,
            params=list(entry.params),
            camera_id=entry.camera_id,
        )
        fits_stored = entry.size == stored_size(size, orientation)
        if orientation != 1 and fits_stored and (entry.is_stored or entry.size != size):
            camera = orient_camera(camera, orientation)
            row = self.entries.index(entry)
            camera.camera_id = self._max_file_id + _NUM_ORIENTATIONS * row + orientation
            entry = replace(entry, size=size)
        fault = _fault(camera, entry, size)
        if fault:
            raise InputError(
                f"{self.source}, camera {entry.camera_id}, image {name!r} "
                f"({size[0]}x{size[1]} pixels): {fault}"
            )
        return camera

    def _entry(self, name: str) -> CameraEntry:
        for entry in self.entries:
            if entry.images is not None and name in entry.images:
                return entry
        for entry in self.entries:
            if entry.images is None:
                return entry
        listed = [image for entry in self.entries for image in entry.images or ()]
        raise InputError(
            f"{self.source} has no camera for image {name!r}{did_you_mean(name, listed)}; "
            f"add the camera, or give one camera of all images ('images: all' in intrinsics.yaml)"
        )


def read_intrinsics(path: Path, images_folder: Path | None = None) -> Intrinsics:
    """Read cameras from an intrinsics file, a COLMAP model or database, or ``transforms.json``.

    Args:
        path: ``intrinsics.yaml``, a COLMAP model, its ``cameras.txt``, a COLMAP database (``.db``)
            or ``transforms.json``.
        images_folder: folder of the images, needed by a ``transforms.json`` without image sizes.

    Raises:
        InputError: the file cannot be read; the message names the file, camera and fault.
    """
    try:
        if path.is_dir():
            has_images = any((path / name).is_file() for name in ("images.txt", "images.bin"))
            text = path / "cameras.txt"
            is_list = text.is_file() and not has_images
            entries = _from_text(text) if is_list else _from_model(path, images_folder, path)
        elif path.suffix == ".json":
            entries = _from_model(path, images_folder, path)
        elif path.suffix == ".db":
            entries = _from_database(path)
        elif path.suffix == ".txt":
            entries = _from_text(path)
        else:
            entries = _from_yaml(path)
    except (OSError, ValueError, OverflowError) as error:
        raise InputError(f"intrinsics {path} cannot be read: {error}") from error
    _check_lists(path, entries)
    return Intrinsics(path, entries)


def intrinsics_from_cameras(
    cameras: Cameras, images_folder: Path | None = None, source: str = "cameras"
) -> Intrinsics:
    """Convert cameras of the calling program, which are cameras of images after EXIF rotation.

    Args:
        cameras: Camera of all images, camera of each image by name, or COLMAP model.
        images_folder: Folder of the images of a COLMAP model of stored pixels.
        source: Name of the argument with the cameras, for error messages.

    Raises:
        InputError: ``cameras`` has another type.
    """
    if isinstance(cameras, pycolmap.Reconstruction):
        entries = _from_model(cameras, images_folder, source)
    elif isinstance(cameras, Mapping):
        entries = _from_mapping(source, cameras)
    else:
        camera = _to_colmap(source, cameras)
        size = camera.width, camera.height
        entries = (_entry(source, 1, camera.model_name, list(camera.params), size, None),)
    return Intrinsics(source, entries)


def _from_mapping(source: str, cameras: Mapping[str, Camera]) -> tuple[CameraEntry, ...]:
    """Return the distinct cameras of a mapping, with the names of their images."""
    distinct: dict[str, pycolmap.Camera] = {}
    names: dict[str, list[str]] = {}
    for name, given in cameras.items():
        camera = _to_colmap(f"{source}: image {name!r}", given)
        distinct.setdefault(camera_key(camera), camera)
        names.setdefault(camera_key(camera), []).append(name)
    numbered = dict(enumerate(distinct, start=1))
    return _from_cameras(
        source,
        {number: distinct[key] for number, key in numbered.items()},
        {number: names[key] for number, key in numbered.items()},
    )


def _to_colmap(where: str, camera: object) -> pycolmap.Camera:
    if isinstance(camera, PinholeCamera):
        return colmap_from_pinhole(camera)
    if not isinstance(camera, pycolmap.Camera):
        kind = type(camera).__name__
        raise InputError(f"{where}: expected a PinholeCamera or pycolmap.Camera, got {kind}")
    return camera


def _from_yaml(path: Path) -> tuple[CameraEntry, ...]:
    try:
        data = yaml.safe_load(read_text_file(path))
    except UnicodeDecodeError as error:
        known = "a COLMAP model, database (.db) or transforms.json"
        raise InputError(f"{path} is binary, and neither a YAML file nor {known}") from error
    except (yaml.YAMLError, RecursionError, ValueError) as error:
        raise InputError(f"{path} is not valid YAML: {' '.join(str(error).split())}") from error
    if not isinstance(data, Mapping) or not data:
        raise InputError(
            f"{path}: expected cameras by number; docs/inputs.md shows intrinsics.yaml"
        )
    return tuple(_yaml_entry(path, key, value) for key, value in data.items())


def _yaml_entry(path: Path, key: object, value: object) -> CameraEntry:
    where = f"{path}, camera {key}"
    if not isinstance(key, int) or isinstance(key, bool):
        raise InputError(f"{where}: the key of a camera must be a number (1:, 2:, ...)")
    if not isinstance(value, Mapping):
        raise InputError(f"{where}: expected a mapping of the camera with 'params' and 'images'")
    for name in value:
        if name not in _KEYS:
            raise InputError(
                f"{where}: unknown camera key {name!r}{did_you_mean(str(name), _KEYS)}"
            )
    params: Any = value.get("params")
    if not _is_list_of(params, (int, float)):
        raise InputError(f"{where}: camera 'params' must be a list of numbers")
    size: Any = (value.get("width"), value.get("height"))
    if size == (None, None):
        size = None
    elif not _is_list_of(size, int):
        raise InputError(
            f"{where}: camera 'width' and 'height' must be whole numbers, or both absent"
        )
    images: Any = value.get("images", "all")
    if images != "all" and not _is_list_of(images, str):
        raise InputError(f"{where}: camera 'images' must be 'all' or a list of image names")
    model = value.get("model") or _DEFAULT_MODELS.get(len(params))
    return _entry(where, key, model, params, size, None if images == "all" else images)


def _from_text(path: Path) -> tuple[CameraEntry, ...]:
    """Read ``cameras.txt`` of COLMAP and the image names of ``images.txt`` in the same folder.

    Query lists of hloc, whose lines start with an image name instead of a camera id, are read too.
    """
    names: dict[int, list[str]] = {}
    listing = path.with_name("images.txt")
    if listing.is_file():
        for camera_id, name in read_image_lines(listing).values():
            names.setdefault(camera_id, []).append(name)
    lines = (line.strip() for line in read_text_file(path).splitlines())
    cameras = [line.split() for line in lines if line and not line.startswith("#")]
    if cameras and all(not fields[0].isdigit() for fields in cameras):
        names = {number: [fields[0]] for number, fields in enumerate(cameras, start=1)}
        cameras = [[str(number), *f[1:]] for number, f in enumerate(cameras, start=1)]
    entries = []
    for fields in cameras:
        where = f"{path}, camera {fields[0]}"
        try:
            number, size = int(fields[0]), (int(fields[2]), int(fields[3]))
            params = [float(value) for value in fields[4:]]
        except (ValueError, IndexError) as error:
            raise InputError(
                f"{where}: expected the cameras.txt line ID MODEL WIDTH HEIGHT PARAMS"
            ) from error
        images = names.get(number, []) if names or len(cameras) > 1 else None
        entry = _entry(where, number, fields[1], params, size, images)
        entries.append(replace(entry, is_stored=True))
    return tuple(entries)


def _from_database(path: Path) -> tuple[CameraEntry, ...]:
    database = read_database(path)
    names: dict[int, list[str]] = {}
    for name, number in database.images.items():
        names.setdefault(database.camera_of[number], []).append(name)
    entries = _from_cameras(path, database.cameras, names)
    return tuple(replace(entry, is_stored=True) for entry in entries)


def _from_model(
    path: Path | pycolmap.Reconstruction, images_folder: Path | None, source: Path | str
) -> tuple[CameraEntry, ...]:
    model = read_model(path, images_folder)
    names: dict[int, list[str]] = {}
    for image in model.images.values():
        names.setdefault(image.camera_id, []).append(image.name)
    return _from_cameras(source, model.cameras, names)


def _from_cameras(
    source: Path | str, cameras: Mapping[int, pycolmap.Camera], names: Mapping[int, list[str]]
) -> tuple[CameraEntry, ...]:
    return tuple(
        _entry(
            f"{source}, camera {number}",
            number,
            camera.model_name,
            list(camera.params),
            (camera.width, camera.height),
            names.get(number, []),
        )
        for number, camera in cameras.items()
    )


def _entry(
    where: str,
    number: int,
    model: object,
    params: Sequence[float],
    size: tuple[int, int] | None,
    names: Iterable[str] | None,
) -> CameraEntry:
    known = [name for name in pycolmap.CameraModelId.__members__ if name != "INVALID"]
    if model is None:
        raise InputError(
            f"{where}: {len(params)} camera params need a 'model', one of {', '.join(known)}"
        )
    if model not in known:
        raise InputError(
            f"{where}: unknown camera model {model!r}{did_you_mean(str(model), known)}"
        )
    camera = pycolmap.Camera(model=model, width=1, height=1, params=list(params))
    if not camera.verify_params():
        raise InputError(
            f"{where}: model {model} has the parameters {camera.params_info}, "
            f"got {len(params)} values"
        )
    images = None if names is None else frozenset(names)
    return CameraEntry(number, str(model), tuple(float(p) for p in params), size, images)


def _check_lists(path: Path, entries: Sequence[CameraEntry]) -> None:
    if sum(entry.images is None for entry in entries) > 1:
        raise InputError(f"{path}: only one camera can have 'images: all'")
    owners: dict[str, int] = {}
    for entry in entries:
        for name in entry.images or ():
            if name in owners:
                raise InputError(
                    f"{path}: image {name!r} has two cameras, {owners[name]} and {entry.camera_id}"
                )
            owners[name] = entry.camera_id


def _fault(camera: pycolmap.Camera, entry: CameraEntry, size: tuple[int, int]) -> str | None:
    """Return why a camera does not fit an image size and what to do, or None if the camera fits."""
    if entry.size is not None and entry.size != size:
        return (
            f"the intrinsics are for {entry.size[0]}x{entry.size[1]} pixels; give those of the "
            f"image as it is seen upright, or the images they were made for"
        )
    if not camera.is_perspective():
        return f"{entry.model} images cannot be undistorted to a perspective view"
    center = camera.principal_point_x, camera.principal_point_y
    ratio = [2 * c / s for c, s in zip(center, size, strict=True)]
    wanted = "give fx, fy, cx, cy in pixels of this image"
    if not all(0 < r < 2 for r in ratio):
        return (
            f"the principal point ({center[0]:g}, {center[1]:g}) is outside of the image; {wanted}"
        )
    off_center = [not _CENTRAL[0] < r < _CENTRAL[1] for r in ratio]
    if entry.size is None and all(off_center) and abs(ratio[0] / ratio[1] - 1) < _SAME_SCALE:
        return (
            f"the principal point ({center[0]:g}, {center[1]:g}) belongs to an image of about "
            f"{2 * center[0]:.0f}x{2 * center[1]:.0f} pixels; {wanted} (or add width and height "
            f"if it really is so far from the center)"
        )
    focal_ratio = camera.mean_focal_length() / max(size)
    if not _MIN_FOCAL_RATIO < focal_ratio < _MAX_FOCAL_RATIO:
        return f"a focal length of {focal_ratio:.3g} times the longer side is not plausible"
    return None


def _is_list_of(value: object, kinds: type | tuple[type, ...]) -> bool:
    return isinstance(value, (list, tuple)) and all(
        isinstance(v, kinds) and not isinstance(v, bool) for v in value
    )
