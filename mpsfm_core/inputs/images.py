"""The images of a run: found, checked, given cameras, and loaded as views when needed."""

from __future__ import annotations

import hashlib
import logging
import re
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
import pycolmap

from mpsfm_core.data import Bool, Float64, PinholeCamera, UInt8, View
from mpsfm_core.data.errors import InputError, did_you_mean
from mpsfm_core.data.result_layout import SUMMARY
from mpsfm_core.geometry.pycolmap_conversion import camera_key
from mpsfm_core.inputs.gps import GpsPosition, read_gps
from mpsfm_core.inputs.image_decoding import (
    EXTENSIONS,
    check_decodable,
    check_size,
    decode_rgb,
    read_bytes,
    read_mask,
    upright_size,
)
from mpsfm_core.inputs.image_header import ImageHeader, read_header
from mpsfm_core.inputs.intrinsics import Intrinsics, read_intrinsics
from mpsfm_core.inputs.options import InputOptions
from mpsfm_core.inputs.undistortion import (
    UndistortionMap,
    distort_pixels,
    is_pinhole,
    resize_camera,
    undistort_camera,
    undistort_pixels,
)
from mpsfm_core.support.lru_cache import LruCache
from mpsfm_core.support.threads import allowed

_log = logging.getLogger(__name__)

FocalSource = Literal["intrinsics", "exif", "provider", "default"]

CACHED_BYTES = 512 << 20
"""Decoded views that are kept: the matcher asks for each image many times."""
_CACHED_WARPS = 2
"""A warp has 8 bytes a pixel, and neighbouring images mostly share a camera."""
_READERS = 4
"""Threads that read and hash files, at most."""
_MENTIONED = 5


@dataclass(frozen=True, eq=False)
class SourceImage:
    """One photo.

    ``name``: path below the images folder, forward slashes. ``camera``: the original camera, for
    the upright image; ``camera_id`` is the number in the intrinsics file, or counts distinct
    cameras. ``pinhole``: the camera of the undistorted (maybe reduced) view. ``focal_known``:
    False when the focal length is a guess: EXIF's, a provider's or the default. ``digest``: SHA-256
    of the file. ``orientation``: EXIF's, of the stored pixels. ``gps``: where it was
    taken, if EXIF says it.
    """

    name: str
    path: Path
    camera: pycolmap.Camera
    pinhole: PinholeCamera
    focal_source: FocalSource
    digest: str
    orientation: int = 1
    gps: GpsPosition | None = None

    def original_pixels(self, xy: Float64) -> Float64:
        """Pixels (n, 2) of the undistorted view as pixels of the upright original image."""
        return distort_pixels(self.pinhole, self.camera, xy)

    def view_pixels(self, xy: Float64) -> Float64:
        """Pixels (n, 2) of the upright original image as pixels of the undistorted view."""
        return undistort_pixels(self.pinhole, self.camera, xy)

    def refined_camera(self, pinhole: PinholeCamera) -> pycolmap.Camera:
        """The original camera, with the focal length that a refined camera of the view has.

        Focal lengths are refined when they were a guess, and guessed cameras have no distortion,
        so that scaling the focal length is exact.
        """
        camera = pycolmap.Camera(self.camera.todict())
        params = np.array(camera.params)
        params[list(camera.focal_length_idxs())] *= pinhole.fx / self.pinhole.fx
        camera.params = params
        return camera

    @property
    def focal_known(self) -> bool:
        """Whether the focal length need not be refined."""
        return self.focal_source == "intrinsics"

    @property
    def original_size(self) -> tuple[int, int]:
        """(width, height) of the upright original image."""
        return self.camera.width, self.camera.height


