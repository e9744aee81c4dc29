"""Tests of patch alignment on analytic textures."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from mpsfm_core.geometry.patch_alignment import PatchAlignment, align_patches

SIZE = 200
CENTER = np.array([100.0, 100.0])
WARP = np.array([[1.06, 0.1], [-0.08, 0.95]])
MOVED = np.array([3.3, -2.2])
RADIUS = 8
BLUR_PX = 0.8
NOISE_PX = 2 * np.sqrt(np.pi) * BLUR_PX


def texture(seed: int, xy: np.ndarray) -> np.ndarray:
    """Evaluate a smooth texture at pixels (..., 2)."""
    rng = np.random.default_rng(seed)
    waves, phases = rng.normal(0, 0.4, (2, 40)), rng.uniform(0, 2 * np.pi, 40)
    return 100 + 10 * np.cos(xy @ waves + phases).sum(axis=-1)


def pixels() -> np.ndarray:
    columns, rows = np.meshgrid(np.arange(SIZE) + 0.5, np.arange(SIZE) + 0.5)
    return np.stack([columns, rows], axis=-1)


def warp_pixels(xy: np.ndarray) -> np.ndarray:
    """Map pixels (..., 2) of the template to the searched image."""
    return (xy - CENTER) @ WARP.T + CENTER + MOVED


def searched(seed: int = 0, noise: float = 0.0) -> np.ndarray:
    """Render the warped texture with changed brightness and contrast."""
    back = (pixels() - CENTER - MOVED) @ np.linalg.inv(WARP).T + CENTER
    image = 0.7 * texture(seed, back) + 20
    white = np.random.default_rng(1).normal(0, noise, image.shape)
    return (image + gaussian_filter(white, BLUR_PX)).astype(np.float32)


def align_texture(
    image: np.ndarray, off: np.ndarray | float = 0.0, count: int = 200, radius: int = RADIUS
) -> tuple[PatchAlignment, np.ndarray]:
    """Align patches from positions with an error of `off` pixels, and return final errors."""
    template = texture(0, pixels()).astype(np.float32)
    at = np.random.default_rng(2).uniform(40, 160, (count, 2))
    start = warp_pixels(at) + off
    found = align_patches(
        template, image, at, start, np.tile(np.eye(2), (count, 1, 1)), radius, NOISE_PX
    )
    return found, start + found.shift - warp_pixels(at)


def test_align_patches_other_brightness_recovers_shift_and_warp() -> None:
    found, residual = align_texture(searched(), off=np.array([0.8, -0.6]))
    assert (found.correlation > 0.99).all()
    off = np.linalg.norm(residual, axis=1)  # of linear interpolation
    assert np.median(off) < 0.02 and off.max() < 0.06
    assert np.abs(found.warp - WARP).max() < 0.02


def test_align_patches_noise_gives_calibrated_covariance() -> None:
    found, residual = align_texture(searched(noise=8.0), off=0.5, count=1000)
    squared = np.einsum("ni,nij,nj->n", residual, np.linalg.inv(found.covariance), residual)
    # The median of a chi-squared distribution with two degrees of freedom is 1.39.
    assert 1.0 < np.median(squared) < 2.8


def test_align_patches_other_texture_has_low_correlation() -> None:
    # The patch has as many samples as 17 x 17 pixels.
    found, _ = align_texture(searched(seed=7), radius=13)
    assert np.median(found.correlation) < 0.6
    assert (found.correlation > 0.8).mean() < 0.02


def test_align_patches_edge_is_uncertain_along_the_edge() -> None:
    stripes = (100 + 50 * np.sin(pixels()[..., 0] / 3)).astype(np.float32)
    at = np.full((1, 2), 100.0)
    noisy = stripes + np.random.default_rng(0).normal(0, 0.5, stripes.shape).astype(np.float32)
    found = align_patches(stripes, noisy, at, at, np.eye(2)[None], RADIUS, NOISE_PX)
    across, along = np.diag(found.covariance[0])
    assert np.sqrt(across) < 0.5 and along > 1e3 * across


@pytest.mark.parametrize("where", [(2.0, 100.0), (100.0, 199.0), (-50.0, 100.0), (1e9, 0.0)])
@pytest.mark.parametrize("side", [0, 1])
def test_align_patches_at_border_fails(where: tuple[float, float], side: int) -> None:
    places = [np.full((1, 2), 100.0), np.full((1, 2), 100.0)]
    places[side] = np.array([where])
    image = texture(0, pixels()).astype(np.float32)
    found = align_patches(image, image, *places, np.eye(2)[None], RADIUS, NOISE_PX)
    assert found.correlation[0] == -1 and not found.shift.any()


def test_align_patches_without_contrast_fails() -> None:
    image, wall = texture(0, pixels()).astype(np.float32), np.full((SIZE, SIZE), 7, np.float32)
    at = np.full((1, 2), 100.0)
    for a, b in ((image, wall), (wall, image), (wall, wall)):
        found = align_patches(a, b, at, at, np.eye(2)[None], RADIUS, NOISE_PX)
        assert found.correlation[0] == -1


def test_align_patches_without_patches_is_empty() -> None:
    image = np.ones((5, 5), np.float32)
    nothing = np.zeros((0, 2))
    found = align_patches(image, image, nothing, nothing, np.zeros((0, 2, 2)), RADIUS, 1.0)
    assert [len(part) for part in found] == [0] * 4
