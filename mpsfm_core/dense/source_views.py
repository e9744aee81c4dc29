"""Which views a photo is matched with: those that see the same surface at a good angle."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mpsfm_core.data import Float32, Float64, PinholeCamera
from mpsfm_core.geometry import (
    camera_center,
    inside,
    project,
    sample_nearest,
    transform,
    triangulation_angle_deg,
    unproject,
)
from mpsfm_core.scene.reconstruction import RegisteredImage

_ROWS = 16
"""Of the grid of pixels that overlap is measured on."""
_ENOUGH_DEG, _WIDE_DEG = 8.0, 15.0
"""Parallax that is enough, and above which windows begin to look different; MVSNet's score has 5
degrees and spreads of 1 below and 10 above."""
_MIN_GAIN = 0.02
"""Mean gain a pixel, below which a view adds nothing (ours)."""
_HIDDEN_STDS = 1.5
"""A point so far behind what a view sees is hidden there, in std of depth (ours)."""


@dataclass(frozen=True, eq=False)
class _Sampled:
    camera: PinholeCamera
    rotation: Float64
    translation: Float64
    center: Float64
    points: Float64
    log_depth: Float32
    log_std: float


def choose_sources(images: Sequence[RegisteredImage], limit: int) -> list[list[int]]:
    """For each image the positions of at most ``limit`` others, the most useful first.

    Taken one after the other: each by what it adds where others see little.
    """
    sampled = [_sample(image) for image in images]
    return [_sources(sampled, row, limit) for row in range(len(sampled))]


def _sample(image: RegisteredImage) -> _Sampled:
    rows, columns = _ROWS, max(2, round(_ROWS * image.camera.width / image.camera.height))
    camera = image.camera.resized(columns, rows)
    y, x = np.mgrid[0:rows, 0:columns] + 0.5
    xy = np.stack([x.ravel(), y.ravel()], axis=1)
    on_map = xy * (np.array(image.depth.shape[::-1]) / (columns, rows))
    depth = sample_nearest(image.depth.depth, on_map).astype(np.float64)
    valid = sample_nearest(image.depth.valid, on_map)
    depth = np.where(valid, depth, np.median(depth[valid]) if valid.any() else 1.0)
    variance = image.depth.variance
    assert variance is not None  # of a refined map always
    spread = np.sqrt(sample_nearest(variance, on_map)) / depth
    center = camera_center(image.rotation, image.translation)
    points = unproject(camera, xy, depth) @ image.rotation + center
    log_depth = np.log(depth).astype(np.float32).reshape(rows, columns)
    log_std = float(np.median(spread[valid])) if valid.any() else 1.0
    return _Sampled(camera, image.rotation, image.translation, center, points, log_depth, log_std)


def _sources(views: Sequence[_Sampled], row: int, limit: int) -> list[int]:
    own = views[row]
    gains = np.stack([_gain(own, view) for view in views])
    gains[row] = 0
    chosen: list[int] = []
    have = np.zeros(gains.shape[1])
    for _ in range(min(limit, len(views) - 1)):
        added = (gains / (1 + have)).mean(axis=1)
        added[chosen] = 0
        best = int(added.argmax())
        if added[best] < _MIN_GAIN:
            break
        chosen.append(best)
        have += gains[best]
    return chosen


def _gain(own: _Sampled, other: _Sampled) -> Float64:
    """What another view says about each sampled pixel, 0 to 1."""
    local = transform(other.rotation, other.translation, own.points)
    xy = project(other.camera, local)
    seen = inside(xy, other.camera.size)
    ahead = np.log(np.maximum(local[:, 2], 1e-12)) - sample_nearest(
        other.log_depth, np.nan_to_num(xy)
    )
    seen &= ahead < _HIDDEN_STDS * max(own.log_std, other.log_std)
    angle = triangulation_angle_deg(own.center, other.center, own.points)
    ours, theirs = own.points - own.center, own.points - other.center
    seen &= (ours * theirs).sum(axis=1) > 0
    lengths = np.linalg.norm(ours, axis=1) / np.maximum(np.linalg.norm(theirs, axis=1), 1e-12)
    wide = np.exp(-(np.maximum(angle - _WIDE_DEG, 0) ** 2) / (2 * _WIDE_DEG**2))
    gain = np.minimum(angle / _ENOUGH_DEG, 1) * wide * np.minimum(lengths, 1 / lengths)
    return np.where(seen, gain, 0.0)
