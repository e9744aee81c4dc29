"""Rendering of training samples of random synthetic scenes."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from training.samples import EMPTY, HEIGHT, SURFACE, WIDTH, Sample
from training.synthetic.builder import Builder
from training.synthetic.raycast import draw
from training.synthetic.textures import make_textures
from training.synthetic.worlds import WORLDS, Shot

_TEXTURES = 96
_VIEWS = 6
_OVERSAMPLE = 1.25
"""Ratio of the rendered to the stored image size, for antialiasing of colors."""
_NEAREST, _FARTHEST = 0.15, 120.0
_DIFFERENT = 0.25
"""Minimum log ratio of the 95th to the 5th percentile of depth in an image. The minimum depth range
excludes images of bare walls."""


def draw_samples(seed: Sequence[int], photos: Sequence[Path] = ()) -> Iterator[Sample]:
    """Yield rendered training samples of random scenes, endlessly."""
    for rng, shoot, arrays in _draw_scenes(seed, photos):
        for _ in range(_VIEWS):
            sample = _view(rng, *arrays, shoot())
            if sample is not None:
                yield sample


def draw_cameras(
    seed: Sequence[int], photos: Sequence[Path] = ()
) -> Iterator[tuple[NDArray[np.uint8], float, NDArray[np.float64]]]:
    """Yield rendered images, focal lengths in pixels and rotations world_from_camera.

    The sequence is endless. The focal lengths have a wide range, and a third of the images are
    rolled by up to 45 degrees.
    """
    for rng, shoot, arrays in _draw_scenes(seed, photos):
        for _ in range(_VIEWS):
            shot = shoot()
            roll = rng.normal(0, 0.06) if rng.random() < 0.7 else rng.uniform(-0.8, 0.8)
            c, s = np.cos(roll), np.sin(roll)
            rotation = shot.rotation @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
            usual = rng.random() < 0.5
            log_focal = rng.normal(-0.3, 0.35) if usual else rng.uniform(np.log(0.33), np.log(2.4))
            focal = float(np.exp(log_focal)) * WIDTH / float(np.hypot(WIDTH, HEIGHT))
            sample = _view(rng, *arrays, replace(shot, rotation=rotation, focal=focal))
            if sample is not None:
                yield sample.image, float(sample.camera[0]), rotation


def _draw_scenes(
    seed: Sequence[int], photos: Sequence[Path]
) -> Iterator[tuple[np.random.Generator, Callable[[], Shot], tuple[Any, Any, Any]]]:
    """Yield random generator, function that draws a camera, and geometry of random scenes."""
    rng = np.random.default_rng(seed)
    bank = make_textures(rng, _TEXTURES, photos)
    worlds, shares = zip(*WORLDS, strict=True)
    while True:
        build = Builder(rng, _TEXTURES)
        shoot = worlds[rng.choice(len(worlds), p=shares)](build)
        yield rng, shoot, build.arrays(bank)


def _view(rng: np.random.Generator, scene, shows, sky, shot: Shot) -> Sample | None:
    focal = shot.focal * np.hypot(WIDTH, HEIGHT)
    coarse = _draw(scene, shows, sky, shot, focal / 8, WIDTH // 8, HEIGHT // 8)
    depth = coarse[1][coarse[3] == 1]
    if len(depth) < 0.5 * coarse[3].size or depth.min() < _NEAREST:
        return None
    low, high = np.percentile(depth, [5, 95])
    if np.log(high / low) < _DIFFERENT:
        return None
    size = (int(WIDTH * _OVERSAMPLE), int(HEIGHT * _OVERSAMPLE))
    light, depth, normals, kind = _draw(scene, shows, sky, shot, focal * _OVERSAMPLE, *size)
    nearest = {"dsize": (WIDTH, HEIGHT), "interpolation": cv2.INTER_NEAREST_EXACT}
    light = cv2.resize(light, (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA)
    depth, normals, kind = (cv2.resize(x, **nearest) for x in (depth, normals, kind))
    kind = np.where((kind == 1) & (depth < _FARTHEST), SURFACE, EMPTY).astype(np.uint8)
    surface = kind == SURFACE
    camera = np.array([focal, focal, WIDTH / 2, HEIGHT / 2], np.float32)
    return Sample(
        _develop(rng, light),
        np.where(surface, depth, 0).astype(np.float32),
        np.where(surface[..., None], normals, 0).astype(np.float32),
        kind,
        camera,
    )


def _draw(scene, shows, sky, shot: Shot, focal: float, width: int, height: int):
    image, depth = np.zeros((height, width, 3)), np.zeros((height, width))
    normals, kind = np.zeros((height, width, 3)), np.zeros((height, width), np.uint8)
    draw(
        scene,
        shows,
        sky,
        shot.origin,
        shot.rotation,
        focal,
        width,
        height,
        image,
        depth,
        normals,
        kind,
    )
    return image.astype(np.float32), depth.astype(np.float32), normals.astype(np.float32), kind


def _develop(rng: np.random.Generator, light: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Apply exposure, white balance, vignette, tone curve and sharpness of a random camera."""
    exposure = rng.uniform(0.35, 0.65) / (np.percentile(light, rng.uniform(40, 80)) + 0.02)
    light = light * (exposure * rng.uniform(0.92, 1.08, 3).astype(np.float32))
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    away = ((x - WIDTH / 2) ** 2 + (y - HEIGHT / 2) ** 2) / (WIDTH**2 + HEIGHT**2) * 4
    light = light * (1 - rng.uniform(0, 0.3) * away[..., None])
    curve = light / (1 + light * rng.uniform(0, 0.5)) if rng.random() < 0.7 else light
    encoded = np.clip(curve, 0, 1) ** (1 / rng.uniform(1.6, 2.4))
    return (255 * encoded + 0.5).clip(0, 255).astype(np.uint8)
