"""Writer of a COLMAP model with points from the true poses and depth of a scene."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import pycolmap

from mpsfm_core.data import Float64
from mpsfm_core.geometry import inside, sample_nearest

SPACING = 12
"""Distance between the points of a view in pixels."""


class Match(NamedTuple):
    """Match of two images: a world point (3,), two image ids, and two keypoints (2,)."""

    point: Float64
    first: int
    xy_first: Float64
    second: int
    xy_second: Float64


def write_model(scene: Path, folder: Path, scale: float) -> None:
    """Write a COLMAP model with the points that two images see; lengths are scaled by `scale`."""
    truth = pycolmap.Reconstruction(str(scene / "gt"))
    matches = list(_matches(scene, truth))
    camera = next(iter(truth.cameras.values()))
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(camera)
    for number, image in truth.images.items():
        pose = image.cam_from_world()
        xy = [m.xy_first for m in matches if m.first == number]
        xy += [m.xy_second for m in matches if m.second == number]
        model.add_image_with_trivial_frame(
            pycolmap.Image(image.name, np.array(xy), camera_id=camera.camera_id, image_id=number),
            pycolmap.Rigid3d(pose.rotation, scale * pose.translation),
        )
    firsts = {n: sum(m.first == n for m in matches) for n in truth.images}
    taken, taken_after = dict.fromkeys(firsts, 0), dict(firsts)
    for match in matches:
        track = [
            pycolmap.TrackElement(match.first, taken[match.first]),
            pycolmap.TrackElement(match.second, taken_after[match.second]),
        ]
        taken[match.first] += 1
        taken_after[match.second] += 1
        model.add_point3D(scale * match.point, pycolmap.Track(track))
    folder.mkdir()
    model.write(str(folder))


def _matches(scene: Path, truth: pycolmap.Reconstruction) -> Iterator[Match]:
    camera = next(iter(truth.cameras.values()))
    size = camera.width, camera.height
    axes = (np.arange(SPACING / 2, side, SPACING) for side in size)
    xy = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2) + 0.5
    rays = np.column_stack([camera.cam_from_img(xy), np.ones(len(xy))])
    depths = {number: _depth(scene, image.name) for number, image in truth.images.items()}
    for first, image in truth.images.items():
        z = sample_nearest(depths[first], xy)
        world = image.cam_from_world().inverse() * (rays * z[:, None])
        for second, other in truth.images.items():
            there = other.cam_from_world() * world
            front = (z > 0) & (there[:, 2] > 0)
            xy_there = np.where(front[:, None], camera.img_from_cam(there), 0)
            near = np.abs(sample_nearest(depths[second], xy_there) - there[:, 2]) < 0.01 * z
            seen = front & near & inside(xy_there, size) & (first != second)
            for row in np.flatnonzero(seen):
                yield Match(world[row], first, xy[row], second, xy_there[row])


def _depth(scene: Path, name: str) -> Float64:
    path = (scene / "gt_depth" / name).with_suffix(".png")
    depth: Float64 = cv2.imread(str(path), cv2.IMREAD_UNCHANGED) / 1000.0
    return depth
