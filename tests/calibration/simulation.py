"""Simulated priors whose errors have the distribution of a calibration."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from mpsfm_core.calibration.samples import DepthSamples, DepthTruth, compare_depth
from mpsfm_core.data import DepthPrior, Float64
from mpsfm_core.geometry import log_depth_steps, pixel_centers

WIDTH, HEIGHT = 96, 72


@dataclass(frozen=True)
class Simulated:
    """True parameters of a simulated prior; ``gross`` is the ratio of gross errors."""

    std_scale: float = 2.5
    relative_std: float = 0.06
    std_floor: float = 0.05
    edge_std_scale: float = 1.0
    gross: float = 0.05
    network: bool = True
    metric: bool = True
    truth_std: float = 0.0


def simulate(
    parameters: Simulated, images: int, seed: int = 0, pixels: int = 1000
) -> tuple[DepthSamples, ...]:
    """Simulate depth samples of `images` images with random scales."""
    rng = np.random.default_rng(seed)
    samples = []
    for number in range(images):
        depth = _surface(rng)
        network_std = depth * np.exp(rng.normal(np.log(0.03), 0.8, size=depth.shape))
        std = np.maximum(parameters.relative_std * depth, parameters.std_floor * parameters.metric)
        if parameters.network:
            std = np.maximum(std, parameters.std_scale * network_std)
        valid = np.ones(depth.shape, dtype=np.bool_)
        edges = log_depth_steps(depth.astype(np.float32), valid) > np.log(1.1)
        std = np.where(edges, parameters.edge_std_scale * std, std)
        error = std / depth * rng.normal(size=depth.shape)
        gross = rng.random(depth.shape) < parameters.gross
        error = np.where(gross, rng.uniform(-1.3, 1.3, size=depth.shape), error)
        error += parameters.truth_std * rng.normal(size=depth.shape)
        truth = depth * np.exp(error + 0.2 * rng.normal())
        prior = DepthPrior.from_arrays(
            depth, network_std**2 if parameters.network else None, metric=parameters.metric
        )
        chosen = rng.choice(depth.size, pixels, replace=False)
        compared = compare_depth(
            f"{number}.png",
            prior,
            (WIDTH, HEIGHT),
            DepthTruth(
                pixel_centers(WIDTH, HEIGHT).reshape(-1, 2)[chosen],
                truth.ravel()[chosen],
                np.full(pixels, parameters.truth_std),
            ),
        )
        assert compared is not None
        samples.append(compared)
    return tuple(samples)


def _surface(rng: np.random.Generator) -> Float64:
    """Return a smooth depth map with a few boxes in the foreground."""
    bumps = cv2.resize(rng.normal(size=(4, 5)), (WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC)
    depth = np.exp(rng.uniform(-0.3, 0.8) + 0.6 * bumps)
    for _ in range(4):
        row, column = rng.integers(0, HEIGHT - 20), rng.integers(0, WIDTH - 20)
        depth[row : row + 20, column : column + 20] *= rng.uniform(0.5, 0.8)
    return depth
