"""Tests of the wrapper with providers whose output for a view and its mirror image is known."""

from __future__ import annotations

import numpy as np
import pytest
from mpsfm_flip_consistency.fusion import fuse_depth, fuse_normals
from mpsfm_flip_consistency.mirror import mirror_normals, mirror_view
from mpsfm_flip_consistency.wrapper import FlipConsistency

from mpsfm_core import DepthPrior, NormalPrior, PinholeCamera, View
from mpsfm_core.data.errors import DataError
from mpsfm_core.geometry import pixel_centers, rays
from mpsfm_core.providers.provider_config import ProviderConfig
from mpsfm_core.providers.registry import Registry

CAMERA = PinholeCamera(40, 30, 50.0, 52.0, 17.3, 15.8)
RAMP = np.broadcast_to(np.arange(40, dtype=np.uint8)[:, None] * 5, (30, 40, 3)).copy()
VIEW = View("a.png", RAMP, CAMERA, np.arange(1200).reshape(30, 40) % 7 > 0)


class Plane:
    """Provider of the exact depth of a plane, which recognizes mirrored images."""

    def predict(self, view: View) -> DepthPrior:
        mirrored = view.image[0, 0, 0] > view.image[0, -1, 0]
        normal = np.array([-0.4 if mirrored else 0.4, 0.2, -1.0])
        directions = rays(view.camera, pixel_centers(*view.camera.size))
        return DepthPrior.from_arrays(-2 / (directions @ normal))


class Biased:
    """Provider that predicts the depth ``values`` (h, w) for every view."""

    def __init__(self, values, variance=None):
        self.values, self.variance = np.asarray(values, dtype=np.float64), variance

    def predict(self, view: View) -> DepthPrior:
        return DepthPrior.from_arrays(self.values, self.variance)


class Shading:
    """Provider of normals along the image gradient, which requires depth."""

    def predict(self, view: View, depth: DepthPrior | None = None) -> NormalPrior:
        assert depth is not None
        gray = view.image[..., 0].astype(np.float64)
        slope = np.gradient(gray, axis=1) / 20
        assert np.array_equal(depth.depth, gray + 1)
        return NormalPrior.from_arrays(np.stack([slope, 0.1 + 0 * slope, -1 + 0 * slope], axis=-1))


def flip(inner):
    return FlipConsistency(inner, None, None)


def test_exact_provider_has_unchanged_output():
    """Check that the principal point, depth, normals and variances are mirrored."""
    exact, fused = Plane().predict(VIEW), flip(Plane()).predict(VIEW)
    np.testing.assert_allclose(fused.depth, exact.depth, rtol=1e-6)
    np.testing.assert_allclose(fused.variance, (1e-4 * exact.depth) ** 2, rtol=1e-3)
    assert fused.valid.all()


def test_disagreement_is_the_sample_variance():
    depth = np.random.default_rng(0).uniform(1, 3, (4, 5))
    fused = flip(Biased(depth)).predict(VIEW)
    both = np.stack([depth, depth[:, ::-1]])
    np.testing.assert_allclose(fused.depth, both.mean(axis=0), rtol=1e-6)
    sample = np.maximum(both.var(axis=0, ddof=1), (1e-4 * both.mean(axis=0)) ** 2)
    np.testing.assert_allclose(fused.variance, sample, rtol=1e-4)


def test_fused_variance_is_the_larger_of_both():
    depth, variance = np.array([[2.0, 2.0, 3.0, 2.0]]), np.array([[0.5, 0.1, 0.1, 0.5]])
    fused = flip(Biased(depth, variance)).predict(VIEW)
    # At the outer two pixels, both passes agree, with network variance 0.5. At the inner two
    # pixels, the passes predict depths of 2 and 3 with variance 0.1, so the sample variance 0.5 is
    # larger.
    np.testing.assert_allclose(fused.depth, [[2.0, 2.5, 2.5, 2.0]])
    np.testing.assert_allclose(fused.variance, [[0.5, 0.5, 0.5, 0.5]], rtol=1e-6)


def test_depth_is_weighted_by_inverse_variance():
    depth, variance = np.array([[1.0, 4.0]]), np.array([[0.2, 0.6]])
    fused = flip(Biased(depth, variance)).predict(VIEW)
    mean = (1 / 0.2 + 4 / 0.6) / (1 / 0.2 + 1 / 0.6)
    np.testing.assert_allclose(fused.depth, [[mean, mean]], rtol=1e-6)
    np.testing.assert_allclose(fused.variance, (1 - mean) ** 2 + (4 - mean) ** 2, rtol=1e-5)


def test_valid_and_metric_only_where_both_are():
    fused = flip(Biased([[1.0, 0.0, 2.0, 3.0]])).predict(VIEW)
    assert fused.valid.tolist() == [[True, False, False, True]]
    relative = DepthPrior.from_arrays([[1.0]], metric=False)
    assert not fuse_depth(relative, DepthPrior.from_arrays([[1.0]])).metric


