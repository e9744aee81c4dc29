"""Batches of augmented training samples.

The augmentation of an image also transforms its labels and intrinsics. Crops move the principal
point, zooms change the focal length, a roll rotates the normals, and mirroring flips them.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import count
from pathlib import Path

import cv2
import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from training.network import CANONICAL_FOCAL
from training.samples import HEIGHT, ROUGH, SURFACE, WIDTH, Shard

_SIZES = ((256, 192), (256, 192), (256, 192), (192, 256), (224, 224))
"""Possible widths and heights of the network input, one drawn per batch. All input sizes have 0.05
megapixels."""
_ZOOM = 1.6
"""Maximum zoom factor of the image augmentation. Small zooms are more frequent, because inference
does not zoom.
"""
_ROLL_DEG = 6.0


@dataclass(frozen=True)
class Batch:
    """Network input and labels of one batch. Label maps have half the size of the input.

    ``image`` (n, 3, h, w) is RGB from 0 to 255. ``rays`` (n, 2, h / 32, w / 32) are ray slopes x /
    z and y / z at the centers of pixel blocks. ``log_depth`` (n, 1, h / 2, w / 2) is the log of
    depth at the canonical focal length. ``known`` (n, 1, h / 2, w / 2) is True where depth is
    known. ``normals`` (n, 3, h / 2, w / 2) are in the camera frame, 0 if unknown. ``kind`` (n, 1, h
    / 2, w / 2) is UNKNOWN, SURFACE, EMPTY or ROUGH per pixel. ``log_focal`` (n, 1) is the log of
    the focal length relative to the image diagonal. ``metric`` (n,) is True if depth has metric
    scale.
    """

    image: Tensor
    rays: Tensor
    log_depth: Tensor
    known: Tensor
    normals: Tensor
    kind: Tensor
    log_focal: Tensor
    metric: Tensor


class Sampler:
    """Random sampler of training samples from shards on disk.

    Each data source (rendered, real, panoramas, sky) has a fixed share of the samples. A scene
    within a source is drawn with a probability proportional to the square root of its number of
    samples.
    """

    def __init__(self, sources: Sequence[tuple[Sequence[Path], float]]) -> None:
        self._shards: list[Shard] = []
        weights: list[float] = []
        for folders, share in sources:
            shards = [Shard(folder) for folder in folders]
            sizes = np.sqrt([len(s) for s in shards])
            weights += list(share * sizes / sizes.sum())
            self._shards += shards
        self._weights = np.array(weights) / np.sum(weights)

    def draw(self, rng: np.random.Generator) -> dict[str, np.ndarray]:
        """Draw a random sample from the stored shards."""
        shard = self._shards[rng.choice(len(self._shards), p=self._weights)]
        return shard[int(rng.integers(len(shard)))]


def batches(sampler: Sampler, size: int, seed: int, first: int) -> Iterator[Batch]:
    """Yield augmented batches, beginning with batch number ``first``, from a background thread."""

    def make(number: int) -> Batch:
        rng = np.random.default_rng((seed, number))
        drawn = [sampler.draw(rng) for _ in range(size)]
        return augmented(drawn, _SIZES[rng.integers(len(_SIZES))], rng)

    with ThreadPoolExecutor(1) as pool:
        ahead = deque(pool.submit(make, first + k) for k in range(3))
        for number in count(first + 3):
            yield ahead.popleft().result()
            ahead.append(pool.submit(make, number))


def augmented(
    drawn: Sequence[dict[str, np.ndarray]],
    size: tuple[int, int],
    rng: np.random.Generator | None = None,
) -> Batch:
    """Combine stored samples to a batch of images of ``size``, augmented if ``rng`` is given."""
    width, height = size
    n = len(drawn)
    image = torch.from_numpy(np.stack([_developed(d["image"], rng) for d in drawn]))
    image = image.permute(0, 3, 1, 2).float()
    labels = np.concatenate(
        [
            np.stack([d["depth"].astype(np.float32)[None] for d in drawn]),
            np.stack([d["kind"].astype(np.float32)[None] for d in drawn]),
            np.stack([d["normals"].astype(np.float32).transpose(2, 0, 1) / 127 for d in drawn]),
        ],
        1,
    )
    camera = np.stack([d["camera"] for d in drawn]).astype(np.float64)
    smallest = max(width / WIDTH, height / HEIGHT)
    zoom = smallest * np.ones(n)
    roll, mirror, slack = np.zeros(n), np.ones(n), np.full((n, 2), 0.5)
    if rng is not None:
        zoom = smallest * _ZOOM ** rng.random(n) ** 2
        roll = np.radians(_ROLL_DEG) * rng.normal(0, 0.5, n)
        mirror = rng.choice([-1.0, 1.0], n)
        slack = rng.random((n, 2))
    corner = slack * (np.array([WIDTH, HEIGHT]) - np.array(size) / zoom[:, None])
    # The augmentation rotates and zooms about the principal point c by ``output_pixel = c_out +
    # mirror * R(-roll) * zoom * (stored_pixel - c)``.
    center_out = (camera[:, 2:] - corner) * zoom[:, None]
    center_out[:, 0] = np.where(mirror < 0, width - center_out[:, 0], center_out[:, 0])
    cos, sin = np.cos(roll), np.sin(roll)
    back = np.stack([np.stack([cos * mirror, -sin], -1), np.stack([sin * mirror, cos], -1)], -2)
    back = back / zoom[:, None, None]

    matrix, center, center_out = (
        torch.from_numpy(x).float() for x in (back, camera[:, 2:], center_out)
    )

    def grid(step: int) -> Tensor:
        x, y = torch.arange(width // step) + 0.5, torch.arange(height // step) + 0.5
        out = torch.stack(torch.meshgrid(x, y, indexing="xy"), -1).reshape(1, -1, 2) * step
        stored = (out - center_out[:, None]) @ matrix.mT + center[:, None]
        shape = (n, height // step, width // step, 2)
        return (stored * torch.tensor([2 / WIDTH, 2 / HEIGHT]) - 1).reshape(shape)

    small = functional.grid_sample(
        image, grid(1), mode="bilinear", padding_mode="reflection", align_corners=False
    )
    maps = functional.grid_sample(
        torch.from_numpy(labels), grid(2), mode="nearest", align_corners=False
    )
    forth = torch.from_numpy(np.linalg.inv(back) / zoom[:, None, None]).float()
    normals = maps[:, 2:5].clone()
    normals[:, :2] = torch.einsum("nij,njhw->nihw", forth, maps[:, 2:4])
    focal = np.sqrt(camera[:, 0] * camera[:, 1]) * zoom
    known = ((maps[:, 1:2] == SURFACE) | (maps[:, 1:2] == ROUGH)) & (maps[:, 0:1] > 0)
    shift = torch.from_numpy(np.log(focal)).float()[:, None, None, None]
    log_depth = (
        torch.where(known, maps[:, 0:1], torch.ones(())).log() - shift + np.log(CANONICAL_FOCAL)
    )
    return Batch(
        small if rng is None else _spoiled(small, rng),
        rays(width, height, camera[:, :2] * zoom[:, None], center_out.numpy()),
        log_depth,
        known,
        normals,
        maps[:, 1:2].long(),
        torch.from_numpy(np.log(focal / np.hypot(width, height))).float()[:, None],
        torch.from_numpy(np.array([bool(d["metric"]) for d in drawn])),
    )


def rays(width: int, height: int, focal: np.ndarray, center: np.ndarray) -> Tensor:
    """Compute ray slopes x / z and y / z, (n, 2, h / 32, w / 32), at centers of pixel blocks.

    The pixel blocks have 32 x 32 pixels. ``focal`` (n, 2) and ``center`` (n, 2) are in pixels.
    """
    x, y = np.meshgrid(np.arange(width // 32) * 32 + 16.0, np.arange(height // 32) * 32 + 16.0)
    slopes = (np.stack([x, y]) - center[:, :, None, None]) / focal[:, :, None, None]
    return torch.from_numpy(slopes).float()


def _developed(image: np.ndarray, rng: np.random.Generator | None) -> np.ndarray:
    """Apply the tone curve, colors and JPEG compression of a random camera to an image."""
    if rng is None:
        return image
    if rng.random() < 0.8:
        levels = np.arange(256) / 255
        tables = []
        gamma, gain, offset = (
            np.exp(rng.normal(0, 0.2)),
            np.exp(rng.normal(0, 0.15)),
            rng.normal(0, 0.04),
        )
        for _ in range(3):
            channel = (
                levels ** (gamma * np.exp(rng.normal(0, 0.05))) * gain * np.exp(rng.normal(0, 0.05))
            )
            tables.append((255 * np.clip(channel + offset, 0, 1)).astype(np.uint8))
        image = cv2.LUT(image, np.stack(tables, -1)[None].reshape(1, 256, 3))
    if rng.random() < 0.3:
        grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)[..., None]
        share = rng.uniform(-0.4, 1.0)
        image = np.clip(image * (1 - share) + grey * share, 0, 255).astype(np.uint8)
    if rng.random() < 0.3:
        _, code = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, int(rng.integers(25, 90))])
        image = cv2.imdecode(code, cv2.IMREAD_COLOR)
    return image


def _spoiled(image: Tensor, rng: np.random.Generator) -> Tensor:
    """Apply random defocus blur, motion blur, downsampling and noise to images."""
    out = []
    for picture in image:
        kind = rng.random()
        array = picture.permute(1, 2, 0).numpy()
        if kind < 0.22:
            array = cv2.GaussianBlur(array, (0, 0), rng.uniform(0.4, 2.2))
        elif kind < 0.4:
            length = int(rng.integers(3, 15))
            kernel = np.zeros((length, length), np.float32)
            kernel[length // 2] = 1 / length
            turn = cv2.getRotationMatrix2D(
                (length / 2 - 0.5, length / 2 - 0.5), rng.uniform(0, 180), 1
            )
            kernel = cv2.warpAffine(kernel, turn, (length, length))
            array = cv2.filter2D(array, -1, kernel / max(kernel.sum(), 1e-6))
        elif kind < 0.5:
            share = rng.uniform(0.35, 0.8)
            little = cv2.resize(array, None, fx=share, fy=share, interpolation=cv2.INTER_AREA)
            array = cv2.resize(little, array.shape[1::-1], interpolation=cv2.INTER_LINEAR)
        if rng.random() < 0.5:
            noise = rng.standard_normal(array.shape, dtype=np.float32)
            array = array + np.float32(rng.uniform(1, 12)) * noise
        out.append(torch.from_numpy(np.ascontiguousarray(array)).permute(2, 0, 1))
    return torch.stack(out).clamp(0, 255)
