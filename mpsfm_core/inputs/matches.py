"""Import keypoints and matches from a COLMAP database or from hloc's HDF5 files."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mpsfm_core.data import Features, Float32, Float64, Int64, SparseMatches
from mpsfm_core.data.errors import InputError
from mpsfm_core.geometry import inside
from mpsfm_core.inputs.colmap_database import read_database
from mpsfm_core.inputs.hloc import HlocFiles
from mpsfm_core.inputs.image_decoding import apply_orientation_to_pixels
from mpsfm_core.inputs.images import ImageSet, SourceImage
from mpsfm_core.inputs.models import describe_name_difference, match_names

Pair = tuple[int, int]


@dataclass(frozen=True, eq=False)
class ImportedMatches:
    """Imported keypoints and matches of the images of a run."""

    source: str
    """Paths of the imported files, for error messages."""
    keypoints: tuple[Float64, ...]
    """Keypoints of each image, (n, 2) float64 in pixels of the undistorted view."""
    std_px: tuple[float, ...]
    """Keypoint standard deviation of each image in pixels of the undistorted view."""
    matches: Mapping[Pair, SparseMatches]
    """Matches by pair (smaller, larger image index), as keypoint indices."""


def matches_from_database(path: Path, images: ImageSet) -> ImportedMatches:
    """Import keypoints and matches of a COLMAP database.

    Raises:
        InputError: the database is damaged, has no keypoints or no matches of the images, or has
            other image sizes.
    """
    database = read_database(path)
    matched = match_names(images.names, database.images)
    builder = _Builder(str(path), database.images, images)
    for index, image in enumerate(images):
        number = database.images.get(matched.get(image.name, ""), -1)
        if number in database.keypoints:
            camera = database.cameras[database.camera_of[number]]
            builder.add(index, database.keypoints[number], (camera.width, camera.height), 1.0)
    index_of = {
        database.images[theirs]: images.names.index(ours) for ours, theirs in matched.items()
    }
    for (first, second), indices in sorted(database.matches.items()):
        if first in index_of and second in index_of:
            scores = np.ones(len(indices), np.float32)
            builder.match(index_of[first], index_of[second], indices, scores)
    return builder.finish()


def matches_from_hloc(features: Path, matches: Path, images: ImageSet) -> ImportedMatches:
    """Import hloc's keypoints and matches; raise the errors of :func:`matches_from_database`."""
    files = HlocFiles(features, matches)
    names = files.names()
    matched = match_names(images.names, names)
    builder = _Builder(f"{features} and {matches}", names, images)
    for index, image in enumerate(images):
        if image.name in matched:
            keypoints, std_px = files.keypoints(matched[image.name])
            builder.add(index, keypoints, files.size(matched[image.name]), std_px)
    index_of = {theirs: images.names.index(ours) for ours, theirs in matched.items()}
    for first, second, indices, scores in files.pairs(list(index_of)):
        builder.match(index_of[first], index_of[second], indices, scores)
    return builder.finish()


def features_from_hloc(
    path: Path, images: ImageSet
) -> tuple[dict[str, Features], dict[str, Int64]]:
    """Import features with descriptors from a features file of hloc.

    Returns:
        Features in pixels of the undistorted views by image name, and (n,) row numbers of these
        features in the file by image name. Keypoints outside of the undistorted view are left out.

    Raises:
        InputError: the features file is damaged, or has keypoints of none of the images.
    """
    files = HlocFiles(path)
    matched = match_names(images.names, files.names())
    features: dict[str, Features] = {}
    rows: dict[str, Int64] = {}
    for image in images:
        if image.name not in matched:
            continue
        stored = matched[image.name]
        keypoints, std_px = files.keypoints(stored)
        descriptors, scores = files.descriptors(stored)
        if len(descriptors) != len(keypoints):
            raise InputError(
                f"{path}: image {stored!r} has {len(keypoints)} keypoints, but "
                f"{len(descriptors)} descriptors"
            )
        xy = image.view_pixels(_upright(str(path), image, keypoints, files.size(stored)))
        row = np.flatnonzero(np.isfinite(xy).all(axis=1) & inside(xy, image.pinhole.size))
        rows[image.name] = row.astype(np.int64)
        features[image.name] = Features(
            np.ascontiguousarray(xy[row]),
            descriptors[row],
            None if scores is None else scores[row],
            std_px=std_px * image.pinhole.width / image.original_size[0],
        )
    if not features:
        difference = describe_name_difference(images.names, files.names())
        raise InputError(f"{path}: the file has features of none of the images; {difference}")
    return features, rows


