"""Keypoints and matches that another program made, for the images of a run."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mpsfm_core.data import Float32, Float64, Int64, SparseMatches
from mpsfm_core.data.errors import InputError
from mpsfm_core.geometry import inside
from mpsfm_core.inputs.colmap_database import read_database
from mpsfm_core.inputs.hloc import HlocFiles
from mpsfm_core.inputs.image_decoding import apply_orientation_to_pixels
from mpsfm_core.inputs.images import ImageSet, SourceImage
from mpsfm_core.inputs.models import match_names

Pair = tuple[int, int]


@dataclass(frozen=True, eq=False)
class ImportedMatches:
    """``keypoints``: of each image (n, 2) float64, pixels of its view. ``std_px``: their noise, of
    each image. ``matches``: (smaller, larger position of the images) -> rows of keypoints.
    ``source``: for people.
    """

    source: str
    keypoints: tuple[Float64, ...]
    std_px: tuple[float, ...]
    matches: Mapping[Pair, SparseMatches]


def matches_from_database(path: Path, images: ImageSet) -> ImportedMatches:
    """Keypoints and matches of a COLMAP database.

    Raises :class:`InputError` when it is damaged, has none of the images or no matches of them, or
    is of photos of another size.
    """
    database = read_database(path)
    found = match_names(images.names, database.images)
    builder = _Builder(str(path), images)
    for index, image in enumerate(images):
        number = database.images.get(found.get(image.name, ""), -1)
        if number in database.keypoints:
            camera = database.cameras[database.camera_of[number]]
            builder.add(index, database.keypoints[number], (camera.width, camera.height), 1.0)
    position = {database.images[name]: images.names.index(own) for own, name in found.items()}
    for (first, second), indices in sorted(database.matches.items()):
        if first in position and second in position:
            scores = np.ones(len(indices), np.float32)
            builder.match(position[first], position[second], indices, scores)
    return builder.finish()


def matches_from_hloc(features: Path, matches: Path, images: ImageSet) -> ImportedMatches:
    """Keypoints and matches of hloc's files. Raises as :func:`matches_from_database`."""
    files = HlocFiles(features, matches)
    found = match_names(images.names, files.names())
    builder = _Builder(f"{features} and {matches}", images)
    for index, image in enumerate(images):
        if image.name in found:
            keypoints, std_px = files.keypoints(found[image.name])
            builder.add(index, keypoints, files.size(found[image.name]), std_px)
    position = {name: images.names.index(own) for own, name in found.items()}
    for first, second, indices, scores in files.pairs(list(position)):
        builder.match(position[first], position[second], indices, scores)
    return builder.finish()


class _Builder:
    """From rows and pixels of the files to rows and pixels of the views."""

    def __init__(self, source: str, images: ImageSet) -> None:
        self._source = source
        self._images = images
        self._keypoints: list[Float64] = [np.empty((0, 2))] * len(images)
        self._rows: dict[int, Int64] = {}
        self._std_px = [1.0] * len(images)
        self._matches: dict[Pair, SparseMatches] = {}

    def add(
        self, index: int, keypoints: Float64, size: tuple[int, int] | None, std_px: float
    ) -> None:
        """Keypoints of an image; those that its undistorted view does not show fall away."""
        image = self._images[index]
        xy = image.view_pixels(_upright(self._source, image, keypoints, size))
        kept = np.isfinite(xy).all(axis=1) & inside(xy, image.pinhole.size)
        self._keypoints[index] = np.ascontiguousarray(xy[kept])
        self._rows[index] = np.where(kept, np.cumsum(kept) - 1, -1)
        self._std_px[index] = std_px * image.pinhole.width / image.original_size[0]

    def match(self, first: int, second: int, indices: Int64, scores: Float32) -> None:
        """Matches of two images, as rows of what was added."""
        if first == second or not len(indices):
            return
        if first > second:
            first, second, indices = second, first, indices[:, ::-1]
        columns = []
        for index, rows in zip((first, second), indices.T, strict=True):
            known = self._rows.get(index, np.zeros(0, np.int64))
            if rows.min() < 0 or rows.max() >= len(known):
                name = self._images[index].name
                raise InputError(
                    f"{self._source}: a match refers to keypoint {rows.max()} of {name!r}, which "
                    f"has {len(known)}"
                )
            columns.append(known[rows])
        moved = np.stack(columns, axis=1)
        kept = (moved >= 0).all(axis=1)
        self._matches[first, second] = SparseMatches.best_first(moved[kept], scores[kept])

    def finish(self) -> ImportedMatches:
        """The result; raises :class:`InputError` if it is empty."""
        if not self._rows:
            raise InputError(f"{self._source}: has keypoints of none of the images, names differ")
        if not self._matches:
            raise InputError(f"{self._source}: has no matches of these images")
        return ImportedMatches(
            self._source, tuple(self._keypoints), tuple(self._std_px), self._matches
        )


def _upright(
    source: str, image: SourceImage, keypoints: Float64, size: tuple[int, int] | None
) -> Float64:
    """Keypoints of a stored photo as pixels of the upright one."""
    width, height = image.original_size
    stored = (height, width) if image.orientation >= 5 else (width, height)
    if size is None or size == stored:
        return apply_orientation_to_pixels(keypoints, stored, image.orientation)
    if size == (width, height):
        return keypoints
    raise InputError(
        f"{source}: its {image.name!r} has {size[0]}x{size[1]} pixels, the photo {width}x{height}"
    )