class ImageSet:
    """Images of a run in a fixed order, with their views on demand.

    At most about 512 MB of decoded views are kept. Methods may be called from several threads.
    ``left_out``: damaged photos -> what is wrong with them.
    """

    def __init__(
        self,
        images: Sequence[SourceImage],
        options: InputOptions,
        left_out: Mapping[str, str] | None = None,
    ) -> None:
        self.images = tuple(images)
        self.left_out = dict(left_out or {})
        self._options = options
        self._views: LruCache[int, View] = LruCache(CACHED_BYTES, _bytes)
        self._warps: LruCache[str, UndistortionMap] = LruCache(_CACHED_WARPS, lambda _: 1)

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.images, self._options)  # decoded views stay where they are

    def __len__(self) -> int:
        return len(self.images)

    def __iter__(self) -> Iterator[SourceImage]:
        return iter(self.images)

    def __getitem__(self, index: int) -> SourceImage:
        return self.images[index]

    @property
    def names(self) -> list[str]:
        """Names of the images in order."""
        return [image.name for image in self.images]

    def view(self, index: int) -> View:
        """The undistorted view of an image, decoded now or recently.

        Raises :class:`InputError` when the file (or its mask) is unreadable or has changed.
        """
        return self._views.get(index, lambda: self._load(self.images[index]))

    def with_focals(self, focals: Mapping[int, float]) -> ImageSet:
        """The same images, with other focal lengths where they are the default.

        ``focals``: camera id -> pixels of the original image; still a guess.
        """

        def changed(image: SourceImage) -> SourceImage:
            number = image.camera.camera_id
            if image.focal_source != "default" or number not in focals:
                return image
            camera = _simple_camera(image.original_size, focals[number], number)
            pinhole = _view_camera(camera, self._options)
            return replace(image, camera=camera, pinhole=pinhole, focal_source="provider")

        images = [changed(image) for image in self.images]
        return ImageSet(images, self._options, self.left_out)

    def mask(self, index: int) -> Bool | None:
        """The mask of a view; does not decode the image when there is none."""
        image = self.images[index]
        if is_pinhole(image.camera) and self._mask_path(image) is None:
            return None
        return self.view(index).mask

    def pixel_key(self, index: int) -> str:
        """Names the content of a view: equal keys mean equal pixels and mask.

        Made of the file's hash and all that undistortion and reduction depend on; intrinsics of
        an image that needs no undistortion do not enter.
        """
        image = self.images[index]
        parts = [image.digest, str(image.pinhole.size)]
        if not is_pinhole(image.camera):
            parts += [camera_key(image.camera), str(image.pinhole.params.tolist())]
        mask = self._mask_path(image)
        if mask is not None:
            parts.append(hashlib.sha256(read_bytes(mask)).hexdigest())
        return hashlib.sha256("\n".join(parts).encode()).hexdigest()

    def _load(self, image: SourceImage) -> View:
        data = read_bytes(image.path)
        pixels = decode_rgb(data, read_header(data), image.path)
        if (pixels.shape[1], pixels.shape[0]) != image.original_size:
            raise InputError(f"image {image.path} has changed its size during the run")
        mask = self._user_mask(image)
        if is_pinhole(image.camera):
            pixels = _resize(pixels, image.pinhole.size)
            mask = None if mask is None else _resize_mask(mask, image.pinhole.size)
            return View(image.name, pixels, image.pinhole, mask)
        size = _reduced_size(image.original_size, self._options.max_image_size)
        camera = resize_camera(image.camera, size)
        warp = self._warps.get(camera_key(camera), lambda: UndistortionMap(camera, image.pinhole))
        pixels = warp.image(_resize(pixels, size))
        if mask is not None:
            mask = warp.mask(_resize_mask(mask, size))
        elif not warp.valid.all():
            mask = warp.valid
        return View(image.name, pixels, image.pinhole, mask)

    def _mask_path(self, image: SourceImage) -> Path | None:
        folder = self._options.masks
        if folder is None:
            return None
        exact = folder / f"{image.name}.png"
        candidates = [exact, (folder / image.name).with_suffix(".png")]
        return next((path for path in candidates if path.is_file()), None)

    def _user_mask(self, image: SourceImage) -> Bool | None:
        path = self._mask_path(image)
        if path is None:
            return None
        mask = read_mask(path, self._options.max_pixels)
        if (mask.shape[1], mask.shape[0]) != image.original_size:
            raise InputError(
                f"mask {path} has {mask.shape[1]}x{mask.shape[0]} pixels, its image "
                f"{image.name!r} has {image.camera.width}x{image.camera.height}"
            )
        return mask