def test_normals_come_back_into_the_frame_of_the_view():
    depth = DepthPrior.from_arrays(RAMP[..., 0].astype(np.float64) + 1)
    fused = flip(Shading()).predict(VIEW, depth)
    expected = np.array([0.25, 0.1, -1]) / np.linalg.norm([0.25, 0.1, -1])
    np.testing.assert_allclose(fused.normals, np.broadcast_to(expected, (30, 40, 3)), atol=1e-6)
    np.testing.assert_allclose(fused.variance, 1e-6, rtol=1e-3)


@pytest.mark.parametrize("angle_deg", [0.5, 20.0, 80.0])
def test_covariance_of_normals_by_explicit_geometry(angle_deg):
    """Compare fused normals with log maps on the sphere, and half the trace of their covariance."""
    rng = np.random.default_rng(3)
    middle = np.array([0.3, -0.2, -0.9]) / np.linalg.norm([0.3, -0.2, -0.9])
    basis = np.linalg.svd(middle[None])[2][1:]
    direction = (rng.normal(size=2) @ basis)[None]
    direction /= np.linalg.norm(direction)
    half = np.radians(angle_deg) / 2
    pair = [np.cos(half) * middle + s * np.sin(half) * direction[0] for s in (1, -1)]
    priors = [NormalPrior.from_arrays(n[None, None]) for n in pair]
    fused = fuse_normals(*priors)
    deviations = []
    for n in pair:
        tangent = n - (n @ middle) * middle
        log_map = np.arccos(n @ middle) * tangent / np.linalg.norm(tangent)
        deviations.append(basis @ log_map)
    covariance = sum(np.outer(d, d) for d in deviations)
    np.testing.assert_allclose(fused.normals[0, 0], middle, atol=1e-6)
    assert fused.variance[0, 0] == pytest.approx(np.trace(covariance) / 2, rel=1e-4)


def test_covariance_of_normals_agrees_with_the_papers_spherical_coordinates():
    """Compare fused normals with the paper's appendix B, the trace of their xyz covariance."""
    angles = np.array([[2.3, 0.4], [2.34, 0.45]])  # polar, azimuth

    def cartesian(polar, azimuth):
        return np.array(
            [np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)]
        )

    mean = angles.mean(axis=0)
    deviations = angles - mean
    spherical = sum(np.outer(d, d) for d in deviations)
    step = 1e-6
    jacobian = np.stack(
        [(cartesian(*(mean + e)) - cartesian(*(mean - e))) / (2 * step) for e in step * np.eye(2)]
    ).T
    expected = np.trace(jacobian @ spherical @ jacobian.T) / 2
    priors = [NormalPrior.from_arrays(cartesian(*a)[None, None]) for a in angles]
    fused = fuse_normals(*priors)
    assert fused.variance[0, 0] == pytest.approx(expected, rel=1e-3)


def test_network_variance_of_normals_is_kept_when_larger():
    normals = np.array([[[0.0, 0.0, -1.0], [0.0, 0.0, -1.0]]])
    prior = NormalPrior.from_arrays(normals, np.array([[0.1, 0.3]]))
    fused = fuse_normals(prior, mirror_normals(prior))
    np.testing.assert_allclose(fused.variance, 0.2, rtol=1e-6)


def test_opposite_normals_are_invalid():
    priors = [NormalPrior.from_arrays(np.array([[[x, 0.0, 0.0]]])) for x in (1.0, -1.0)]
    assert not fuse_normals(*priors).valid.any()


def test_mirroring_twice_gives_the_view_and_changes_nothing():
    before = VIEW.image.copy()
    twice = mirror_view(mirror_view(VIEW))
    np.testing.assert_array_equal(twice.image, VIEW.image)
    np.testing.assert_array_equal(twice.mask, VIEW.mask)
    assert twice.camera.cx == pytest.approx(CAMERA.cx)
    np.testing.assert_array_equal(VIEW.image, before)


def test_grids_of_different_sizes_raise():
    class Moody:
        def predict(self, view: View) -> DepthPrior:
            width = 4 if view.image[0, 0, 0] == 0 else 5
            return DepthPrior.from_arrays(np.ones((3, width)))

    with pytest.raises(DataError, match="mirror image"):
        flip(Moody()).predict(VIEW)


def test_registry_wraps_both_kinds(context):
    registry = Registry.discover()
    wrap = (ProviderConfig(use="flip-consistency"),)
    normals = registry.create("normals", "from-depth", None, context, wrap)
    depth = Plane().predict(VIEW)
    calibrated = DepthPrior.from_arrays(depth.depth, (0.01 * depth.depth) ** 2)
    fused = normals.predict(VIEW, calibrated)
    inner = fused.normals[fused.valid]
    expected = np.array([0.4, 0.2, -1.0]) / np.linalg.norm([0.4, 0.2, -1.0])
    assert len(inner) > 500
    np.testing.assert_allclose(inner, np.broadcast_to(expected, inner.shape), atol=1e-3)
