"""Export cameras, images, keypoints, matches and two-view geometries to a COLMAP database."""

from __future__ import annotations

from collections import defaultdict
from itertools import combinations
from pathlib import Path

import numpy as np
import pycolmap

from mpsfm_core.results.exports.source import ExportSource

ENTRIES = ("database.db",)


def write(source: ExportSource, folder: Path) -> None:
    """Write a database of the registered images, with verified matches derived from tracks."""
    folder.mkdir(parents=True, exist_ok=True)
    model = source.model
    with pycolmap.Database.open(str(folder / "database.db")) as database:
        write_images(database, model)
        for (first, second), rows in sorted(_matches(model).items()):
            matches = np.array(rows, dtype=np.uint32)
            database.write_matches(first, second, matches)
            poses = [model.images[number].cam_from_world() for number in (first, second)]
            geometry = pycolmap.TwoViewGeometry(
                config=pycolmap.TwoViewGeometryConfiguration.CALIBRATED,
                inlier_matches=matches,
                cam2_from_cam1=poses[1] * poses[0].inverse(),
            )
            database.write_two_view_geometry(first, second, geometry)


def write_images(database: pycolmap.Database, model: pycolmap.Reconstruction) -> None:
    """Write cameras, rigs, frames, images and keypoints with the ids of the COLMAP model."""
    for camera in model.cameras.values():
        known = pycolmap.Camera({**camera.todict(), "has_prior_focal_length": True})
        database.write_camera(known, use_camera_id=True)
    for rig in model.rigs.values():
        database.write_rig(rig, use_rig_id=True)
    for frame in model.frames.values():
        database.write_frame(frame, use_frame_id=True)
    for image in model.images.values():
        database.write_image(image, use_image_id=True)
        xy = np.array([point.xy for point in image.points2D], dtype=np.float32).reshape(-1, 2)
        database.write_keypoints(image.image_id, xy)


def _matches(model: pycolmap.Reconstruction) -> dict[tuple[int, int], list[tuple[int, int]]]:
    """Return matches by pair of image ids, from keypoints that observe the same 3D point."""
    matches: dict[tuple[int, int], list[tuple[int, int]]] = defaultdict(list)
    for _, point in sorted(model.points3D.items()):
        views = sorted((e.image_id, e.point2D_idx) for e in point.track.elements)
        for (first, row), (second, other) in combinations(views, 2):
            if first != second:
                matches[first, second].append((row, other))
    return matches
