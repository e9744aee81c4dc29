"""Find, decode and orient the masks of the original images."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import cv2
import numpy as np

from mpsfm_core.data import Bool
from mpsfm_core.data.cameras import MapOrientation
from mpsfm_core.data.errors import InputError
from mpsfm_core.inputs.codecs import find_decoder
from mpsfm_core.inputs.image_decoding import (
    EXTENSIONS,
    check_size,
    decode_stored,
    orient,
    read_bytes,
)
from mpsfm_core.inputs.image_header import has_alpha, read_header
from mpsfm_core.inputs.image_search import list_names, walk_files
from mpsfm_core.support.threads import parallel_map

_log = logging.getLogger(__name__)

_PREFERRED = (".png", ".tif", ".tiff", ".bmp", ".pgm", ".ppm")
"""Lossless mask formats, preferred if an image has several mask files."""
_PATTERNS = ("{}", "{}_mask", "{}-mask", "{}.mask", "{}_masks", "mask_{}", "dynamic_mask_{}")
"""File stems of masks, where ``{}`` is the image name with or without extension [COLMAP,
OpenDroneMap, Metashape, instant-ngp]."""
_LOSSY_THRESHOLD = 127
"""Maximum gray value that counts as black in lossy mask formats, whose black areas have noise."""


@dataclass(frozen=True)
class MaskFile:
    """Mask file of an image and its orientation."""

    path: Path
    """Path of the mask file."""
    orientation: int = 1
    """EXIF orientation that rotates the mask upright, 1 for an upright mask."""
    is_alpha: bool = False
    """True if the mask is the alpha channel of the image file."""

    def read(self, max_pixels: int) -> Bool:
        """Decode the upright mask, (H, W) bool, False at black or transparent pixels."""
        if self.is_alpha:
            opaque = decode_opacity(read_bytes(self.path), self.path)
            if opaque is None:
                raise InputError(f"image {self.path} has changed during the run")
            return _turn(opaque, self.orientation)
        return _turn(decode_mask(self.path, max_pixels), self.orientation)


def find_masks(folder: Path, names: Sequence[str], images_folder: Path) -> dict[str, Path]:
    """Find the mask file of each image by name.

    The mask of image ``X.jpg`` is ``X.png``, ``X.jpg.png``, ``X.jpg`` or ``X_mask.png`` (or
    similar) in any image format. Case is ignored. The masks folder has the subfolders of the images
    folder or no subfolders, and may be the images folder itself. If ``folder`` is a file, the file
    is the mask of all images.

    Returns:
        Paths of mask files by image name; images without a mask cause a warning.

    Raises:
        InputError: the masks folder does not exist, or contains no mask of an image.
    """
    if folder.is_file():
        return dict.fromkeys(names, folder)
    if not folder.is_dir():
        raise InputError(f"masks folder {folder} does not exist")
    files = [n for n in walk_files(folder) if PurePosixPath(n).suffix.lower() in EXTENSIONS]
    if folder.resolve() == images_folder.resolve():
        images = set(names)
        files = [name for name in files if name not in images]
    by_stem: dict[str, str] = {}
    for name in sorted(files, key=_preference):
        by_stem.setdefault(_strip(name).casefold(), name)
    masks = {}
    for name in names:
        mask = _find_mask(name, by_stem)
        if mask is None and _is_unique(name, names):
            mask = _find_mask(PurePosixPath(name).name, by_stem)
        if mask is not None:
            masks[name] = folder / mask
    if not masks:
        content = f"has {list_names(sorted(files))}" if files else "has no image files"
        expected = f"{names[0]}.png" if names else "NAME.png"
        raise InputError(
            f"masks folder {folder}: no file is the mask of an image. The masks folder "
            f"{content}; the mask of {names[0]!r} is called {expected!r} or "
            f"{_strip(expected[:-4]) + '_mask.png'!r}"
        )
    missing = [name for name in names if name not in masks]
    if missing:
        _log.warning(
            "masks folder %s: %d of %d images have no mask and are used in full: %s",
            folder,
            len(missing),
            len(names),
            list_names(missing),
        )
    return masks


@dataclass(frozen=True)
class _ProbedMask:
    """Size of a mask, whether any pixel is not black, and whether EXIF has an orientation."""

    size: tuple[int, int]
    allows_pixels: bool
    has_orientation: bool


def orient_masks(
    masks: Mapping[str, Path],
    sizes: Mapping[str, tuple[int, int]],
    orientations: Mapping[str, int],
    convention: MapOrientation,
    max_pixels: int,
) -> tuple[dict[str, MaskFile], dict[str, str]]:
    """Determine the orientation of masks, and find entirely black masks.

    A mask fits its image before or after EXIF rotation. If the size of a mask fits only one of the
    two orientations, the mask has this orientation. Masks that fit both orientations follow the
    majority of the masks that fit only one orientation, or count as not rotated without a majority
    [COLMAP mask_path]. An EXIF orientation in the mask file has precedence over the mask size and
    the majority.

    Args:
        masks: paths of mask files by image name.
        sizes: (width, height) of the image after EXIF rotation, by image name.
        orientations: EXIF orientation of the image, by image name.
        convention: orientation of the masks that fit before and after EXIF rotation (``stored``,
            ``upright``), or ``auto`` for the majority.
        max_pixels: maximum number of pixels of a mask.

    Returns:
        Mask files by image name, and error texts by image name for entirely black masks.

    Raises:
        InputError: a mask cannot be decoded, is too large, or has another size than its image.
    """
    probed = parallel_map(lambda path: _probe(path, max_pixels), masks.values())
    turned: dict[str, MaskFile] = {}
    faults: dict[str, str] = {}
    ambiguous, num_stored, num_upright = [], 0, 0
    for (name, path), mask in zip(masks.items(), probed, strict=True):
        orientation, upright = orientations[name], sizes[name]
        stored = upright[::-1] if orientation >= 5 else upright
        if mask.size not in (upright, stored):
            raise InputError(
                f"mask {path} has {mask.size[0]}x{mask.size[1]} pixels, but its image {name!r} has "
                f"{upright[0]}x{upright[1]}; give the mask of the original image"
            )
        if not mask.allows_pixels:
            faults[name] = f"mask {path} is all black: it excludes every pixel of image {name!r}"
        elif orientation == 1 or mask.has_orientation:
            turned[name] = MaskFile(path)
        elif upright == stored:
            ambiguous.append(name)
        elif mask.size == stored:
            turned[name], num_stored = MaskFile(path, orientation), num_stored + 1
        else:
            turned[name], num_upright = MaskFile(path), num_upright + 1
    is_stored = convention == "stored" or (convention == "auto" and num_stored >= num_upright)
    for name in ambiguous:
        turned[name] = MaskFile(masks[name], orientations[name] if is_stored else 1)
    if ambiguous and convention == "auto" and num_stored == num_upright:
        _log.warning(
            "masks of %d rotated photos are rotated like the photos, as in COLMAP: %s; if the "
            "masks are upright: --set inputs.mask_orientation=upright",
            len(ambiguous),
            list_names(ambiguous),
        )
    return turned, faults


def decode_mask(path: Path, max_pixels: int) -> Bool:
    """Decode a mask and apply the EXIF orientation of the mask file.

    Black pixels of a mask become False. If only the alpha channel varies, the alpha channel is the
    mask.

    Returns:
        (H, W) bool.

    Raises:
        InputError: the mask cannot be decoded or has more than ``max_pixels`` pixels.
    """
    data = read_bytes(path)
    check_size(data, path, max_pixels)
    decoder = find_decoder(data, path)
    if decoder is not None:
        return np.asarray(decoder(data, path).max(axis=2) > _LOSSY_THRESHOLD)
    values = decode_stored(data, path)
    if values.ndim == 3 and values.shape[2] in (2, 4):
        color, alpha = values[..., :-1], values[..., -1]
        is_constant = (color == color[:1, :1]).all()
        values = alpha if is_constant and alpha.min() != alpha.max() else color
    if values.ndim == 3:
        values = values.max(axis=2)
    is_lossy = data[:3] == b"\xff\xd8\xff" or (data[8:12] == b"WEBP" and data[12:16] == b"VP8 ")
    allowed = values > (_LOSSY_THRESHOLD if is_lossy else 0)
    return _turn(np.asarray(allowed), read_header(data).orientation)


def decode_opacity(data: bytes, path: Path) -> Bool | None:
    """Decode the alpha channel of a PNG or WebP image, before EXIF rotation.

    Returns:
        Mask (H, W) bool, False at transparent pixels, or None if all or no pixels are transparent.
    """
    if not has_alpha(data):
        return None
    values = decode_stored(data, path)
    if values.ndim != 3 or values.shape[2] not in (2, 4):
        return None
    opaque: Bool = values[..., -1] > np.iinfo(values.dtype).max // 2
    return opaque if opaque.any() and not opaque.all() else None


def resize_mask(mask: Bool, size: tuple[int, int]) -> Bool:
    """Resize a mask to (width, height) with nearest-neighbor sampling."""
    if (mask.shape[1], mask.shape[0]) == size:
        return mask
    resized = cv2.resize(mask.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST_EXACT)
    return np.asarray(resized > 0)


def _probe(path: Path, max_pixels: int) -> _ProbedMask:
    mask = decode_mask(path, max_pixels)
    has_orientation = read_header(read_bytes(path)).orientation != 1
    return _ProbedMask((mask.shape[1], mask.shape[0]), bool(mask.any()), has_orientation)


def _turn(mask: Bool, orientation: int) -> Bool:
    return np.asarray(orient(mask.astype(np.uint8), orientation) > 0)


def _find_mask(name: str, by_stem: Mapping[str, str]) -> str | None:
    """Find the mask file of an image, by its name with extension, then without extension."""
    for base in (name, _strip(name)):
        parent, _, last = base.rpartition("/")
        prefix = f"{parent}/" if parent else ""
        for pattern in _PATTERNS:
            key = (prefix + pattern.format(last)).casefold()
            if key in by_stem:
                return by_stem[key]
    return None


def _is_unique(name: str, names: Sequence[str]) -> bool:
    """Return whether an image name is unique without its folder and extension."""
    stem = PurePosixPath(name).stem.casefold()
    return sum(PurePosixPath(other).stem.casefold() == stem for other in names) == 1


def _strip(name: str) -> str:
    return str(PurePosixPath(name).with_suffix(""))


def _preference(name: str) -> tuple[int, str]:
    suffix = PurePosixPath(name).suffix.lower()
    return (_PREFERRED.index(suffix) if suffix in _PREFERRED else len(_PREFERRED)), name
