"""Accuracy of depth maps compared with true depth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass

import numpy as np

from mpsfm_core.data import Bool, Float32, Float64
from mpsfm_core.geometry import pixel_centers, sample_bilinear, scale_pixels

_DELTA = 1.25
"""Base of the depth ratio thresholds delta1, delta2 and delta3."""


@dataclass(frozen=True)
class DepthAccuracy:
    """Depth errors over the pixels where predicted depth d and true depth t are known."""

    abs_rel: float
    """Mean absolute relative error ``|d - t| / t`` of depth."""
    rmse_log: float
    """RMSE of the log depth error ``log d - log t``."""
    delta1: float
    """Ratio of pixels with ``max(d / t, t / d) < 1.25``."""
    delta2: float
    """Ratio of pixels with ``max(d / t, t / d) < 1.25^2``."""
    delta3: float
    """Ratio of pixels with ``max(d / t, t / d) < 1.25^3``."""
    pixels: int
    """Number of pixels with predicted and true depth."""
    coverage: float
    """Ratio of the pixels with true depth that also have predicted depth."""
    scale: float
    """Factor by which the predicted depth was multiplied."""


def depth_accuracy(
    depth: Float32, valid: Bool, truth: Float32, *, scale: float | None
) -> DepthAccuracy | None:
    """Compare a depth map with a true depth map at the pixels of the true map.

    Args:
        depth: (h, w) predicted depth.
        valid: (h, w) mask of valid predicted depth.
        truth: (H, W) true depth, 0 where unknown.
        scale: Factor that multiplies the predicted depth, or None for the median of ``truth /
            depth``.

    Returns:
        The depth accuracy, or None if no pixel can be compared.
    """
    _, predicted, true = sample_depth_at_truth(depth, valid, truth)
    if not len(true):
        return None
    if scale is None:
        scale = float(np.median(true / predicted))
    predicted = scale * predicted
    ratio = np.maximum(predicted / true, true / predicted)
    return DepthAccuracy(
        abs_rel=float((np.abs(predicted - true) / true).mean()),
        rmse_log=_rms(np.log(predicted / true)),
        delta1=float((ratio < _DELTA).mean()),
        delta2=float((ratio < _DELTA**2).mean()),
        delta3=float((ratio < _DELTA**3).mean()),
        pixels=len(true),
        coverage=len(true) / int((truth > 0).sum()),
        scale=scale,
    )


def sample_depth_at_truth(
    depth: Float32, valid: Bool, truth: Float32
) -> tuple[Float64, Float64, Float64]:
    """Sample a predicted depth map at the pixels with true depth.

    Args:
        depth: (h, w) depth.
        valid: (h, w) mask.
        truth: (H, W) true depth, 0 where unknown.

    Returns:
        Pixels (n, 2) of the true map, predicted depth (n,) and true depth (n,) where both depths
        are known.
    """
    known = truth > 0
    height, width = truth.shape
    xy = scale_pixels(pixel_centers(width, height)[known], (width, height), depth.shape[::-1])
    sampled, ok = sample_bilinear(depth, valid, xy)
    ok &= sampled > 0
    return xy[ok], sampled[ok], truth[known][ok].astype(np.float64)


def mean_accuracy(images: Sequence[DepthAccuracy]) -> dict[str, float]:
    """Average the depth accuracy over images as plain data, and sum the number of pixels."""
    rows = [asdict(image) for image in images]
    means = {name: float(np.mean([row[name] for row in rows])) for name in rows[0]}
    return {**means, "pixels": sum(row["pixels"] for row in rows), "images": len(rows)}


def _rms(values: Float64) -> float:
    return float(np.sqrt((values**2).mean()))
