"""Tests of the providers with a small network that has the tensors of the public ONNX files."""

from __future__ import annotations

import numpy as np
import pytest
from mpsfm_metric3d_onnx.options import SIZES, Metric3dOptions
from mpsfm_metric3d_onnx.provider import Metric3dDepth, Metric3dNormals
from mpsfm_onnx.decode import compute_expected_angle

from mpsfm_core import PinholeCamera, View
from mpsfm_core.data.errors import ConfigError, WeightsError
from mpsfm_core.providers.provider_config import ProviderConfig
from mpsfm_core.providers.registry import Registry

# The network returns the red channel as depth, and the blue channel divided by 200 as confidence.
STAND_IN = """
metric3d (float[b,3,616,1064] pixel_values) => (
    float[b,1,616,1064] predicted_depth, float[b,1,616,1064] confidence,
    float[b,3,616,1064] predicted_normal, float[b,616,1064] normal_confidence)
<int64[3] parts = {1, 1, 1}, float[1] k = {0.005}, int64[1] one = {1}, float[1] slope = {100}> {
    predicted_depth, green, blue = Split <axis = 1> (pixel_values, parts)
    confidence = Mul (blue, k)
    nx = Sub (green, slope)
    ny = Mul (predicted_depth, zero)
    nz = Sub (ny, slope)
    predicted_normal = Concat <axis = 1> (nx, ny, nz)
    kappa = Add (ny, twenty)
    normal_confidence = Squeeze (kappa, one)
}
"""


@pytest.fixture
def model(write_onnx):
    path = write_onnx(STAND_IN, zero=np.float32([0]), twenty=np.float32([20]))
    return {"weights": str(path)}


def view_of(width, height, colour, focal=(500.0, 500.0)):
    image = np.full((height, width, 3), colour, dtype=np.uint8)
    return View("a.png", image, PinholeCamera(width, height, *focal, width / 2, height / 2))


def test_canonical_camera_padding_and_normals(model, context):
    view = view_of(640, 480, (90, 175, 6), (700.0, 720.0))
    depth, normals = Metric3dDepth(Metric3dOptions(**model), context).predict_joint(view)
    # The image height limits the scale to 616 / 480. The resized image covers 821 x 616 pixels of
    # the 1064 x 616 network input.
    assert depth.shape == normals.shape == (616, 821)
    assert depth.valid.all() and depth.metric and depth.variance is None
    focal = (700 + 720) / 2 * 616 / 480
    np.testing.assert_allclose(depth.depth, 90 * focal / 1000, rtol=1e-5)
    np.testing.assert_allclose(normals.normals[300, 400], [0.6, 0.0, -0.8], rtol=1e-5)
    np.testing.assert_allclose(
        normals.variance, compute_expected_angle(np.array(20.0)) ** 2, rtol=1e-5
    )
    alone = Metric3dNormals(Metric3dOptions(**model), context).predict(view)
    np.testing.assert_array_equal(alone.normals, normals.normals)


def test_confidence_becomes_the_variance_of_depth(model, context):
    provider = Metric3dDepth(Metric3dOptions(**model, confidence=True), context)
    prior = provider.predict(view_of(1064, 616, (4, 0, 150)))
    np.testing.assert_allclose(prior.depth, 4 * 0.5, rtol=1e-6)
    np.testing.assert_allclose(prior.variance, (2.0 * (1 - 150 / 200)) ** 2, rtol=1e-4)


def test_padding_has_the_mean_colour(write_onnx, context):
    """Check Metric3D's padding color with a network that returns the corner pixel as depth."""
    path = write_onnx(
        """
        corner (float[1,3,616,1064] pixel_values) => (
            float[1,1,616,1064] predicted_depth, float[1,3,616,1064] predicted_normal,
            float[1,1,616,1064] normal_confidence)
        <int64[4] start = {0, 0, 0, 0}, int64[4] stop = {1, 1, 1, 1},
         int64[4] shape = {1, 1, 616, 1064}, int64[4] full = {1, 3, 616, 1064}> {
            pixel = Slice (pixel_values, start, stop)
            predicted_depth = Expand (pixel, shape)
            predicted_normal = Expand (pixel, full)
            normal_confidence = Expand (pixel, shape)
        }
        """
    )
    provider = Metric3dDepth(Metric3dOptions(weights=str(path)), context)
    prior = provider.predict(view_of(616, 616, (9, 9, 9), (1000.0, 1000.0)))
    np.testing.assert_allclose(prior.depth, 124, rtol=1e-6)


def test_depth_beyond_the_networks_range_is_invalid(model, context):
    provider = Metric3dDepth(Metric3dOptions(**model), context)
    assert not provider.predict(view_of(64, 48, (201, 0, 0))).valid.any()


def test_missing_confidence_raises(write_onnx, context):
    without = STAND_IN.replace("float[b,1,616,1064] confidence,", "")
    without = without.replace("confidence = Mul (blue, k)", "")
    path = write_onnx(without, zero=np.float32([0]), twenty=np.float32([20]))
    Metric3dDepth(Metric3dOptions(weights=str(path)), context)
    with pytest.raises(ConfigError, match=r"needs .*'confidence'.*has inputs"):
        Metric3dDepth(Metric3dOptions(weights=str(path), confidence=True), context)


@pytest.mark.parametrize("size", SIZES, ids=lambda size: size.name)
def test_default_weights_include_their_companions(size, context):
    asked = []

    def resolve(uri, sha256):
        asked.append(uri)
        raise WeightsError("not here")

    offline = type(context)(resolve_weights=resolve)
    with pytest.raises(WeightsError):
        Metric3dDepth(size.options(), offline)
    assert asked[0] == size.weights[-1].uri
    assert all("@" in file.uri for file in size.weights)


@pytest.mark.parametrize(
    ("name", "std_scale", "relative_std"),
    [("small", 2.045, 0.0433), ("large", 3.7757, 0.05), ("giant2", 3.33, 0.0263)],
)
def test_calibration_of_the_reference_with_confidence(name, std_scale, relative_std):
    registry = Registry.discover()
    provider = f"metric3d-v2-{name}"
    alone = registry.calibration("depth", ProviderConfig(use=provider))
    assert (alone.std_scale, alone.relative_std, alone.std_floor) == (std_scale, 0.08, 0.02)
    backend = ProviderConfig(use=provider, options={"confidence": True})
    full = registry.calibration("depth", backend)
    assert (full.std_scale, full.relative_std) == (std_scale, relative_std)
    assert registry.calibration("normals", ProviderConfig(use=provider)).std_scale == 1.0
