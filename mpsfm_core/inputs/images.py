"""Find and check the images of a run, assign cameras, and undistort images on demand."""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path, PurePosixPath
from types import MappingProxyType
from typing import Any

import cv2
import numpy as np
import pycolmap
from numpy.typing import NDArray

from mpsfm_core.data import Bool, Float64, PinholeCamera, UInt8, View
from mpsfm_core.data.camera_models import NUM_DISTORTION, CameraModel
from mpsfm_core.data.errors import InputError
from mpsfm_core.geometry.pycolmap_conversion import camera_key
from mpsfm_core.inputs.camera_sharing import FocalSource, guess_cameras
from mpsfm_core.inputs.gps import GpsPosition, read_gps
from mpsfm_core.inputs.image_decoding import (
    EXTENSIONS,
    check_decodable,
    check_size,
    decode_rgb,
    orient,
    read_bytes,
    upright_size,
)
from mpsfm_core.inputs.image_header import ImageHeader, read_header
from mpsfm_core.inputs.image_search import (
    MAX_LISTED,
    find_images,
    require_two_images,
    select_listed_images,
)
from mpsfm_core.inputs.intrinsics import (
    Cameras,
    Intrinsics,
    intrinsics_from_cameras,
    read_intrinsics,
)
from mpsfm_core.inputs.masks import (
    MaskFile,
    decode_opacity,
    find_masks,
    orient_masks,
    resize_mask,
)
from mpsfm_core.inputs.options import InputOptions
from mpsfm_core.inputs.panorama import find_projection
from mpsfm_core.inputs.undistortion import (
    UndistortionMap,
    distort_pixels,
    is_pinhole,
    resize_camera,
    undistort_camera,
    undistort_pixels,
)
from mpsfm_core.support.files import write_file
from mpsfm_core.support.lru_cache import LruCache
from mpsfm_core.support.threads import thread_limit

_log = logging.getLogger(__name__)

FOCAL_FROM_USER: FocalSource = "intrinsics"

FOCAL_LOG_STD: Mapping[FocalSource, float] = MappingProxyType(
    {"intrinsics": 0.01, "exif": 0.1, "provider": 0.2, "default": 0.7}
)
"""Prior std of the log focal length by source (EXIF, default ratio or network). EXIF focal lengths
are rounded, and the default ratio must cover wide-angle and telephoto lenses. [ours]"""
CACHED_BYTES = 512 << 20
"""Size in bytes of the cache of undistorted images, because the matcher reads each image often."""
_THUMBNAIL = 32, 32
"""Width and height of thumbnails, which show where the edges of an image are."""
_CACHED_MAPS = 2
"""Number of cached undistortion maps; a map takes 8 bytes per pixel, and images share cameras."""
_READERS = 4
"""Maximum number of threads that read and hash image files."""


@dataclass(frozen=True, eq=False)
class SourceImage:
    """Image file with its original camera and the camera of its undistorted view."""

    name: str
    """Image name, the path relative to the images folder with forward slashes."""
    path: Path
    """Path of the image file."""
    camera: pycolmap.Camera
    """Camera of the upright original image. The ``camera_id`` of the camera is the number in the
    intrinsics file, if given, else a running number."""
    pinhole: PinholeCamera
    """Pinhole camera of the undistorted and possibly downscaled image."""
    focal_source: FocalSource
    """Source of the focal length, such as EXIF."""
    digest: str
    """SHA-256 hash of the image file."""
    orientation: int = 1
    """EXIF orientation of the image file, 1 to 8."""
    gps: GpsPosition | None = None
    """GPS position in EXIF, None if EXIF has no position."""
    mask: MaskFile | None = None
    """Mask file of the original image, None if the image has no mask."""
    pixels: UInt8 | None = None
    """Pixels (H, W, 3) uint8 RGB of an image in memory, None for an image file."""
    thumbnail: UInt8 | None = None
    """Upright gray thumbnail, or None for formats that OpenCV does not decode."""
    predicted_log_std: float | None = None
    """Std of the log focal length that a camera provider predicted, None without prediction."""
    camera_model: CameraModel = CameraModel.SIMPLE_RADIAL
    """Camera model whose parameters the mapper estimates if the user gave no intrinsics."""

    def original_pixels(self, xy: Float64) -> Float64:
        """Map pixels (n, 2) of the undistorted view to pixels of the upright original image."""
        return distort_pixels(self.pinhole, self.camera, xy)

    def view_pixels(self, xy: Float64) -> Float64:
        """Map pixels (n, 2) of the upright original image to pixels of the undistorted view."""
        return undistort_pixels(self.pinhole, self.camera, xy)

    def refined_camera(self, pinhole: PinholeCamera) -> pycolmap.Camera:
        """Scale the original camera to the refined focal length of its undistorted view.

        The original focal length is multiplied by the ratio of the refined to the previous focal
        length of the view. The ratio is 1 if the view was already undistorted with the refined
        camera.
        """
        camera = pycolmap.Camera(self.camera.todict())
        params = np.array(camera.params)
        params[list(camera.focal_length_idxs())] *= pinhole.fx / self.pinhole.fx
        camera.params = params
        return camera

    @property
    def focal_known(self) -> bool:
        """True if the user gave the intrinsics, so that the focal length is not refined."""
        return self.focal_source == "intrinsics"

    @property
    def focal_log_std(self) -> float:
        """Prior standard deviation of the log focal length, predicted or given its source."""
        return self.predicted_log_std or FOCAL_LOG_STD[self.focal_source]

    @property
    def original_size(self) -> tuple[int, int]:
        """(width, height) of the upright original image in pixels."""
        return self.camera.width, self.camera.height