class _Builder:
    """Builder that converts keypoints and matches of stored images to undistorted views."""

    def __init__(self, source: str, source_names: Collection[str], images: ImageSet) -> None:
        self._source_names = source_names
        self._source = source
        self._images = images
        self._keypoints: list[Float64] = [np.empty((0, 2))] * len(images)
        self._rows: dict[int, Int64] = {}
        self._std_px = [1.0] * len(images)
        self._matches: dict[Pair, SparseMatches] = {}

    def add(
        self, index: int, keypoints: Float64, size: tuple[int, int] | None, std_px: float
    ) -> None:
        """Add the keypoints of an image that are inside its undistorted view."""
        image = self._images[index]
        xy = image.view_pixels(_upright(self._source, image, keypoints, size))
        visible = np.isfinite(xy).all(axis=1) & inside(xy, image.pinhole.size)
        self._keypoints[index] = np.ascontiguousarray(xy[visible])
        self._rows[index] = np.where(visible, np.cumsum(visible) - 1, -1)
        self._std_px[index] = std_px * image.pinhole.width / image.original_size[0]

    def match(self, first: int, second: int, indices: Int64, scores: Float32) -> None:
        """Add matches of two images, given ``indices`` (m, 2) of the keypoints in their files."""
        if first == second or not len(indices):
            return
        if first > second:
            first, second, indices = second, first, indices[:, ::-1]
        columns = []
        for index, rows in zip((first, second), indices.T, strict=True):
            new_rows = self._rows.get(index, np.zeros(0, np.int64))
            if rows.min() < 0 or rows.max() >= len(new_rows):
                name = self._images[index].name
                raise InputError(
                    f"{self._source}: a match refers to keypoint {rows.max()} of {name!r}, which "
                    f"has {len(new_rows)} keypoints"
                )
            columns.append(new_rows[rows])
        matches = np.stack(columns, axis=1)
        visible = (matches >= 0).all(axis=1)
        self._matches[first, second] = SparseMatches.from_best_scores(
            matches[visible], scores[visible]
        )

    def finish(self) -> ImportedMatches:
        """Return the imported matches; raise :class:`InputError` if there are none."""
        if not self._rows:
            difference = describe_name_difference(self._images.names, self._source_names)
            raise InputError(
                f"{self._source}: the file has keypoints of none of the images; {difference}"
            )
        if not self._matches:
            raise InputError(
                f"{self._source}: the file has no matches between the images of the run"
            )
        return ImportedMatches(
            self._source, tuple(self._keypoints), tuple(self._std_px), self._matches
        )


def _upright(
    source: str, image: SourceImage, keypoints: Float64, size: tuple[int, int] | None
) -> Float64:
    """Map keypoints from pixels before EXIF rotation to pixels of the upright image."""
    width, height = image.original_size
    stored = (height, width) if image.orientation >= 5 else (width, height)
    if size is None or size == stored:
        return apply_orientation_to_pixels(keypoints, stored, image.orientation)
    if size == (width, height):
        return keypoints
    raise InputError(
        f"{source}: image {image.name!r} has {size[0]}x{size[1]} pixels, but the photo "
        f"{width}x{height}"
    )
