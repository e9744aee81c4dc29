"""How far depth maps are from the truth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass

import numpy as np

from mpsfm_core.data import Bool, Float32, Float64
from mpsfm_core.geometry import pixel_centers, sample_bilinear, scale_pixels

_DELTA = 1.25


@dataclass(frozen=True)
class DepthAccuracy:
    """Errors over the pixels where prediction and truth are known.

    ``abs_rel``: mean of ``|d - t| / t``. ``rmse_log``: root mean square of ``log d - log t``.
    ``delta1``, ``delta2``, ``delta3``: share of pixels with ``max(d / t, t / d)`` below 1.25,
    1.25^2, 1.25^3. ``pixels``: how many; ``coverage``: share of those with known truth.
    ``scale``: factor that the prediction was multiplied with.
    """

    abs_rel: float
    rmse_log: float
    delta1: float
    delta2: float
    delta3: float
    pixels: int
    coverage: float
    scale: float


def depth_accuracy(
    depth: Float32, valid: Bool, truth: Float32, *, scale: float | None
) -> DepthAccuracy | None:
    """Compare a map (h, w) with the truth (H, W), 0 where unknown, on the truth's pixels.

    ``scale``: the map is multiplied with it; None for the one that makes the median of
    ``truth / depth`` one. Returns None when no pixel can be compared.
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
    """A map (h, w) at the pixels of the truth (H, W), 0 where unknown.

    Of those where both are known: the pixel of the map (n, 2), its depth (n,) and the true one.
    """
    known = truth > 0
    height, width = truth.shape
    xy = scale_pixels(pixel_centers(width, height)[known], (width, height), depth.shape[::-1])
    found, ok = sample_bilinear(depth, valid, xy)
    ok &= found > 0
    return xy[ok], found[ok], truth[known][ok].astype(np.float64)


def mean_accuracy(images: Sequence[DepthAccuracy]) -> dict[str, float]:
    """Mean of each number over images (``pixels``: the sum), plain data ready for JSON."""
    rows = [asdict(image) for image in images]
    means = {name: float(np.mean([row[name] for row in rows])) for name in rows[0]}
    return {**means, "pixels": sum(row["pixels"] for row in rows), "images": len(rows)}


def _rms(values: Float64) -> float:
    return float(np.sqrt((values**2).mean()))
