"""Write features and matches to hloc's HDF5 files and to a COLMAP database."""

from __future__ import annotations

import importlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap

from mpsfm_core.data import Features, Float64, Int64
from mpsfm_core.data.errors import InputError
from mpsfm_core.extraction.match_graph import MatchGraph
from mpsfm_core.inputs.image_decoding import apply_orientation_to_pixels
from mpsfm_core.inputs.images import ImageSet, SourceImage
from mpsfm_core.inputs.model_orientation import orient_camera

_TO_HLOC = -0.5
"""Offset in pixels from COLMAP to hloc, because the first pixel center of hloc is (0, 0)."""
_INVERSE_ORIENTATION = {6: 8, 8: 6}
"""Inverse of EXIF orientations 6 and 8; all other EXIF orientations are their own inverse."""
_NO_ID = 2**32 - 1
"""Camera id that COLMAP gives to a camera without id."""


def write_hloc_features(path: Path, images: ImageSet, features: Mapping[str, Features]) -> None:
    """Write keypoints, descriptors and scores to a features file of hloc.

    Args:
        path: HDF5 features file to write.
        images: Images of the features, with which keypoints are converted to pixels of the image
            files.
        features: Features by image name in pixels of the undistorted views.

    Raises:
        InputError: h5py is not installed.
    """
    with _replaced(path) as file:
        for image in images:
            found = features[image.name]
            group = file.create_group(image.name)
            xy = _stored_pixels(image, found.keypoints) + _TO_HLOC
            scale = image.original_size[0] / image.pinhole.width
            group.create_dataset("keypoints", data=xy.astype(np.float32))
            group["keypoints"].attrs["uncertainty"] = found.std_px * scale
            group.create_dataset("descriptors", data=found.descriptors.T)
            scores = np.ones(len(found), np.float32) if found.scores is None else found.scores
            group.create_dataset("scores", data=scores)
            camera = _stored_camera(image)
            group.create_dataset("image_size", data=np.array([camera.width, camera.height]))


def write_hloc_matches(
    path: Path, graph: MatchGraph, rows: Mapping[str, Int64] | None = None
) -> None:
    """Write the matches of features before verification to a matches file of hloc.

    Args:
        path: HDF5 matches file to write.
        graph: Match graph with matches of a sparse matcher.
        rows: Row number in the features file of each feature (n,) by image name. By default, row i
            of the features file is feature i.

    Raises:
        InputError: h5py is not installed.
    """
    rows = rows or {}
    with _replaced(path) as file:
        for (name_a, name_b), matches in graph.matches.items():
            row_a = rows.get(name_a, np.arange(len(graph.features[name_a])))
            row_b = rows.get(name_b, np.arange(len(graph.features[name_b])))
            count = int(row_a.max(initial=-1)) + 1
            target, scores = np.full(count, -1, np.int32), np.zeros(count, np.float16)
            indices = row_a[matches.indices[:, 0]]
            target[indices] = row_b[matches.indices[:, 1]]
            scores[indices] = matches.scores
            group = file.create_group(f"{name_a.replace('/', '-')}/{name_b.replace('/', '-')}")
            group.create_dataset("matches0", data=target)
            group.create_dataset("matching_scores0", data=scores)


def write_match_database(path: Path, images: ImageSet, graph: MatchGraph) -> None:
    """Write cameras, images, keypoints and verified matches to a COLMAP database.

    The database has the keypoints of :attr:`MatchGraph.keypoints`, converted to pixels of the image
    files.

    Args:
        path: Database file to write, or to replace if the file exists.
        images: Images of the match graph.
        graph: Match graph with keypoints and verified pairs.
    """
    unfinished = path.with_name(f".{path.name}.unfinished")
    unfinished.unlink(missing_ok=True)
    with pycolmap.Database.open(str(unfinished)) as database:
        cameras: dict[tuple[int, int], int] = {}
        for number, image in enumerate(images, start=1):
            camera = _stored_camera(image)
            key = image.camera.camera_id if image.camera.camera_id < _NO_ID else -number
            if (key, image.orientation) not in cameras:
                cameras[key, image.orientation] = database.write_camera(camera)
            row = pycolmap.Image(
                name=image.name, camera_id=cameras[key, image.orientation], image_id=number
            )
            database.write_image(row, use_image_id=True)
            xy = _stored_pixels(image, graph.keypoints[image.name])
            database.write_keypoints(number, xy.astype(np.float32))
        for pair in graph.assembled.pairs:
            ids = pair.image_a + 1, pair.image_b + 1
            rows = pair.matches.astype(np.uint32)
            configuration = pycolmap.TwoViewGeometryConfiguration
            geometry = pycolmap.TwoViewGeometry(
                config=configuration.CALIBRATED if pair.calibrated else configuration.UNCALIBRATED,
                inlier_matches=rows,
                cam2_from_cam1=pycolmap.Rigid3d(np.column_stack([pair.rotation, pair.translation])),
            )
            database.write_matches(*ids, rows)
            database.write_two_view_geometry(*ids, geometry)
    unfinished.replace(path)


def _stored_camera(image: SourceImage) -> pycolmap.Camera:
    """Return the camera of an image in the orientation of its file, before EXIF rotation."""
    inverse = _INVERSE_ORIENTATION.get(image.orientation, image.orientation)
    return orient_camera(image.camera, inverse)


@contextmanager
def _replaced(path: Path) -> Iterator[Any]:
    """Write an HDF5 file that replaces the file ``path`` at the end of the ``with`` block."""
    try:
        h5py: Any = importlib.import_module("h5py")
    except ImportError as error:
        raise InputError(
            f"{path}: writing HDF5 needs h5py: pip install 'mpsfm-core[hloc]'"
        ) from error
    unfinished = path.with_name(f".{path.name}.unfinished")
    with h5py.File(str(unfinished), "w") as file:
        yield file
    unfinished.replace(path)


def _stored_pixels(image: SourceImage, xy: Float64) -> Float64:
    """Map pixels (n, 2) of the undistorted view to stored pixels of the image file."""
    upright = image.original_pixels(xy)
    inverse = _INVERSE_ORIENTATION.get(image.orientation, image.orientation)
    return apply_orientation_to_pixels(upright, image.original_size, inverse)
