"""Write the mapper's input for the report as small images, priors and verified matches.

A failed run also writes the mapper's input, so that the report shows the cause of the failure.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from mpsfm_core.data import Float64, MappingImage, MappingProblem, UInt8, View
from mpsfm_core.support.npz import write_npz
from mpsfm_core.support.threads import parallel_map

PICTURE_SIDE = 960
"""Longer side in pixels of the images in ``views/``."""
PICTURE_QUALITY = 80
"""WebP quality."""
MATCHES_A_PAIR = 100
"""Maximum number of written matches per image pair."""
MATCHES = "matches.npz"
"""File name of the matches in ``views/``."""


def write_views(folder: Path, problem: MappingProblem, view_of: Callable[[str], View]) -> None:
    """Write ``NAME.webp`` and ``NAME.npz`` for every image, and ``matches.npz``.

    The file ``NAME.webp`` is the downscaled undistorted image. In ``NAME.npz``, ``depth`` (h, w)
    float32 is the depth prior in units of the depth provider. ``relative_std`` (h, w) float16 is
    the standard deviation of the depth prior divided by the depth. ``valid`` (h, w) bool is the
    mask of valid depth. ``normals`` (h, w, 3) float16 are unit normals in the camera frame.
    ``camera`` (6,) float64 is the width, height, fx, fy, cx, cy of the full undistorted image.

    In ``matches.npz``, ``names`` (n,) are the image names, and ``pairs`` (p, 2) int64 are image
    pairs as rows of ``names``. ``points_a`` and ``points_b`` (m, 2) float32 are the matched
    keypoints of all pairs in pixels of the undistorted images. ``starts`` (p + 1,) int64 is the
    first row of each pair in ``points_a`` and ``points_b``.
    """

    def write(image: MappingImage) -> None:
        write_npz(
            folder / f"{image.name}.npz",
            depth=image.depth.depth,
            relative_std=_relative_std(image),
            normals=image.normals.normals.astype(np.float16),
            valid=image.depth.valid,
            camera=np.array([*image.camera.size, *image.camera.params]),
        )
        _write_picture(folder / f"{image.name}.webp", view_of(image.name).image)

    parallel_map(write, problem.images)
    _write_matches(folder / MATCHES, problem)


def _relative_std(image: MappingImage) -> NDArray[np.float16]:
    assert image.depth.variance is not None  # a MappingImage requires a depth variance
    depth = np.where(image.depth.valid, image.depth.depth, 1)
    std = np.sqrt(np.where(image.depth.valid, image.depth.variance, 0)) / depth
    return np.asarray(np.minimum(std, np.finfo(np.float16).max), np.float16)


def _write_picture(path: Path, rgb: UInt8) -> None:
    factor = min(1.0, PICTURE_SIDE / max(rgb.shape[:2]))
    if factor < 1:
        size = (max(1, round(rgb.shape[1] * factor)), max(1, round(rgb.shape[0] * factor)))
        rgb = np.asarray(cv2.resize(rgb, size, interpolation=cv2.INTER_AREA), np.uint8)
    bgr = cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR)
    _, data = cv2.imencode(".webp", bgr, [cv2.IMWRITE_WEBP_QUALITY, PICTURE_QUALITY])
    path.write_bytes(data.tobytes())


def _write_matches(path: Path, problem: MappingProblem) -> None:
    points: list[list[Float64]] = [[np.zeros((0, 2))], [np.zeros((0, 2))]]
    counts = []
    for pair in problem.pairs:
        step = -(-len(pair.matches) // MATCHES_A_PAIR)
        rows = pair.matches[:: max(1, step)]
        counts.append(len(rows))
        for side, image in enumerate((pair.image_a, pair.image_b)):
            points[side].append(problem.images[image].keypoints[rows[:, side]])
    write_npz(
        path,
        names=np.array([image.name for image in problem.images], dtype=np.str_),
        pairs=np.array([(p.image_a, p.image_b) for p in problem.pairs], np.int64).reshape(-1, 2),
        starts=np.cumsum([0, *counts]),
        points_a=np.concatenate(points[0]).astype(np.float32),
        points_b=np.concatenate(points[1]).astype(np.float32),
    )
