"""Perspective images with known cameras, cut from panoramas on the training device.

Each image is a part of an upright equirectangular panorama or of a rendered image. The principal
point is the center of the image. The images are blurred so that their sharpness does not depend on
the focal length; a network could otherwise estimate the focal length from the sharpness.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

SIZES = ((256, 192), (256, 192), (256, 160), (192, 256), (160, 256), (224, 224))
"""Possible widths and heights of the network input, one drawn per batch."""
_FOCAL = (0.4, 3.0)
"""Smallest and largest focal length relative to the longer side of the image."""
_USUAL_FOCAL, _USUAL_STD = 0.85, 0.35
"""Median of the focal length of cameras relative to the longer side, and std of its logarithm."""
_SHARPNESS = (0.35, 1.0)
"""Smallest and largest ratio of the resolution of an image to that of its pixels."""
_COARSE = 0.65
"""Largest sharpness of images cut from panoramas of less than :data:`_FINE` pixels width."""
_FINE = 2000
_STRETCH = 0.08
"""Largest log ratio of the focal lengths fx and fy, from rounding image sides to 32 pixels."""


@dataclass(frozen=True)
class CameraBatch:
    """Images and the parameters of their cameras.

    ``image`` (n, 3, h, w) is RGB from 0 to 255. ``log_focal`` (n,) is the log of the focal length
    relative to the image diagonal, ``gravity`` (n, 3) a unit vector in the camera frame, and
    ``radial`` (n,) the distortion k1 of COLMAP's model SIMPLE_RADIAL. ``up`` (n, 3, h / 32, w / 32)
    are the direction of the projected up vector, times the cosine of the latitude, and the sine of
    the latitude, at the centers of blocks of 32 x 32 pixels.
    """

    image: Tensor
    log_focal: Tensor
    gravity: Tensor
    radial: Tensor
    up: Tensor


@dataclass(frozen=True)
class _Cameras:
    """Random cameras: focal lengths in pixels (n, 2), k1 (n,), and world_from_camera (n, 3, 3)."""

    width: int
    height: int
    focal: Tensor
    radial: Tensor
    rotation: Tensor

    def rays(self, scale: float) -> Tensor:
        """Compute rays (n, h * scale, w * scale, 3) in the camera frame, with z = 1."""
        width, height = round(self.width * scale), round(self.height * scale)
        x = (torch.arange(width, device=self.focal.device) + 0.5) / scale - self.width / 2
        y = (torch.arange(height, device=self.focal.device) + 0.5) / scale - self.height / 2
        x = x[None, None, :] / self.focal[:, 0, None, None]
        y = y[None, :, None] / self.focal[:, 1, None, None]
        x, y = torch.broadcast_tensors(x, y)
        radial, distorted = self.radial[:, None, None], torch.sqrt(x * x + y * y)
        radius = distorted.clone()
        for _ in range(8):  # Newton iterations of radius (1 + k1 radius^2) = distorted
            square = radius * radius
            slope = (1 + 3 * radial * square).clamp(min=0.05)
            radius = radius - (radius * (1 + radial * square) - distorted) / slope
        ratio = radius / distorted.clamp(min=1e-6)
        return torch.stack([x * ratio, y * ratio, torch.ones_like(x)], -1)

    def batch(self, image: Tensor) -> CameraBatch:
        """Combine images (n, 3, h, w) with the labels of their cameras."""
        gravity = -self.rotation[:, 2]
        rays = self.rays(1 / 32)
        unit = functional.normalize(rays, dim=-1)
        latitude = -(unit * gravity[:, None, None]).sum(-1, keepdim=True)
        upward = -(gravity[:, None, None, :2] - gravity[:, None, None, 2:] * rays[..., :2])
        upward = functional.normalize(upward, dim=-1) * torch.sqrt((1 - latitude**2).clamp(min=0))
        focal = torch.sqrt(self.focal.prod(1)) / float(np.hypot(self.width, self.height))
        up = torch.cat([upward, latitude], -1).permute(0, 3, 1, 2)
        return CameraBatch(image, focal.log(), gravity, self.radial, up)


class Panoramas:
    """Upright equirectangular panoramas on the training device, as mip pyramids.

    Args:
        paths: JPEG files (h, 2 h).
        device: Device of the images.
        seed: Seed of the random cameras.
    """

    def __init__(self, paths: Sequence[Path], device: torch.device, seed: int = 0) -> None:
        self._random = torch.Generator(device).manual_seed(seed)
        self._device = device
        levels: list[Tensor] = []
        rows: list[list[tuple[int, int]]] = []
        offset = 0
        for path in paths:
            picture = np.ascontiguousarray(cv2.imread(str(path))[..., ::-1])
            pyramid = []
            while picture.shape[1] >= 256:
                pyramid.append((offset, picture.shape[1]))
                levels.append(torch.from_numpy(picture.reshape(-1, 3)))
                offset += picture.shape[0] * picture.shape[1]
                half = (picture.shape[1] // 2, picture.shape[0] // 2)
                picture = cv2.resize(picture, half, interpolation=cv2.INTER_AREA)
            rows.append(pyramid)
        self._pixels = torch.cat(levels).to(device)
        depth = max(len(row) for row in rows)
        table = [row + [row[-1]] * (depth - len(row)) for row in rows]
        self._levels = torch.tensor(table, device=device)

    def __len__(self) -> int:
        return len(self._levels)

    def batch(self, count: int, size: tuple[int, int]) -> CameraBatch:
        """Cut a batch of random images of ``size``."""
        random, device = self._random, self._device
        chosen = torch.randint(len(self), (count,), generator=random, device=device)
        pyramid = self._levels[chosen]
        resolution = pyramid[:, 0, 1] / (2 * np.pi)
        fine = pyramid[:, 0, 1] >= _FINE
        longer = max(size)
        # the focal length may exceed the resolution of the panorama only if images are not sharp
        focal = _draw_focal(count, random, device) * longer
        focal = torch.minimum(focal, resolution / _SHARPNESS[0])
        sharpest = torch.where(fine, _SHARPNESS[1], _COARSE)
        sharpest = torch.minimum(sharpest, resolution / focal)
        share = torch.rand(count, generator=random, device=device)
        sharpness = _SHARPNESS[0] * (sharpest / _SHARPNESS[0]) ** share
        cameras = _draw_cameras(size, focal, random)
        image = self._sample(pyramid, cameras, focal * sharpness)
        return cameras.batch(_blurred(image, sharpness))

    def _sample(self, pyramid: Tensor, cameras: _Cameras, resolution: Tensor) -> Tensor:
        """Sample images with 4 rays per pixel from the level of the required resolution."""
        world = torch.einsum("nij,nhwj->nhwi", cameras.rotation, cameras.rays(2.0))
        world = functional.normalize(world, dim=-1)
        wanted = 2 * resolution[:, None] * 2 * np.pi
        level = ((pyramid[:, :, 1] >= wanted).sum(1) - 1).clamp(min=0)
        offset, width = pyramid[torch.arange(len(level), device=level.device), level].unbind(1)
        width, offset = width[:, None, None], offset[:, None, None]
        turn = torch.atan2(-world[..., 1], world[..., 0]) / (2 * np.pi)
        x = turn * width - 0.5
        y = torch.acos(world[..., 2].clamp(-1, 1)) / np.pi * (width / 2) - 0.5
        left, top = x.floor(), y.floor()
        right_share, low_share = (x - left)[..., None], (y - top)[..., None]
        left, top = left.long(), top.long()
        last = width // 2 - 1
        image = torch.zeros(*x.shape, 3, device=x.device)
        for dy, vertical in ((0, 1 - low_share), (1, low_share)):
            row = torch.minimum((top + dy).clamp(min=0), last)
            for dx, horizontal in ((0, 1 - right_share), (1, right_share)):
                index = offset + row * width + (left + dx) % width
                image += vertical * horizontal * self._pixels[index].float()
        return functional.avg_pool2d(image.permute(0, 3, 1, 2), 2)


class Renders:
    """Rendered images (h, w, 3) of upright scenes on the training device, to cut images from.

    Each image has a focal length in pixels and a rotation world_from_camera.
    """

    def __init__(self, device: torch.device, seed: int = 0) -> None:
        self._random = torch.Generator(device).manual_seed(seed)
        self._device = device
        self._parts: dict[Path, tuple[Tensor, Tensor, Tensor]] = {}
        self._all: tuple[Tensor, Tensor, Tensor] | None = None

    def __len__(self) -> int:
        return 0 if self._all is None else len(self._all[0])

    def load(self, folder: Path) -> None:
        """Load the files of ``python -m training cameras`` that are new in a folder."""
        fresh = [path for path in sorted(folder.glob("*.npz")) if path not in self._parts]
        for path in fresh:
            with np.load(path) as stored:
                arrays = (stored["image"], stored["focal"], stored["rotation"])
                self._parts[path] = tuple(torch.from_numpy(a).to(self._device) for a in arrays)
        if fresh:
            self._all = tuple(torch.cat(part) for part in zip(*self._parts.values(), strict=True))

    def batch(self, count: int, size: tuple[int, int]) -> CameraBatch:
        """Cut a batch of random images of ``size``, with longer focal lengths and distortion."""
        assert self._all is not None
        random, device = self._random, self._device
        chosen = torch.randint(len(self), (count,), generator=random, device=device)
        images, focal, rotation = (part[chosen] for part in self._all)
        height, width = images.shape[1:3]
        # the cut image lies inside of the rendered image with a margin for distortion
        fitting = max(size[0] / width, size[1] / height)
        share = torch.rand(count, generator=random, device=device)
        zoom = fitting * 1.1 * (1.5**share)
        cameras = _draw_cameras(size, focal * zoom, random, rotation, margin=0.07)
        rays = cameras.rays(2.0)
        rays = (
            rays[..., :2]
            * focal[:, None, None, None]
            / torch.tensor([width / 2, height / 2], device=device)
        )
        source = images.permute(0, 3, 1, 2).float()
        image = functional.grid_sample(source, rays, padding_mode="reflection", align_corners=False)
        image = functional.avg_pool2d(image, 2)
        sharpest = (1 / zoom).clamp(max=1.0)
        share = torch.rand(count, generator=random, device=device)
        sharpness = _SHARPNESS[0] * (sharpest / _SHARPNESS[0]) ** share
        return cameras.batch(_blurred(image, sharpness))


def concatenate(batches: Sequence[CameraBatch]) -> CameraBatch:
    """Concatenate batches of the same image size."""
    return CameraBatch(
        *(
            torch.cat([getattr(batch, name) for batch in batches])
            for name in CameraBatch.__dataclass_fields__
        )
    )


def augmented(batch: CameraBatch, random: torch.Generator) -> CameraBatch:
    """Change colors, exposure and noise of images, and mirror half of them with their gravity."""
    image, count, device = batch.image, len(batch.image), batch.image.device

    def draw(low: float, high: float, *shape: int) -> Tensor:
        unit = torch.rand(count, *shape, generator=random, device=device)
        return low + (high - low) * unit

    gamma = torch.exp(draw(-0.5, 0.5, 1, 1, 1) + draw(-0.1, 0.1, 3, 1, 1))
    gain = torch.exp(draw(-0.35, 0.35, 1, 1, 1) + draw(-0.12, 0.12, 3, 1, 1))
    image = (image / 255).clamp(1e-3, 1) ** gamma * gain + draw(-0.06, 0.06, 1, 1, 1)
    grey = image.mean(1, keepdim=True)
    image = grey + (image - grey) * draw(0.0, 1.4, 1, 1, 1)
    noise = torch.randn(image.shape, generator=random, device=device)
    image = image + noise * draw(-0.04, 0.06, 1, 1, 1).clamp(min=0)
    mirrored = draw(0, 1) < 0.5
    image = torch.where(mirrored[:, None, None, None], image.flip(3), image)
    sign = torch.where(mirrored, -1.0, 1.0)
    gravity = batch.gravity * torch.stack([sign, sign.abs(), sign.abs()], 1)
    up = torch.where(mirrored[:, None, None, None], batch.up.flip(3), batch.up)
    up = torch.cat([up[:, :1] * sign[:, None, None, None], up[:, 1:]], 1)
    return CameraBatch(255 * image.clamp(0, 1), batch.log_focal, gravity, batch.radial, up)


def _draw_focal(count: int, random: torch.Generator, device: torch.device) -> Tensor:
    """Draw focal lengths (n,) relative to the longer side: usual ones and a wide range."""
    low, high = np.log(_FOCAL)
    wide = low + (high - low) * torch.rand(count, generator=random, device=device)
    usual = torch.randn(count, generator=random, device=device) * _USUAL_STD + np.log(_USUAL_FOCAL)
    chosen = torch.rand(count, generator=random, device=device) < 0.5
    return torch.where(chosen, usual.clamp(low, high), wide).exp()


def _draw_cameras(
    size: tuple[int, int],
    focal: Tensor,
    random: torch.Generator,
    rotation: Tensor | None = None,
    margin: float = 1.0,
) -> _Cameras:
    """Draw distortion, stretch and, unless given, orientation of cameras.

    ``margin`` is the largest relative distortion at the image corner toward the outside.
    """
    count, device = len(focal), focal.device

    def normal(std: float) -> Tensor:
        return std * torch.randn(count, generator=random, device=device)

    def uniform(low: float, high: float) -> Tensor:
        return low + (high - low) * torch.rand(count, generator=random, device=device)

    if rotation is None:
        level = uniform(0, 1)
        pitch = torch.where(level < 0.6, normal(0.2), uniform(-0.9, 0.7))
        roll = torch.where(level < 0.7, normal(0.06), uniform(-0.8, 0.8))
        rotation = _rotations(uniform(0, 2 * np.pi), pitch, roll)
    stretch = torch.where(uniform(0, 1) < 0.5, uniform(-_STRETCH, _STRETCH), 0.0)
    both = torch.stack([focal * (stretch / 2).exp(), focal * (-stretch / 2).exp()], 1)
    radial = torch.where(uniform(0, 1) < 0.5, normal(0.03), uniform(-0.3, 0.12))
    corner = (size[0] ** 2 + size[1] ** 2) / (4 * focal**2)
    # r (1 + k1 r^2) has a maximum, 2 / 3 / sqrt(-3 k1), beyond which there is no undistorted radius
    lowest = -torch.minimum(torch.tensor(margin), torch.tensor(0.8 * 4 / 27)) / corner
    radial = torch.maximum(radial, lowest)
    return _Cameras(*size, both, torch.minimum(radial, 0.5 / corner), rotation)


def _rotations(heading: Tensor, pitch: Tensor, roll: Tensor) -> Tensor:
    """Convert heading, pitch and roll of cameras to rotation matrices from camera to world.

    Angles are arrays (n,) in radians, and the rotation matrices have shape (n, 3, 3).
    The z axis of the world points up.
    """
    zero = torch.zeros_like(heading)
    c, s = pitch.cos(), pitch.sin()
    forward = torch.stack([heading.cos() * c, heading.sin() * c, s], 1)
    right = torch.stack([heading.sin(), -heading.cos(), zero], 1)
    down = torch.linalg.cross(forward, right)
    c, s = roll.cos()[:, None], roll.sin()[:, None]
    return torch.stack([c * right + s * down, c * down - s * right, forward], 2)


def _blurred(image: Tensor, sharpness: Tensor) -> Tensor:
    """Blur images with Gaussians to a resolution of ``sharpness`` times that of their pixels."""
    sigma = 0.45 * torch.sqrt((1 / sharpness**2 - 1).clamp(min=1e-4))
    offsets = torch.arange(-4, 5, device=image.device)
    kernel = torch.exp(-0.5 * (offsets[None] / sigma[:, None]) ** 2)
    kernel = (kernel / kernel.sum(1, keepdim=True)).repeat_interleave(image.shape[1], 0)
    n, c, h, w = image.shape
    flat = functional.pad(image.reshape(1, n * c, h, w), (4, 4, 4, 4), mode="reflect")
    flat = functional.conv2d(flat, kernel[:, None, None, :], groups=n * c)
    flat = functional.conv2d(flat, kernel[:, None, :, None], groups=n * c)
    return flat.reshape(n, c, h, w)
