"""Map registered images to their original files, and export undistorted images."""

from __future__ import annotations

import struct
from pathlib import Path, PurePosixPath
from typing import Any

import cv2
import pycolmap
from PIL import Image
from PIL.TiffImagePlugin import IFDRational

from mpsfm_core.data import Float64, MappingProblem, View
from mpsfm_core.inputs.image_decoding import read_bytes
from mpsfm_core.inputs.image_header import is_plain_rgb, read_header
from mpsfm_core.inputs.images import ImageSet, SourceImage
from mpsfm_core.inputs.undistortion import is_pinhole
from mpsfm_core.mapping.scene.reconstruction import Reconstruction, RegisteredImage

_PORTABLE = frozenset((".jpg", ".jpeg", ".png"))
"""Extensions of image formats that all programs read."""
_SIGNATURES = {
    ".jpg": b"\xff\xd8\xff",
    ".jpeg": b"\xff\xd8\xff",
    ".png": b"\x89PNG\r\n\x1a\n",
}
"""First bytes of JPEG and PNG files, because file extensions can be wrong."""
_JPEG_START = b"\xff\xd8"
_EXIF_IFD = 0x8769
_EXPOSURE_TIME, _F_NUMBER, _ISO_SPEED = 0x829A, 0x829D, 0x8827


class OriginalImages:
    """Access to the original image files and cameras of the images in a mapping problem."""

    def __init__(self, images: ImageSet, problem: MappingProblem) -> None:
        self.problem = problem
        self.images = images

    def source(self, image: RegisteredImage) -> SourceImage:
        """Return the path of the original file of a registered image."""
        return self.images[self.images.row_of[image.name]]

    def key(self, image: RegisteredImage) -> str:
        """Return the hash of the undistorted view of a registered image."""
        return self.images.pixel_key(self.images.row_of[image.name])

    def view(self, name: str) -> View:
        """Return the undistorted view of an image by name."""
        return self.images.view_of(name)

    def release_views(self) -> None:
        """Free the memory of the cached views, which are decoded again on demand."""
        self.images.release_views()

    def keypoints(self, reconstruction: Reconstruction) -> list[Float64]:
        """Return keypoints (n, 2) of each registered image in pixels of the undistorted image."""
        return [self.problem.images[image.index].keypoints for image in reconstruction.images]

    def original_keypoints(self, reconstruction: Reconstruction) -> list[Float64]:
        """Return the keypoints (n, 2) of each registered image in pixels of the original image."""
        return [
            self.source(image).original_pixels(xy)
            for image, xy in zip(reconstruction.images, self.keypoints(reconstruction), strict=True)
        ]

    def original_camera(self, image: RegisteredImage) -> pycolmap.Camera:
        """Return the camera of the upright original image with the refined focal length."""
        return self.source(image).refined_camera(image.camera)

    def any_distorted(self, reconstruction: Reconstruction) -> bool:
        """Return whether any registered image has lens distortion."""
        return any(not is_pinhole(self.source(image).camera) for image in reconstruction.images)

    def any_rotated(self, reconstruction: Reconstruction) -> bool:
        """Return whether any registered image has an EXIF rotation.

        The COLMAP model belongs to upright images, and other programs often ignore EXIF
        orientation.
        """
        return any(self.source(image).orientation != 1 for image in reconstruction.images)

    def write_view(self, image: RegisteredImage, path: Path) -> None:
        """Write the undistorted view with :func:`export_view`."""
        export_view(self.images, self.images.row_of[image.name], path)


def exported_image_name(name: str) -> str:
    """Return the file name of an undistorted image, with ``.jpg`` appended to uncommon formats."""
    return name if PurePosixPath(name).suffix.lower() in _PORTABLE else f"{name}.jpg"


def export_view(images: ImageSet, index: int, path: Path) -> None:
    """Write the upright, undistorted image in the format of the file extension.

    An upright, undistorted 8-bit RGB file is copied without decoding if its format is the same.
    Other JPEG files get the exposure of the original file, which Gaussian splatting programs
    compensate.
    """
    image = images[index]
    path.parent.mkdir(parents=True, exist_ok=True)
    is_unchanged = is_pinhole(image.camera) and image.pinhole.size == image.original_size
    original = read_bytes(image.path) if image.pixels is None else b""
    if is_unchanged and original:
        signature = _SIGNATURES.get(path.suffix.lower(), b"")
        is_upright = read_header(original).orientation == 1
        if is_upright and signature and original.startswith(signature) and is_plain_rgb(original):
            path.write_bytes(original)
            return
    bgr = cv2.cvtColor(images.view(index).image, cv2.COLOR_RGB2BGR)
    encoded = cv2.imencode(path.suffix, bgr)[1].tobytes()
    if encoded.startswith(_JPEG_START):
        encoded = _JPEG_START + _exposure_segment(original) + encoded[len(_JPEG_START) :]
    path.write_bytes(encoded)


def _exposure_segment(data: bytes) -> bytes:
    """Return a JPEG segment with exposure time, f-number and ISO speed of an image file.

    Args:
        data: The encoded image file.

    Returns:
        An APP1 segment with EXIF, no bytes if the file has no exposure.
    """
    tags = read_header(data).tags
    rationals = (tag for tag in (_EXPOSURE_TIME, _F_NUMBER) if tag in tags)
    exposure: dict[int, Any] = {tag: IFDRational(tags[tag]) for tag in rationals}
    if _ISO_SPEED in tags:
        exposure[_ISO_SPEED] = int(tags[_ISO_SPEED])
    if not exposure:
        return b""
    exif = Image.Exif()
    exif.get_ifd(_EXIF_IFD).update(exposure)
    payload = exif.tobytes()
    return struct.pack(">2sH", b"\xff\xe1", 2 + len(payload)) + payload
