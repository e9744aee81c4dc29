"""Repeating textures: noise, wood, tiles, bricks, stripes, cloth, and parts of real images."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

SIZE = 128
_LEVELS = 6


def make_textures(
    rng: np.random.Generator, count: int, photos: Sequence[Path] = ()
) -> NDArray[np.uint8]:
    """Create RGB mipmap textures (levels, count, s, s, 3), each level with half the detail.

    If ``photos`` are given, every second texture is a part of a photo, mirrored such that it
    repeats.
    """
    bank = np.empty((_LEVELS, count, SIZE, SIZE, 3), np.uint8)
    for number in range(count):
        texture = None
        if photos and number % 2:
            texture = _photo(rng, photos[rng.integers(len(photos))])
        if texture is None:
            texture = _PATTERNS[rng.integers(len(_PATTERNS))](rng)
        for level in range(_LEVELS):
            side = SIZE >> level
            small = cv2.resize(texture, (side, side), interpolation=cv2.INTER_AREA)
            bank[level, number] = cv2.resize(small, (SIZE, SIZE), interpolation=cv2.INTER_LINEAR)
    return bank


def noise(rng: np.random.Generator, decay: float, stretch: float = 1.0) -> NDArray[np.float32]:
    """Create repeating noise (s, s) in [0, 1] with the spectrum ``frequency ** -decay``."""
    fy, fx = np.fft.fftfreq(SIZE)[:, None] * stretch, np.fft.rfftfreq(SIZE)[None]
    frequency = np.maximum(np.hypot(fx, fy), 1 / SIZE)
    spectrum = frequency**-decay * np.exp(2j * np.pi * rng.random(frequency.shape))
    spectrum[0, 0] = 0
    field = np.fft.irfft2(spectrum, s=(SIZE, SIZE)).astype(np.float32)
    field = (field - field.mean()) / (field.std() + 1e-6)
    return np.clip(0.5 + field / 5, 0, 1)


def _colour(rng: np.random.Generator) -> NDArray[np.float32]:
    """Draw a random color, mostly a muted one as of walls and furniture."""
    base = rng.uniform(0.1, 0.95) * np.ones(3)
    vivid = rng.uniform(0, 0.25) if rng.random() < 0.7 else rng.uniform(0.3, 0.9)
    return np.clip(base + vivid * rng.uniform(-1, 1, 3), 0.03, 1).astype(np.float32)


def _mixed(rng: np.random.Generator, weight: NDArray[np.float32]) -> NDArray[np.uint8]:
    a, b = _colour(rng), _colour(rng)
    if rng.random() < 0.6:
        b = np.clip(a * rng.uniform(0.5, 1.5), 0, 1)
    mixed = weight[..., None] * a + (1 - weight[..., None]) * b
    grain = rng.normal(0, rng.uniform(0, 0.04), mixed.shape)
    return (255 * np.clip(mixed + grain, 0, 1)).astype(np.uint8)


def _plain(rng: np.random.Generator) -> NDArray[np.uint8]:
    return _mixed(rng, 0.9 + 0.1 * noise(rng, rng.uniform(0.5, 2)))


def _mottled(rng: np.random.Generator) -> NDArray[np.uint8]:
    return _mixed(rng, noise(rng, rng.uniform(0.7, 2.2)))


def _wood(rng: np.random.Generator) -> NDArray[np.uint8]:
    rings = noise(rng, 1.6, stretch=rng.uniform(6, 20))
    return _mixed(rng, 0.5 + 0.5 * np.sin(rings * rng.uniform(10, 50)).astype(np.float32))


def _grid(rng: np.random.Generator, across: int, down: int, shift: float) -> NDArray[np.uint8]:
    y, x = np.mgrid[:SIZE, :SIZE] / SIZE
    row = np.floor(y * down)
    column = np.floor((x + shift / across * (row % 2)) * across)
    u, v = (x + shift / across * (row % 2)) * across - column, y * down - row
    gap = rng.uniform(0.02, 0.08)
    tone = rng.uniform(0.6, 1, (down, across + 1))[row.astype(int), column.astype(int) % across]
    inside = (u > gap) & (v > gap * down / across)
    value = np.where(inside, tone, 0.1) * (0.8 + 0.2 * noise(rng, 1.0))
    return _mixed(rng, value.astype(np.float32))


def _tiles(rng: np.random.Generator) -> NDArray[np.uint8]:
    across = int(rng.integers(1, 7))
    return _grid(rng, across, across, 0.0)


def _bricks(rng: np.random.Generator) -> NDArray[np.uint8]:
    return _grid(rng, int(rng.integers(2, 5)), int(rng.integers(3, 7)) * 2, 0.5)


def _planks(rng: np.random.Generator) -> NDArray[np.uint8]:
    return _grid(rng, 1, int(rng.integers(3, 9)), 0.37)


def _stripes(rng: np.random.Generator) -> NDArray[np.uint8]:
    x = np.arange(SIZE) / SIZE
    wave = sum(np.sin(2 * np.pi * (rng.integers(1, 16) * x + rng.random())) for _ in range(3))
    field = np.tile((wave > rng.uniform(-1, 1)).astype(np.float32), (SIZE, 1))
    return _mixed(rng, field if rng.random() < 0.5 else field.T.copy())


def _cloth(rng: np.random.Generator) -> NDArray[np.uint8]:
    y, x = np.mgrid[:SIZE, :SIZE]
    weave = 0.5 + 0.25 * (np.sin(x * np.pi / 2) + np.sin(y * np.pi / 2))
    return _mixed(rng, (0.7 * weave + 0.3 * noise(rng, 1.0)).astype(np.float32))


def _patches(rng: np.random.Generator) -> NDArray[np.uint8]:
    """Create a texture of rectangles in many colors, like a poster or a bookshelf."""
    picture = np.empty((SIZE, SIZE, 3), np.float32)
    picture[:] = _colour(rng)
    for _ in range(rng.integers(5, 60)):
        x, y = rng.integers(0, SIZE, 2)
        w, h = rng.integers(2, SIZE // 2, 2) if rng.random() < 0.5 else rng.integers(2, 16, 2)
        picture[y : y + h, x : x + w] = _colour(rng)
    picture *= 0.7 + 0.3 * noise(rng, 1.0)[..., None]
    return (255 * np.clip(picture, 0, 1)).astype(np.uint8)


def _photo(rng: np.random.Generator, path: Path) -> NDArray[np.uint8] | None:
    image = cv2.imread(str(path), cv2.IMREAD_COLOR)
    if image is None or min(image.shape[:2]) < 64:
        return None
    side = int(min(image.shape[:2]) * rng.uniform(0.3, 1))
    y = rng.integers(image.shape[0] - side + 1)
    x = rng.integers(image.shape[1] - side + 1)
    piece = cv2.resize(image[y : y + side, x : x + side, ::-1], (SIZE // 2, SIZE // 2))
    row = np.concatenate([piece, piece[:, ::-1]], 1)
    return np.concatenate([row, row[::-1]], 0)


_PATTERNS = (_plain, _plain, _mottled, _wood, _tiles, _bricks, _planks, _stripes, _cloth, _patches)
