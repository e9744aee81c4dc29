"""Perspective images cut from panoramas, with metric scale from the height of the tripod.

A panorama is upright, and the height of its camera above the floor is known. A pixel below the
horizon is a floor pixel if its predicted normal points up. The depth of a floor pixel is the camera
height divided by the downward slope of its ray. The ratio of true to predicted floor depth scales
the predicted depth of all other pixels.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from training.samples import EMPTY, HEIGHT, ROUGH, UNKNOWN, WIDTH, Sample

VIEWS = 24
"""Number of perspective images cut from each panorama."""
_TRIPOD = 1.45
"""Assumed tripod height in meters. Doors of 2.05 m in four rooms of Poly Haven panoramas imply
tripod heights of 1.3, 1.3, 1.5 and 1.6 m.
"""
_UPWARDS = 0.95
"""Minimum cosine between the predicted normal of a floor pixel and the up direction."""
_BELOW = 0.12
"""Minimum sine of the angle of floor rays below the horizon. The minimum angle limits the distance
of floor pixels to 12 m."""
_SAME = 0.35
"""Maximum difference of the log camera height among floor pixels. The pixels of table tops differ
by more in log camera height."""
_ENOUGH = 0.04
"""Minimum share of floor pixels in a perspective image that yield a camera height."""
_USUAL = 0.3
"""Maximum difference of the log camera height of one image from the median of its panorama. If the
difference is larger, the image shows a table or bed instead of the floor, and the median height of
its panorama is used.
"""
_OUTDOORS = 0.3
"""Minimum share of sky above the horizon in an outdoor panorama. Outdoors, only ground pixels get
depth labels.
"""

Guess = Callable[
    [NDArray[np.uint8], float],
    tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]],
]
"""Function from an image (240, 320, 3) and its focal length in pixels to depth in meters, normals
(240, 320, 3) and surface probability.
"""


@dataclass(frozen=True)
class _View:
    image: NDArray[np.uint8]
    focal: float
    depth: NDArray[np.float32]
    surface: NDArray[np.bool_]
    slope: NDArray[np.float64]
    up: NDArray[np.float64]
    looks_up: NDArray[np.bool_]
    floor: NDArray[np.bool_]
    height: float | None


def views(panorama: NDArray[np.uint8], guess: Guess, rng: np.random.Generator) -> Iterator[Sample]:
    """Cut training samples from an upright equirectangular panorama (h, 2 h, 3)."""
    seen = [_view(panorama, guess, rng, number) for number in range(VIEWS)]
    heights = [view.height for view in seen if view.height is not None]
    if len(heights) < VIEWS // 4:
        return
    usual = float(np.median(heights))
    above = [view.slope > 0 for view in seen]
    sky = [a & ~view.surface for a, view in zip(above, seen, strict=True)]
    outdoors = float(np.sum(sky)) > _OUTDOORS * np.sum(above)
    for view, empty in zip(seen, sky, strict=True):
        height, floor = view.height, view.floor
        if height is None or abs(np.log(height / usual)) > _USUAL:
            height, floor = usual, np.zeros_like(floor)
            if outdoors:
                continue
        depth = np.where(view.surface, view.depth * _TRIPOD / height, 0)
        depth = np.where(floor, _TRIPOD / np.maximum(-view.slope, 1e-3), depth)
        unsure = view.looks_up & ~floor
        known = floor if outdoors else (view.surface | floor) & ~unsure
        kind = np.where(known, ROUGH, UNKNOWN)
        if outdoors:
            kind[empty] = EMPTY
        yield Sample(
            view.image,
            np.where(known, depth, 0).astype(np.float32),
            np.where(floor[..., None], view.up, 0).astype(np.float32),
            kind.astype(np.uint8),
            np.array([view.focal, view.focal, WIDTH / 2, HEIGHT / 2], np.float32),
        )


def _view(
    panorama: NDArray[np.uint8], guess: Guess, rng: np.random.Generator, number: int
) -> _View:
    heading = 2 * np.pi * (number + rng.uniform(0, 1)) / VIEWS
    pitch, roll = np.radians(rng.uniform(-30, 5)), np.radians(rng.normal(0, 3))
    focal = WIDTH / 2 / np.tan(np.radians(rng.uniform(48, 85)) / 2)
    rotation = _rotation(heading, pitch, roll)
    image = _cut(panorama, rotation, focal)
    depth, normals, surface = guess(image, focal)
    up = rotation.T @ np.array([0.0, 0.0, 1.0])
    slope = _rays(focal) @ up
    length = np.linalg.norm(_rays(focal), axis=-1)
    looks_up = (normals @ up > _UPWARDS) & (slope < -_BELOW * length)
    height, floor = None, np.zeros_like(looks_up)
    if looks_up.mean() > _ENOUGH:
        heights = np.log(np.maximum(-slope * depth, 1e-3))
        floor = looks_up & (np.abs(heights - np.median(heights[looks_up])) < _SAME)
        height = float(np.exp(np.median(heights[floor])))
    return _View(image, focal, depth, surface > 0.5, slope, up, looks_up, floor, height)


def _rotation(heading: float, pitch: float, roll: float) -> NDArray[np.float64]:
    """Compute the rotation world_from_camera from heading, pitch and roll in rad, with z up."""
    c, s = np.cos(pitch), np.sin(pitch)
    forward = np.array([np.cos(heading) * c, np.sin(heading) * c, s])
    right = np.array([np.sin(heading), -np.cos(heading), 0.0])
    frame = np.stack([right, np.cross(forward, right), forward], 1)
    c, s = np.cos(roll), np.sin(roll)
    return frame @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])


def _rays(focal: float) -> NDArray[np.float64]:
    x, y = np.meshgrid(np.arange(WIDTH) + 0.5 - WIDTH / 2, np.arange(HEIGHT) + 0.5 - HEIGHT / 2)
    return np.stack([x / focal, y / focal, np.ones_like(x)], -1)


def _cut(
    panorama: NDArray[np.uint8], rotation: NDArray[np.float64], focal: float
) -> NDArray[np.uint8]:
    ray = _rays(focal) @ rotation.T
    ray /= np.linalg.norm(ray, axis=-1, keepdims=True)
    height, width = panorama.shape[:2]
    x = np.arctan2(-ray[..., 1], ray[..., 0]) / (2 * np.pi) % 1 * width - 0.5
    y = np.arccos(ray[..., 2]) / np.pi * height - 0.5
    maps = x.astype(np.float32), y.astype(np.float32)
    return cv2.remap(panorama, *maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)


def compact_guess(path: Path) -> Guess:
    """Return a function that averages the network outputs of an image and its mirror image."""
    import onnxruntime

    from training.network import CANONICAL_FOCAL

    session = onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    names = ["depth", "normals", "validity"]
    width, height = 256, 192

    def run(image: NDArray[np.uint8], focal: float) -> list[NDArray[np.float32]]:
        small = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
        scaled = focal * width / WIDTH
        camera = [[scaled, 0, width / 2], [0, scaled, height / 2], [0, 0, 1]]
        feed = {
            "image": small.astype(np.float32).transpose(2, 0, 1)[None],
            "intrinsics": np.array([camera], np.float32),
        }
        depth, normals, surface = session.run(names, feed)
        maps = (np.log(depth[0, 0] * scaled / CANONICAL_FOCAL), normals[0].transpose(1, 2, 0))
        return [cv2.resize(m, (WIDTH, HEIGHT)) for m in (*maps, surface[0, 0])]

    def guess(
        image: NDArray[np.uint8], focal: float
    ) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
        depth, normals, surface = run(image, focal)
        other = [m[:, ::-1] for m in run(np.ascontiguousarray(image[:, ::-1]), focal)]
        normals = normals + other[1] * np.array([-1, 1, 1], np.float32)
        normals /= np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-6)
        return np.exp((depth + other[0]) / 2), normals, (surface + other[2]) / 2

    return guess
