"""Similarity transforms between two world frames."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mpsfm_core.data import Float64


@dataclass(frozen=True, eq=False)
class SimilarityTransform:
    """Similarity transform ``x_b = scale * rotation @ x_a + translation``."""

    scale: float
    """Scale > 0."""
    rotation: Float64
    """(3, 3) rotation."""
    translation: Float64
    """(3,) translation."""

    def apply(self, points: Float64) -> Float64:
        """Transform points (n, 3) from frame a to frame b."""
        moved: Float64 = self.scale * points @ self.rotation.T + self.translation
        return moved


def umeyama(a: Float64, b: Float64, weights: Float64 | None = None) -> SimilarityTransform:
    """Fit the least-squares similarity transform ``b_from_a`` (Umeyama, PAMI 1991).

    Args:
        a: (n, 3) corresponding points in frame a.
        b: (n, 3) corresponding points in frame b.
        weights: (n,) weights of the squared distances, or None for equal weights.

    Raises:
        ValueError: All points in one of the frames coincide, so the scale is undefined.
    """
    mean_a, mean_b = np.average(a, axis=0, weights=weights), np.average(b, axis=0, weights=weights)
    spread_a, spread_b = a - mean_a, b - mean_b
    if not (spread_a.any() and spread_b.any()):
        raise ValueError("all points coincide")
    weighted_a = spread_a if weights is None else weights[:, None] * spread_a
    u, singular, vt = np.linalg.svd(spread_b.T @ weighted_a)
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(u) * np.linalg.det(vt))])
    rotation = (u * signs) @ vt
    scale = float((singular * signs).sum() / (weighted_a * spread_a).sum())
    return SimilarityTransform(scale, rotation, mean_b - scale * rotation @ mean_a)
