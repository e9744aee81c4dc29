"""Tests of normals from depth: exact on planes, calibrated std, invalid at depth edges."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from mpsfm_core.data import DepthPrior, NormalPrior, PinholeCamera, View
from mpsfm_core.data.errors import ProviderError
from mpsfm_core.geometry import pixel_centers, rays
from mpsfm_core.providers import ProviderContext
from mpsfm_core.providers.builtin.normals_from_depth import NormalsFromDepth
from mpsfm_core.providers.builtin.options import NormalsFromDepthOptions
from mpsfm_core.testing.synthetic.scenes import arc_poses, room_scene

CAMERA = PinholeCamera(320, 240, 280.0, 270.0, 165.0, 118.0)
VIEW = View("a", np.zeros((240, 320, 3), np.uint8), CAMERA)
RAYS = rays(CAMERA, pixel_centers(320, 240))


def plane(normal: tuple[float, float, float], distance: float = 2.0) -> np.ndarray:
    """Depth of the plane ``n . X = -distance``."""
    unit = np.array(normal) / np.linalg.norm(normal)
    return -distance / (RAYS @ unit)


def prior(depth: np.ndarray, relative_std: float = 0.01, valid: np.ndarray | None = None):
    return DepthPrior.from_arrays(depth, (relative_std * depth) ** 2, valid)


def predict(depth: DepthPrior, context: ProviderContext, view: View = VIEW, **options: float):
    return NormalsFromDepth(NormalsFromDepthOptions(**options), context).predict(view, depth)


def errors_deg(found: NormalPrior, truth: np.ndarray) -> np.ndarray:
    cosine = (found.normals.astype(np.float64) * truth).sum(axis=-1)[found.valid]
    return np.degrees(np.arccos(np.clip(cosine, -1, 1)))


@pytest.mark.parametrize("normal", [(0, 0, -1), (0.5, -0.3, -0.8), (-0.7, 0.1, -0.5)])
def test_planes_are_exact(normal, context: ProviderContext) -> None:
    depth = plane(normal)
    found = predict(prior(depth, valid=depth > 0), context)
    truth = np.array(normal) / np.linalg.norm(normal)
    assert found.valid[20:-20, 20:-20].mean() > 0.9
    assert errors_deg(found, truth).max() < 0.05


def test_smaller_depth_map_gives_the_same_normal(context: ProviderContext) -> None:
    """Check that a depth map of another size yields the same normal."""
    small = CAMERA.resized(160, 120)
    normal = np.array([0.5, -0.3, -0.8]) / np.linalg.norm([0.5, -0.3, -0.8])
    depth = -2.0 / (rays(small, pixel_centers(160, 120)) @ normal)
    found = predict(prior(depth), context)
    assert found.shape == (120, 160) and errors_deg(found, normal).max() < 0.05


def test_normals_of_analytic_scene_are_accurate(context: ProviderContext) -> None:
    """Check normals of planes and spheres with occlusions; creases between walls are smoothed."""
    rendering = room_scene().render(CAMERA, arc_poses(1, 0.0)[0])
    found = predict(prior(rendering.depth), context)
    errors = errors_deg(found, rendering.normals)
    assert found.valid.mean() > 0.9
    assert np.median(errors) < 0.1 and np.percentile(errors, 90) < 3


def test_edges_are_invalid(context: ProviderContext) -> None:
    depth = np.full((240, 320), 2.0)
    depth[:, 160:] = 2.2
    found = predict(prior(depth), context)
    assert not found.valid[:, 159:161].any()
    assert found.valid[20:-20, 100:150].all() and found.valid[20:-20, 170:220].all()
    # No normal at a depth edge leans over the edge.
    assert errors_deg(found, np.array([0, 0, -1.0])).max() < 0.01


def test_holes(context: ProviderContext) -> None:
    valid = np.ones((240, 320), dtype=np.bool_)
    valid[100:140, 100:140] = False
    found = predict(prior(np.full((240, 320), 2.0), valid=valid), context)
    assert not found.valid[~valid].any()
    assert found.valid[50:190, 50:90].all()
    assert errors_deg(found, np.array([0, 0, -1.0])).max() < 0.01


def test_variance_follows_the_depth(context: ProviderContext) -> None:
    depth = plane((0.0, 0.0, -1.0))
    one = predict(prior(depth, 0.01), context)
    two = predict(prior(depth, 0.02), context)
    assert np.allclose(two.variance[two.valid], 4 * one.variance[one.valid], rtol=1e-3)
    # On a surface perpendicular to the ray, the angular error is the slope of the relative depth
    # error.
    middle = np.sqrt(one.variance[118, 165])
    assert middle == pytest.approx(NormalsFromDepthOptions().slope_std * 0.01, rel=1e-3)


def test_independent_noise_is_propagated(context: ProviderContext) -> None:
    """Check that the reported std matches the errors for independent noise of each pixel."""
    rng = np.random.default_rng(0)
    depth = plane((0.4, 0.2, -0.9)) * np.exp(0.003 * rng.normal(size=(240, 320)))
    found = predict(prior(depth, 0.003), context, slope_std=0.0)
    truth = np.array([0.4, 0.2, -0.9]) / np.linalg.norm([0.4, 0.2, -0.9])
    errors = np.radians(errors_deg(found, truth))
    assert found.valid.mean() > 0.85
    # The squared angular error is the sum over two tangent directions.
    ratio = np.median(errors**2 / (2 * found.variance[found.valid])) / np.log(2)
    assert 0.6 < ratio < 1.6


def test_smooth_errors_are_covered(context: ProviderContext) -> None:
    """Check the std for depth errors that bend surfaces over a quarter radian, the default of
    ``slope_std``."""
    rng = np.random.default_rng(0)
    smooth = cv2.GaussianBlur(rng.normal(size=(240, 320)), (0, 0), 0.25 * 280)
    depth = plane((0.2, 0.1, -1.0)) * np.exp(0.05 * smooth / smooth.std())
    found = predict(prior(depth, 0.05), context)
    truth = np.array([0.2, 0.1, -1.0]) / np.linalg.norm([0.2, 0.1, -1.0])
    errors = np.radians(errors_deg(found, truth))
    assert np.median(errors**2 / (2 * found.variance[found.valid])) / np.log(2) < 1.5


def test_tiny_and_empty_maps(context: ProviderContext) -> None:
    nothing = DepthPrior.from_arrays(np.zeros((24, 32)), np.ones((24, 32)))
    assert not predict(nothing, context).valid.any()
    assert not predict(prior(np.full((2, 2), 2.0)), context).valid.any()


def test_needs_a_depth_with_variance(context: ProviderContext) -> None:
    bare = DepthPrior.from_arrays(np.full((24, 32), 2.0))
    for depth in (None, bare):
        with pytest.raises(ProviderError, match="requires depth with variance"):
            NormalsFromDepth(NormalsFromDepthOptions(), context).predict(VIEW, depth)


def test_normals_of_rendered_kitchen_are_accurate(
    shared_data: Path, context: ProviderContext
) -> None:
    folder = shared_data / "data" / "rendered_kitchen"
    camera = PinholeCamera(640, 480, 502.299385, 502.299385, 320, 240)
    view = View("a", np.zeros((480, 640, 3), np.uint8), camera)
    pooled = []
    for path in sorted((folder / "gt_depth").iterdir())[::18]:
        depth = cv2.imread(str(path), cv2.IMREAD_UNCHANGED) / 1000.0
        truth = cv2.imread(str(folder / "gt_normals" / path.name))[..., ::-1] / 127.5 - 1
        known = np.linalg.norm(truth, axis=-1) > 0.5
        truth[known] /= np.linalg.norm(truth[known], axis=-1, keepdims=True)
        found = predict(prior(depth), context, view)
        assert (found.valid & known).sum() > 0.95 * (known & (depth > 0)).sum()
        usable = NormalPrior(found.normals, found.variance, found.valid & known)
        pooled.append(errors_deg(usable, truth))
    errors = np.concatenate(pooled)
    assert np.median(errors) < 0.5 and np.percentile(errors, 95) < 12
