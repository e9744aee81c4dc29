"""From the mapper's undistorted views back to the photos of the user."""

from __future__ import annotations

from pathlib import Path, PurePosixPath

import cv2
import pycolmap

from mpsfm_core.data import Float64, MappingProblem, View
from mpsfm_core.inputs.image_decoding import read_bytes
from mpsfm_core.inputs.image_header import read_header
from mpsfm_core.inputs.images import ImageSet, SourceImage
from mpsfm_core.inputs.undistortion import is_pinhole
from mpsfm_core.mapping.scene.reconstruction import Reconstruction, RegisteredImage

_PORTABLE = frozenset((".jpg", ".jpeg", ".png"))


class OriginalImages:
    """The photos of the images of a problem, found by name."""

    def __init__(self, images: ImageSet, problem: MappingProblem) -> None:
        self.problem = problem
        self._images = images
        self._rows = {name: row for row, name in enumerate(images.names)}

    def source(self, image: RegisteredImage) -> SourceImage:
        """The photo of a registered image."""
        return self._images[self._rows[image.name]]

    def key(self, image: RegisteredImage) -> str:
        """Names the content of its view."""
        return self._images.pixel_key(self._rows[image.name])

    def view(self, name: str) -> View:
        """The undistorted view."""
        return self._images.view(self._rows[name])

    def keypoints(self, reconstruction: Reconstruction) -> list[Float64]:
        """For each registered image its keypoints (n, 2), pixels of the view."""
        return [self.problem.images[image.index].keypoints for image in reconstruction.images]

    def original_keypoints(self, reconstruction: Reconstruction) -> list[Float64]:
        """For each registered image its keypoints (n, 2), pixels of the upright photo."""
        return [
            self.source(image).original_pixels(xy)
            for image, xy in zip(reconstruction.images, self.keypoints(reconstruction), strict=True)
        ]

    def original_camera(self, image: RegisteredImage) -> pycolmap.Camera:
        """The camera of the upright photo, with the focal length that the mapper refined."""
        return self.source(image).refined_camera(image.camera)

    def any_distorted(self, reconstruction: Reconstruction) -> bool:
        """Whether a photo of the reconstruction is not a pinhole image."""
        return any(not is_pinhole(self.source(image).camera) for image in reconstruction.images)

    def write_view(self, image: RegisteredImage, path: Path) -> None:
        """Write the undistorted view as :func:`export_view` does."""
        export_view(self._images, self._rows[image.name], path)


def exported_image_name(name: str) -> str:
    """What an undistorted view is called: as its photo, with ``.jpg`` behind what not every
    program reads."""
    return name if PurePosixPath(name).suffix.lower() in _PORTABLE else f"{name}.jpg"


def export_view(images: ImageSet, index: int, path: Path) -> None:
    """Write the undistorted view of a photo, upright, in the format that ``path`` ends in.

    A photo that is already so is copied as it is.
    """
    image = images[index]
    path.parent.mkdir(parents=True, exist_ok=True)
    unchanged = is_pinhole(image.camera) and image.pinhole.size == image.original_size
    if unchanged and path.suffix == image.path.suffix:
        data = read_bytes(image.path)
        if read_header(data).orientation == 1:
            path.write_bytes(data)
            return
    bgr = cv2.cvtColor(images.view(index).image, cv2.COLOR_RGB2BGR)
    path.write_bytes(cv2.imencode(path.suffix, bgr)[1].tobytes())
