"""Patches of an analytic texture are found where it is, whatever the light, and nowhere else."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from mpsfm_core.geometry.patch_alignment import Alignment, align_patches

SIZE = 200
CENTER = np.array([100.0, 100.0])
WARP = np.array([[1.06, 0.1], [-0.08, 0.95]])
MOVED = np.array([3.3, -2.2])
RADIUS = 8
BLUR_PX = 0.8
NOISE_PX = 2 * np.sqrt(np.pi) * BLUR_PX


def texture(seed: int, xy: np.ndarray) -> np.ndarray:
    """Smooth brightness at pixels (..., 2)."""
    rng = np.random.default_rng(seed)
    waves, phases = rng.normal(0, 0.4, (2, 40)), rng.uniform(0, 2 * np.pi, 40)
    return 100 + 10 * np.cos(xy @ waves + phases).sum(axis=-1)


def pixels() -> np.ndarray:
    columns, rows = np.meshgrid(np.arange(SIZE) + 0.5, np.arange(SIZE) + 0.5)
    return np.stack([columns, rows], axis=-1)


def moved(xy: np.ndarray) -> np.ndarray:
    """Where pixels (..., 2) of the template lie in the other image."""
    return (xy - CENTER) @ WARP.T + CENTER + MOVED


def searched(seed: int = 0, noise: float = 0.0) -> np.ndarray:
    """The texture under the warp, in another light."""
    back = (pixels() - CENTER - MOVED) @ np.linalg.inv(WARP).T + CENTER
    image = 0.7 * texture(seed, back) + 20
    white = np.random.default_rng(1).normal(0, noise, image.shape)
    return (image + gaussian_filter(white, BLUR_PX)).astype(np.float32)


def aligned(
    image: np.ndarray, off: np.ndarray | float = 0.0, count: int = 200, radius: int = RADIUS
) -> tuple[Alignment, np.ndarray]:
    """Patches of the texture in an image, looked for ``off`` pixels beside where they are; and
    what is left of that."""
    template = texture(0, pixels()).astype(np.float32)
    at = np.random.default_rng(2).uniform(40, 160, (count, 2))
    start = moved(at) + off
    found = align_patches(
        template, image, at, start, np.tile(np.eye(2), (count, 1, 1)), radius, NOISE_PX
    )
    return found, start + found.shift - moved(at)


def test_a_patch_is_found_in_another_light() -> None:
    found, left = aligned(searched(), off=np.array([0.8, -0.6]))
    assert (found.correlation > 0.99).all()
    off = np.linalg.norm(left, axis=1)  # of linear interpolation
    assert np.median(off) < 0.02 and off.max() < 0.06
    assert np.abs(found.warp - WARP).max() < 0.02


def test_the_covariance_is_that_of_the_errors() -> None:
    found, left = aligned(searched(noise=8.0), off=0.5, count=1000)
    squared = np.einsum("ni,nij,nj->n", left, np.linalg.inv(found.covariance), left)
    assert 1.0 < np.median(squared) < 2.8  # 1.39 is the median of chi squared with two freedoms


def test_another_patch_is_not_alike() -> None:
    found, _ = aligned(searched(seed=7), radius=13)  # as many samples as 17 x 17 pixels
    assert np.median(found.correlation) < 0.6
    assert (found.correlation > 0.8).mean() < 0.02


def test_an_edge_is_known_across_alone() -> None:
    stripes = (100 + 50 * np.sin(pixels()[..., 0] / 3)).astype(np.float32)
    at = np.full((1, 2), 100.0)
    noisy = stripes + np.random.default_rng(0).normal(0, 0.5, stripes.shape).astype(np.float32)
    found = align_patches(stripes, noisy, at, at, np.eye(2)[None], RADIUS, NOISE_PX)
    across, along = np.diag(found.covariance[0])
    assert np.sqrt(across) < 0.5 and along > 1e3 * across


@pytest.mark.parametrize("where", [(2.0, 100.0), (100.0, 199.0), (-50.0, 100.0), (1e9, 0.0)])
@pytest.mark.parametrize("side", [0, 1])
def test_at_the_border_nothing_is_said(where: tuple[float, float], side: int) -> None:
    places = [np.full((1, 2), 100.0), np.full((1, 2), 100.0)]
    places[side] = np.array([where])
    image = texture(0, pixels()).astype(np.float32)
    found = align_patches(image, image, *places, np.eye(2)[None], RADIUS, NOISE_PX)
    assert found.correlation[0] == -1 and not found.shift.any()


def test_a_blank_wall_says_nothing() -> None:
    image, wall = texture(0, pixels()).astype(np.float32), np.full((SIZE, SIZE), 7, np.float32)
    at = np.full((1, 2), 100.0)
    for a, b in ((image, wall), (wall, image), (wall, wall)):
        found = align_patches(a, b, at, at, np.eye(2)[None], RADIUS, NOISE_PX)
        assert found.correlation[0] == -1


def test_without_patches() -> None:
    image = np.ones((5, 5), np.float32)
    nothing = np.zeros((0, 2))
    found = align_patches(image, image, nothing, nothing, np.zeros((0, 2, 2)), RADIUS, 1.0)
    assert [len(part) for part in found] == [0] * 4