class ImageSet:
    """Images of a run in a fixed order, with undistorted views on demand.

    About 512 MB of undistorted images are cached. All methods of the class are thread-safe. The
    attribute ``left_out`` maps the name of each unusable image to the reason why the image cannot
    be used.
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
        self._views: LruCache[int, View] = LruCache(CACHED_BYTES, _count_bytes)
        self._undistortion_maps: LruCache[str, UndistortionMap] = LruCache(
            _CACHED_MAPS, lambda _: 1
        )

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.images, self._options)  # without the cache of images

    def __len__(self) -> int:
        return len(self.images)

    def __iter__(self) -> Iterator[SourceImage]:
        return iter(self.images)

    def __getitem__(self, index: int) -> SourceImage:
        return self.images[index]

    @property
    def folder(self) -> Path | None:
        """Folder of the image files, or None for images in memory."""
        if not self.images or self.images[0].pixels is not None:
            return None
        first = self.images[0]
        return first.path.parents[len(PurePosixPath(first.name).parts) - 1]

    @property
    def names(self) -> list[str]:
        """Names of the images in the order of the run."""
        return [image.name for image in self.images]

    def view(self, index: int) -> View:
        """Return the undistorted view of an image, cached or decoded from its file.

        Raises:
            InputError: the image or mask file is unreadable or has changed since the start of the
                run.
        """
        return self._views.get(index, lambda: self._load(self.images[index]))

    def view_of(self, name: str) -> View:
        """Return the undistorted view of an image by name, see :meth:`view`."""
        return self.view(self.row_of[name])

    @cached_property
    def row_of(self) -> Mapping[str, int]:
        """Index of each image by name."""
        return {image.name: row for row, image in enumerate(self.images)}

    def thumbnail(self, index: int) -> UInt8:
        """Return a gray thumbnail of the original image, or of the view for rare file formats."""
        stored = self.images[index].thumbnail
        if stored is not None:
            return stored
        return _make_thumbnail(cv2.cvtColor(self.view(index).image, cv2.COLOR_RGB2GRAY))

    def release_views(self) -> None:
        """Free the memory of the cached views, which are decoded again on demand."""
        self._views.clear()

    def with_focals(
        self, focals: Mapping[int, float], log_stds: Mapping[int, float] | None = None
    ) -> ImageSet:
        """Return a copy of the images with predicted instead of guessed focal lengths.

        Args:
            focals: Focal lengths by camera id, in pixels of the original image. Predicted focal
                lengths are still refined in bundle adjustment.
            log_stds: Standard deviations of the log focal lengths by camera id, by default that of
                :data:`FOCAL_LOG_STD`.
        """

        def changed(image: SourceImage) -> SourceImage:
            number = image.camera.camera_id
            if image.focal_known or number not in focals:
                return image
            model = image.camera_model
            camera = _simple_camera(image.original_size, focals[number], number, model)
            return replace(
                image,
                camera=camera,
                pinhole=_view_camera(camera, self._options),
                focal_source="provider",
                predicted_log_std=(log_stds or {}).get(number),
            )

        images = [changed(image) for image in self.images]
        return ImageSet(images, self._options, self.left_out)

    def written_to(self, folder: Path) -> ImageSet:
        """Write images in memory as PNG files, and return the images as files.

        Raises:
            OSError: the files cannot be written.
        """
        images = []
        for image in self.images:
            assert image.pixels is not None
            has_suffix = Path(image.name).suffix.lower() in EXTENSIONS
            path = folder / (image.name if has_suffix else f"{image.name}.png")
            data = cv2.imencode(".png", cv2.cvtColor(image.pixels, cv2.COLOR_RGB2BGR))[1].tobytes()
            path.parent.mkdir(parents=True, exist_ok=True)
            write_file(path, data)
            images.append(replace(image, path=path, pixels=None))
        return ImageSet(images, self._options, self.left_out)

    def with_cameras(self, cameras: Mapping[str, pycolmap.Camera]) -> ImageSet:
        """Return a copy of the images, in which cameras of original images are replaced by name."""

        def changed(image: SourceImage) -> SourceImage:
            camera = cameras.get(image.name)
            if camera is None:
                return image
            return replace(image, camera=camera, pinhole=_view_camera(camera, self._options))

        return ImageSet([changed(image) for image in self.images], self._options, self.left_out)

    def mask(self, index: int) -> Bool | None:
        """Return the mask of an undistorted view; images without a mask are not decoded."""
        image = self.images[index]
        if is_pinhole(image.camera) and image.mask is None:
            return None
        return self.view(index).mask

    def pixel_key(self, index: int) -> str:
        """Return a hash of an undistorted view; equal hashes mean equal pixels and masks.

        The hash covers the image file, mask, and all parameters of undistortion and downscaling.
        The hash excludes the intrinsics of an image without distortion.
        """
        image = self.images[index]
        parts = [image.digest, str(image.pinhole.size)]
        if not is_pinhole(image.camera):
            parts += [camera_key(image.camera), str(image.pinhole.params.tolist())]
        if image.mask is not None:
            parts.append(hashlib.sha256(read_bytes(image.mask.path)).hexdigest())
            if image.mask.orientation != 1:
                parts.append(f"mask orientation {image.mask.orientation}")
        return hashlib.sha256("\n".join(parts).encode()).hexdigest()

    def _load(self, image: SourceImage) -> View:
        pixels = image.pixels
        if pixels is None:
            data = read_bytes(image.path)
            pixels = decode_rgb(data, read_header(data), image.path)
        if (pixels.shape[1], pixels.shape[0]) != image.original_size:
            raise InputError(f"image {image.path} has changed its size during the run")
        mask = self._read_mask(image)
        if is_pinhole(image.camera):
            pixels = _resize(pixels, image.pinhole.size)
            mask = None if mask is None else resize_mask(mask, image.pinhole.size)
            return View(image.name, pixels, image.pinhole, mask, image.orientation)
        size = _reduced_size(image.original_size, self._options.max_image_size)
        camera = resize_camera(image.camera, size)
        undistortion = self._undistortion_maps.get(
            camera_key(camera), lambda: UndistortionMap(camera, image.pinhole)
        )
        pixels = undistortion.image(_resize(pixels, size))
        if mask is not None:
            mask = undistortion.mask(resize_mask(mask, size))
        elif not undistortion.valid.all():
            mask = undistortion.valid
        return View(image.name, pixels, image.pinhole, mask, image.orientation)

    def _read_mask(self, image: SourceImage) -> Bool | None:
        if image.mask is None:
            return None
        mask = image.mask.read(self._options.max_pixels)
        if (mask.shape[1], mask.shape[0]) != image.original_size:
            raise InputError(f"mask {image.mask.path} has changed its size during the run")
        return mask


def load_images(
    folder: Path,
    intrinsics: Path | Cameras | None = None,
    image_list: Path | None = None,
    options: InputOptions | None = None,
    *,
    model: Path | Cameras | None = None,
    without: Path | None = None,
    names: Sequence[str] | None = None,
) -> ImageSet:
    """Find the images of a folder and its subfolders, check them, and assign cameras.

    Args:
        folder: folder of images in the formats of
            :data:`mpsfm_core.inputs.image_decoding.EXTENSIONS`.
        intrinsics: path of ``intrinsics.yaml``, a COLMAP model (folder or ``cameras.txt``) or
            ``transforms.json``, or cameras of the caller, for upright images (after EXIF rotation).
            Without intrinsics, focal lengths come from EXIF, else from
            ``options.default_focal_ratio`` with a warning.
        image_list: text file with one image name per line (``#`` starts a comment), which also sets
            the order of the images.
        options: see :class:`InputOptions`.
        model: COLMAP model or ``transforms.json`` of some of the images. Without ``intrinsics`` the
            images use the cameras of ``model``. Images that the model does not list use the camera
            of the model with their image size, if exactly one camera has this size.
        without: subfolder to skip in the search, such as the output folder.
        names: names of the images to read, instead of ``image_list``; a single image is allowed.

    Raises:
        InputError: fewer than two images, unreadable files, missing or repeated names in the list,
            or intrinsics for other image sizes. The error message names the faulty file.
    """
    options = options or InputOptions()
    if names is None:
        names = find_images(folder, without)
        if options.masks is not None:
            names = _exclude_masks(names, folder, options.masks)
        if image_list is not None:
            names = select_listed_images(image_list, names, folder)
        require_two_images(folder, names, image_list or folder)
    masks = {} if options.masks is None else find_masks(options.masks, names, folder)
    given = _read_cameras(intrinsics, names, folder, "cameras")
    partial = _read_cameras(model, names, folder, "poses") if given is None else None
    with ThreadPoolExecutor(min(_READERS, thread_limit())) as pool:
        files = list(pool.map(lambda name: _probe(folder / name, options), names))
    left_out = {name: file.fault for name, file in zip(names, files, strict=True) if file.fault}
    probed = {name: file for name, file in zip(names, files, strict=True) if not file.fault}
    oriented_masks, mask_faults = orient_masks(
        {name: path for name, path in masks.items() if name in probed},
        {name: file.size for name, file in probed.items()},
        {name: file.header.orientation for name, file in probed.items()},
        options.mask_orientation,
        options.max_pixels,
    )
    left_out |= mask_faults
    _report_left_out(left_out, len(names), options)
    usable = {name: file for name, file in probed.items() if name not in left_out}
    known = _known_cameras(usable, given, partial)
    cameras = _add_guessed_cameras(known, usable, options, partial.max_id if partial else 0)
    images = []
    for name, file in usable.items():
        image = _source_image(name, folder / name, file, *cameras[name], options)
        alpha = MaskFile(image.path, image.orientation, True) if file.is_transparent else None
        images.append(replace(image, mask=oriented_masks.get(name, alpha)))
    _warn_of_default_focal_lengths(images, options)
    return ImageSet(images, options, left_out)


def find_known_cameras(
    folder: Path, names: Sequence[str], cameras: Path | Cameras, options: InputOptions
) -> dict[str, pycolmap.Camera]:
    """Return the known camera of each image that can be decoded, after EXIF rotation.

    Args:
        folder: Folder of the images.
        names: Names of the images below the folder.
        cameras: File or objects of the cameras, see :func:`load_images`.
        options: Options with the maximum number of pixels.

    Raises:
        InputError: A camera is missing, or is for another image size.
    """
    given = _read_cameras(cameras, names, folder, "cameras")
    files = {name: _probe(folder / name, options) for name in names}
    return _known_cameras({n: file for n, file in files.items() if not file.fault}, given, None)


def images_from_arrays(
    pixels: Mapping[str, NDArray[Any]],
    cameras: Cameras | None = None,
    options: InputOptions | None = None,
) -> ImageSet:
    """Make an image set of pixel arrays in memory.

    Args:
        pixels: (H, W, 3) uint8 RGB or (H, W) uint8 gray pixels by image name.
        cameras: Camera of all images, camera of each image by name, or COLMAP model. Without
            cameras, the focal length starts at ``options.default_focal_ratio`` times the longer
            image side and is refined.
        options: see :class:`InputOptions`.

    Raises:
        InputError: there are fewer than two images, pixels are not uint8, or a camera is missing or
            has another size than its image.
    """
    options = options or InputOptions()
    if len(pixels) < 2:
        raise InputError(f"images: at least two images are needed, got {len(pixels)}")
    given = _read_cameras(cameras, pixels, None, "cameras")
    probed, arrays = {}, {}
    for name, array in pixels.items():
        rgb = np.asarray(array)
        rgb = np.repeat(rgb[..., None], 3, axis=2) if rgb.ndim == 2 else rgb
        if rgb.dtype != np.uint8 or rgb.ndim != 3 or rgb.shape[2] != 3:
            raise InputError(
                f"image {name!r}: pixels must be uint8 (H, W, 3) or (H, W), "
                f"got {rgb.dtype} {rgb.shape}"
            )
        size = rgb.shape[1], rgb.shape[0]
        digest = hashlib.sha256(f"{size}".encode() + np.ascontiguousarray(rgb).tobytes())
        probed[name] = _ProbedImage(size, ImageHeader(None, 1, {}), digest.hexdigest())
        arrays[name] = rgb
    known = _known_cameras(probed, given, None)
    images = []
    for name, (camera, focal) in _add_guessed_cameras(known, probed, options).items():
        image = _source_image(name, Path(name), probed[name], camera, focal, options)
        images.append(replace(image, pixels=arrays[name]))
    _warn_of_default_focal_lengths(images, options)
    return ImageSet(images, options)


def _exclude_masks(names: Sequence[str], folder: Path, masks: Path) -> list[str]:
    """Return the image names without those in a masks folder inside the images folder."""
    inner, outer = masks.resolve(), folder.resolve()
    if inner == outer or not inner.is_relative_to(outer):
        return list(names)
    prefix = f"{inner.relative_to(outer).as_posix()}/"
    return [name for name in names if not name.startswith(prefix)]


def _read_cameras(
    given: Path | Cameras | None, names: Iterable[str], folder: Path | None, argument: str
) -> Intrinsics | None:
    """Return the cameras of a file or of an argument of the caller, with the names of the run."""
    if given is None:
        return None
    if isinstance(given, Path):
        return read_intrinsics(given, folder).for_images(names)
    return intrinsics_from_cameras(given, folder, argument).for_images(names)


@dataclass(frozen=True)
class _ProbedImage:
    """Upright size, header and hash of an image file, or the reason why the file is unreadable."""

    size: tuple[int, int]
    header: ImageHeader
    digest: str
    fault: str = ""
    gps: GpsPosition | None = None
    is_transparent: bool = False
    thumbnail: UInt8 | None = None

    @property
    def oriented_size(self) -> tuple[tuple[int, int], int]:
        """Upright size and EXIF orientation of an image."""
        return self.size, self.header.orientation


def _known_cameras(
    files: Mapping[str, _ProbedImage], given: Intrinsics | None, partial: Intrinsics | None
) -> dict[str, pycolmap.Camera]:
    """Return known cameras by image name: all cameras from ``given``, or some from ``partial``."""
    known: dict[str, pycolmap.Camera] = {}
    for name, file in files.items():
        if given is not None:
            known[name] = given.camera(name, file.size, file.header.orientation)
        elif (shared := partial and partial.usual_camera(name, *file.oriented_size)) is not None:
            known[name] = shared
    return known


def _add_guessed_cameras(
    known: Mapping[str, pycolmap.Camera],
    files: Mapping[str, _ProbedImage],
    options: InputOptions,
    max_id: int = 0,
) -> dict[str, tuple[pycolmap.Camera, FocalSource]]:
    """Return camera and source of the focal length of each image, and guess unknown cameras.

    Args:
        known: Known cameras by image name.
        files: Image headers and sizes by image name.
        options: Options of camera sharing.
        max_id: Largest id of the known cameras.
    """
    guesses = guess_cameras(
        {name: file.header for name, file in files.items() if name not in known},
        {name: file.size for name, file in files.items()},
        options,
    )
    cameras: dict[str, tuple[pycolmap.Camera, FocalSource]] = {
        name: (camera, FOCAL_FROM_USER) for name, camera in known.items()
    }
    for name, guess in guesses.items():
        number = max_id + guess.number
        camera = _simple_camera(files[name].size, guess.focal_px, number, options.camera_model)
        cameras[name] = camera, guess.source
    return cameras


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
    is_known = focal == FOCAL_FROM_USER
    return SourceImage(
        name,
        path,
        camera,
        pinhole,
        focal,
        file.digest,
        orientation,
        file.gps,
        thumbnail=file.thumbnail,
        camera_model=CameraModel.SIMPLE_RADIAL if is_known else options.camera_model,
    )


def _simple_camera(
    size: tuple[int, int], focal_px: float, number: int, model: CameraModel
) -> pycolmap.Camera:
    """Return a camera without distortion coefficients and with a central principal point.

    The camera has the model SIMPLE_PINHOLE, or OPENCV_FISHEYE if ``model`` is a fisheye model.
    """
    params = np.array([focal_px, focal_px, size[0] / 2, size[1] / 2])
    guessed = model if model.is_fisheye else CameraModel.SIMPLE_PINHOLE
    return pycolmap.Camera(
        model=guessed.value,
        width=size[0],
        height=size[1],
        params=guessed.to_params(params, np.zeros(NUM_DISTORTION)),
        camera_id=number,
    )


def _view_camera(camera: pycolmap.Camera, options: InputOptions) -> PinholeCamera:
    """Return the pinhole camera of the undistorted and possibly downscaled image."""
    original = camera.width, camera.height
    size = _reduced_size(original, options.max_image_size)
    reduced = camera if size == original else resize_camera(camera, size)
    return undistort_camera(reduced)


def _probe(path: Path, options: InputOptions) -> _ProbedImage:
    try:
        data = read_bytes(path)
    except InputError as error:
        return _ProbedImage((0, 0), ImageHeader(None, 1, {}), "", str(error))
    check_size(data, path, options.max_pixels)
    try:
        reduced = check_decodable(data, path)
        header = read_header(data)
        projection = find_projection(header, reduced) if options.projection == "auto" else None
        if projection is not None:
            raise InputError(
                f"image {path} is a panorama ({projection}); if all images are panoramas of 360 x "
                f"180 degrees, set --projection equirectangular, and --projection perspective if "
                f"the image is none"
            )
        size = upright_size(data, header, path)
        is_transparent = decode_opacity(data, path) is not None
    except InputError as error:
        return _ProbedImage((0, 0), ImageHeader(None, 1, {}), "", str(error))
    digest = hashlib.sha256(data).hexdigest()
    thumbnail = None if reduced is None else _make_thumbnail(orient(reduced, header.orientation))
    return _ProbedImage(size, header, digest, "", read_gps(data), is_transparent, thumbnail)


def _report_left_out(left_out: Mapping[str, str], total: int, options: InputOptions) -> None:
    """Warn of unusable images; raise :class:`InputError` if ``strict`` or if most are unusable."""
    if not left_out:
        return
    faults = list(left_out.values())
    rest = len(faults) - MAX_LISTED
    text = "; ".join(faults[:MAX_LISTED]) + (f"; and {rest} more" if rest > 0 else "")
    if options.strict:
        raise InputError(f"{text} (set inputs.strict=false to leave out unusable photos)")
    if len(faults) > total / 2 or total - len(faults) < 2:
        raise InputError(f"{len(faults)} of {total} photos cannot be used: {text}")
    _log.warning("%d of %d photos cannot be used and are left out: %s", len(faults), total, text)


def _warn_of_default_focal_lengths(images: Sequence[SourceImage], options: InputOptions) -> None:
    guessed = [image.name for image in images if image.focal_source == "default"]
    if guessed:
        _log.warning(
            "%d of %d images (%s%s) have no known focal length. The assumed focal length is %g "
            "times the longer image side; give --intrinsics for a better result",
            len(guessed),
            len(images),
            ", ".join(guessed[:MAX_LISTED]),
            ", ..." if len(guessed) > MAX_LISTED else "",
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


def _make_thumbnail(gray: UInt8) -> UInt8:
    thumbnail: UInt8 = cv2.resize(gray, _THUMBNAIL, interpolation=cv2.INTER_AREA)
    return thumbnail


def _count_bytes(view: View) -> int:
    return view.image.nbytes + (0 if view.mask is None else view.mask.nbytes)