def load_images(
    folder: Path,
    intrinsics: Path | None = None,
    image_list: Path | None = None,
    options: InputOptions | None = None,
    *,
    model: Path | None = None,
    without: Path | None = None,
    names: Sequence[str] | None = None,
) -> ImageSet:
    """Find the images of a folder (and its subfolders), check them, and find their cameras.

    Args:
        folder: images, in the formats of :data:`mpsfm_core.inputs.image_decoding.EXTENSIONS`.
        intrinsics: ``intrinsics.yaml``, a COLMAP model (folder or ``cameras.txt``) or
            ``transforms.json``, for the images upright (after EXIF rotation). Without it focal
            lengths come from EXIF, else from ``options.default_focal_ratio`` with a warning.
        image_list: text file with one name a line (``#`` starts a comment); its order is kept.
        options: see :class:`InputOptions`.
        model: COLMAP model or ``transforms.json`` of some of the images. Without ``intrinsics``
            they have its cameras, and the others too if it has just one of their size.
        names: these images only, instead of all or of those of ``image_list``; one is enough.

    Raises:
        InputError: no or only one image, unreadable files, names of the list that do not exist
            or come twice, intrinsics that do not fit. The message names the file.
    """
    options = options or InputOptions()
    if options.masks is not None and not options.masks.is_dir():
        raise InputError(f"masks folder {options.masks} does not exist")
    if names is None:
        names = find_images(folder, without)
        if image_list is not None:
            names = _listed(image_list, names, folder)
        if len(names) < 2:
            found = f"only one image, {names[0]!r}" if names else "no images"
            source = image_list or folder
            raise InputError(f"{source} has {found}: a reconstruction needs two or more")
    known = _read_cameras(intrinsics, names)
    partial = _read_cameras(model, names) if known is None else None
    with ThreadPoolExecutor(min(_READERS, allowed())) as pool:
        files = list(pool.map(lambda name: _probe(folder / name, options), names))
    left_out = {name: file.fault for name, file in zip(names, files, strict=True) if file.fault}
    _judge(left_out, len(names), options)
    guesses = _CameraGuesses(options, partial.max_id if partial else 0)
    images = []
    for name, file in zip(names, files, strict=True):
        if file.fault:
            continue
        focal: FocalSource = "intrinsics"
        if known is not None:
            camera = known.camera(name, file.size)
        elif (usual := partial and partial.usual_camera(name, file.size)) is not None:
            camera = usual
        else:
            camera, focal = guesses.camera(file)
        images.append(_source_image(name, folder / name, file, camera, focal, options))
    _warn_of_default(images, options)
    return ImageSet(images, options, left_out)


def _read_cameras(path: Path | None, names: Sequence[str]) -> Intrinsics | None:
    return None if path is None else read_intrinsics(path).for_images(names)


@dataclass(frozen=True)
class _ProbedImage:
    """A probed image file: upright size, header and hash; or why it is unreadable."""

    size: tuple[int, int]
    header: ImageHeader
    digest: str
    fault: str = ""
    gps: GpsPosition | None = None


class _CameraGuesses:
    """Cameras from EXIF, else the default; equal ones share an id above ``max_id``."""

    def __init__(self, options: InputOptions, max_id: int) -> None:
        self._options = options
        self._max_id = max_id
        self._ids: dict[tuple[tuple[int, int], float], int] = {}

    def camera(self, file: _ProbedImage) -> tuple[pycolmap.Camera, FocalSource]:
        """A SIMPLE_PINHOLE camera with the principal point in the centre."""
        source: FocalSource = "exif"
        focal = file.header.focal_px(*file.size)
        if focal is None:
            source, focal = "default", self._options.default_focal_ratio * max(file.size)
        number = self._ids.setdefault((file.size, focal), self._max_id + len(self._ids) + 1)
        return _simple_camera(file.size, focal, number), source


def _source_image(
    name: str,
    path: Path,
    file: _ProbedImage,
    camera: pycolmap.Camera,
    focal: FocalSource,
    options: InputOptions,
) -> SourceImage:
    pinhole = _view_camera(camera, options)
    orientation = file.header.orientation
    return SourceImage(name, path, camera, pinhole, focal, file.digest, orientation, file.gps)


def _simple_camera(size: tuple[int, int], focal: float, number: int) -> pycolmap.Camera:
    """A SIMPLE_PINHOLE camera with the principal point in the centre."""
    width, height = size
    params = [focal, width / 2, height / 2]
    return pycolmap.Camera(
        model="SIMPLE_PINHOLE", width=width, height=height, params=params, camera_id=number
    )


def _view_camera(camera: pycolmap.Camera, options: InputOptions) -> PinholeCamera:
    """The camera of the view that is made of an image."""
    original = camera.width, camera.height
    size = _reduced_size(original, options.max_image_size)
    reduced = camera if size == original else resize_camera(camera, size)
    return undistort_camera(reduced, options.blank_pixels)


def find_images(folder: Path, without: Path | None = None) -> list[str]:
    """Names of all images below the folder, in natural order.

    Hidden files are left out, and what lies in the subfolder ``without`` or in one that has a
    :data:`SUMMARY`: that holds results.
    """
    if not folder.is_dir():
        if folder.exists():
            raise InputError(f"{folder} is neither a folder of photos nor a video")
        raise InputError(f"images folder {folder} does not exist")
    found = []
    own = _below(without, folder)
    for path in folder.rglob("*"):
        relative = path.relative_to(folder)
        hidden = any(part.startswith(".") for part in relative.parts)
        if path.suffix.lower() not in EXTENSIONS or hidden or not path.is_file():
            continue
        parents = [folder / parent for parent in relative.parents[:-1]]
        if not any(parent == own or (parent / SUMMARY).is_file() for parent in parents):
            found.append(relative.as_posix())
    return sorted(found, key=_natural)


def check_output_folder(output: Path, folder: Path) -> None:
    """Raise :class:`InputError` if results in ``output`` would lie among photos."""
    if output.resolve() == folder.resolve():
        raise InputError(
            f"{output} is the folder of the photos: results must not lie among them; choose "
            f"another output folder, as {output / 'reconstruction'}"
        )
    inside = _below(output, folder)
    if inside is None or not inside.is_dir() or (inside / SUMMARY).is_file():
        return
    if photos := find_images(inside):
        raise InputError(
            f"{output} is a subfolder of the photos and holds {len(photos)} of them, as "
            f"{photos[0]}: results must not lie among them; choose another output folder"
        )


def _below(inner: Path | None, folder: Path) -> Path | None:
    """A folder as a path that begins with ``folder``, None if it is not below it."""
    if inner is None or not inner.resolve().is_relative_to(folder.resolve()):
        return None
    return folder / inner.resolve().relative_to(folder.resolve())


def _natural(name: str) -> list[tuple[int, int, str]]:
    """Sorts ``img2`` before ``img10``: names of a sequence are in the order they were taken."""
    parts = re.split(r"(\d+)", name)
    return [(1, int(p), p) if p.isdecimal() else (0, 0, p) for p in parts]


def read_image_list(path: Path) -> list[str]:
    """The names in a text file with one name a line; ``#`` starts a comment line.

    Raises :class:`InputError` when the file cannot be read.
    """
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"image list {path} cannot be read: {error}") from error
    return [line.strip() for line in lines if line.strip() and not line.lstrip().startswith("#")]


def _listed(image_list: Path, names: list[str], folder: Path) -> list[str]:
    listed = read_image_list(image_list)
    available, seen = set(names), set()
    for name in listed:
        if name in seen:
            raise InputError(f"{image_list}: image {name!r} is listed twice")
        if name not in available:
            near = did_you_mean(name, names) if len(names) <= 1000 else ""
            raise InputError(f"{image_list}: there is no image {name!r} in {folder}{near}")
        seen.add(name)
    return listed


def _probe(path: Path, options: InputOptions) -> _ProbedImage:
    try:
        data = read_bytes(path)
    except InputError as error:
        return _ProbedImage((0, 0), ImageHeader(None, 1, {}), "", str(error))
    check_size(data, path, options.max_pixels)
    try:
        check_decodable(data, path)
        header = read_header(data)
        if header.projection is not None:
            raise InputError(
                f"image {path} is a panorama ({header.projection}): cut it into perspective views "
                f"first, for example with ffmpeg's v360 filter"
            )
        size = upright_size(data, header, path)
    except InputError as error:
        return _ProbedImage((0, 0), ImageHeader(None, 1, {}), "", str(error))
    return _ProbedImage(size, header, hashlib.sha256(data).hexdigest(), gps=read_gps(data))


def _judge(left_out: Mapping[str, str], total: int, options: InputOptions) -> None:
    """Warn of damaged photos, or raise if they end the run."""
    if not left_out:
        return
    faults = list(left_out.values())
    rest = len(faults) - _MENTIONED
    text = "; ".join(faults[:_MENTIONED]) + (f"; and {rest} more" if rest > 0 else "")
    if options.strict:
        raise InputError(f"{text} (inputs.strict=false leaves damaged photos out)")
    if len(faults) > total / 2 or total - len(faults) < 2:
        raise InputError(f"{len(faults)} of {total} photos are damaged: {text}")
    _log.warning("%d of %d photos are damaged and left out: %s", len(faults), total, text)


def _warn_of_default(images: Sequence[SourceImage], options: InputOptions) -> None:
    guessed = [image.name for image in images if image.focal_source == "default"]
    if guessed:
        _log.warning(
            "%d of %d images (%s%s) have no known focal length: assuming %g times the longer "
            "side; give intrinsics for a better result",
            len(guessed),
            len(images),
            ", ".join(guessed[:_MENTIONED]),
            ", ..." if len(guessed) > _MENTIONED else "",
            options.default_focal_ratio,
        )


def _reduced_size(size: tuple[int, int], limit: int | None) -> tuple[int, int]:
    if limit is None or max(size) <= limit:
        return size
    factor = limit / max(size)
    return max(1, round(size[0] * factor)), max(1, round(size[1] * factor))


def _resize(image: UInt8, size: tuple[int, int]) -> UInt8:
    if (image.shape[1], image.shape[0]) == size:
        return image
    resized: UInt8 = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    return resized


def _resize_mask(mask: Bool, size: tuple[int, int]) -> Bool:
    if (mask.shape[1], mask.shape[0]) == size:
        return mask
    resized = cv2.resize(mask.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST_EXACT)
    allowed: Bool = resized > 0
    return allowed


def _bytes(view: View) -> int:
    return view.image.nbytes + (0 if view.mask is None else view.mask.nbytes)
