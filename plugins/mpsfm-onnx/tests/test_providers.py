"""The whole path, on tiny networks made here and on FastDepth."""

from __future__ import annotations

import subprocess
import sys

import cv2
import numpy as np
import pytest
from mpsfm_onnx.decode import expected_angle
from mpsfm_onnx.description import load_description, shipped_descriptions
from mpsfm_onnx.options import OnnxOptions
from mpsfm_onnx.providers import OnnxDepth, OnnxJoint, OnnxNormals

from mpsfm_core.calibration.model import DepthCalibration
from mpsfm_core.errors import ConfigError, WeightsError
from mpsfm_core.geometry import resize_map
from mpsfm_core.options import Backend
from mpsfm_core.registry import Registry

IDENTITY_INPUT = {"size": {"mode": "longest", "side": 64, "enlarge": False}}


def constant(shape, value):
    return np.full(shape, value, dtype=np.float32)


@pytest.fixture
def metric3d(make_model):
    """A stand-in with the tensors of the public export: depth is the red channel as it is fed."""
    normals = np.zeros((1, 3, 616, 1064))
    normals[0, 0], normals[0, 1], normals[0, 2] = 0.36, 0.48, -0.8
    return make_model(
        "pixel_values",
        [1, 3, 616, 1064],
        constants={
            "predicted_normal": normals,
            "normal_confidence": constant((1, 616, 1064), 20.0),
        },
        channels={"predicted_depth": (0, [1, 1, 616, 1064])},
    )


@pytest.mark.parametrize("name", ["metric3d-v2-small", "metric3d-v2-large", "metric3d-v2-giant2"])
def test_metric3d_interface(metric3d, make_view, context, name):
    options = OnnxOptions(description=name, model=str(metric3d))
    view = make_view(640, 480, colour=(90, 5, 6), focal=(700.0, 720.0))
    depth, normals = OnnxJoint(options, context).predict_joint(view)
    # 616 / 480 rows limit the size: 821 x 616 of 1064 x 616, of which only the image remains
    assert depth.shape == normals.shape == (616, 821)
    assert depth.valid.all() and depth.metric and depth.variance is None
    focal = (700 * 821 / 640 + 720 * 616 / 480) / 2
    np.testing.assert_allclose(depth.depth, 90 * focal / 1000, rtol=1e-5)
    np.testing.assert_allclose(normals.normals[5, 7], [0.36, 0.48, -0.8], rtol=1e-5)
    np.testing.assert_allclose(normals.variance, expected_angle(np.array(20.0)) ** 2, rtol=1e-5)
    alone = OnnxNormals(options, context).predict(view)
    np.testing.assert_array_equal(alone.normals, normals.normals)


def test_depth_beyond_the_networks_range_is_invalid(metric3d, make_view, context):
    options = OnnxOptions(description="metric3d-v2-small", model=str(metric3d))
    prior = OnnxDepth(options, context).predict(make_view(64, 48, colour=(201, 0, 0)))
    assert not prior.valid.any()


def test_optional_confidence_is_used_when_the_export_has_it(make_model, make_view, context):
    model = make_model(
        "pixel_values",
        [1, 3, 616, 1064],
        constants={
            "predicted_depth": constant((1, 1, 616, 1064), 4.0),
            "confidence": constant((1, 1, 616, 1064), 0.75),
            "predicted_normal": constant((1, 3, 616, 1064), -1.0),
            "normal_confidence": constant((1, 616, 1064), 20.0),
        },
    )
    options = OnnxOptions(description="metric3d-v2-small", model=str(model))
    prior = OnnxDepth(options, context).predict(make_view(1064, 616, focal=(500.0, 500.0)))
    np.testing.assert_allclose(prior.depth, 2.0, rtol=1e-6)
    np.testing.assert_allclose(prior.variance, (2.0 * 0.25) ** 2, rtol=1e-5)


def test_content_lies_where_it_lies_in_the_view(make_model, write_description, make_view, context):
    """A bright square found in the depth map is the square of the image (pad, half pixels)."""
    description = write_description(
        input={"size": {"mode": "fixed", "width": 128, "height": 160, "fit": "pad"}},
        outputs={"depth": {"name": "out", "metric": True}},
    )
    model = make_model("in", [1, 3, 160, 128], channels={"out": (1, [1, 1, 160, 128])})
    image = np.full((96, 256, 3), 50, dtype=np.uint8)
    image[20:61, 131:200] = 250
    view = make_view(256, 96, image=image)
    prior = OnnxDepth(OnnxOptions(description=description, model=str(model)), context).predict(view)
    assert prior.shape == (48, 128)
    share = (prior.depth - 50) / 200
    columns, rows = share.max(axis=0), share.max(axis=1)
    for profile, size, (start, stop) in ((columns, 256, (131, 200)), (rows, 96, (20, 61))):
        scale = size / len(profile)
        centre = (profile * (np.arange(len(profile)) + 0.5)).sum() / profile.sum() * scale
        assert profile.sum() * scale == pytest.approx(stop - start, abs=0.1)
        assert centre == pytest.approx((start + stop) / 2, abs=0.05)


def test_deterministic_and_leaves_the_view_alone(metric3d, make_view, context):
    image = np.random.default_rng(0).integers(0, 255, (48, 64, 3), dtype=np.uint8)
    before = image.copy()
    options = OnnxOptions(description="metric3d-v2-small", model=str(metric3d))
    provider = OnnxDepth(options, context)
    view = make_view(64, 48, image=image)
    first, second = provider.predict(view), provider.predict(view)
    np.testing.assert_array_equal(first.depth, second.depth)
    np.testing.assert_array_equal(image, before)


def test_missing_weights_say_what_to_do(context):
    with pytest.raises(WeightsError, match=r"--set depth\.options\.model=FILE"):
        OnnxDepth(OnnxOptions(), context)
    with pytest.raises(WeightsError, match=r"nowhere\.onnx does not exist"):
        OnnxDepth(OnnxOptions(model="nowhere.onnx"), context)
    with pytest.raises(WeightsError, match="downloads are switched off"):
        OnnxDepth(OnnxOptions(description="metric3d-v2-small"), context)


def test_file_that_is_no_model(tmp_path, context):
    path = tmp_path / "photo.onnx"
    path.write_bytes(b"not a model")
    with pytest.raises(WeightsError, match="cannot be opened as an ONNX model"):
        OnnxDepth(OnnxOptions(model=str(path)), context)


def test_model_of_another_description(make_model, context):
    model = make_model("pixels", [1, 3, 8, 8], constants={"out": constant((1, 1, 8, 8), 1)})
    with pytest.raises(ConfigError, match=r"wants input 'image'.*has inputs \['pixels'\]"):
        OnnxDepth(OnnxOptions(model=str(model)), context)


def test_network_without_the_wanted_output(make_model, write_description, context):
    description = write_description(
        input=IDENTITY_INPUT, outputs={"depth": {"name": "out", "metric": False}}
    )
    model = make_model("in", [1, 3, "h", "w"], constants={"out": constant((4, 4), 1)})
    options = OnnxOptions(description=description, model=str(model))
    with pytest.raises(ConfigError, match="predicts no normals"):
        OnnxNormals(options, context)


def test_relative_depth_is_not_called_metric(make_model, write_description, make_view, context):
    description = write_description(
        input=IDENTITY_INPUT,
        outputs={"depth": {"name": "out", "output": "disparity", "metric": False}},
    )
    model = make_model("in", [1, 3, "h", "w"], constants={"out": constant((1, 4, 4), 0.25)})
    options = OnnxOptions(description=description, model=str(model))
    prior = OnnxDepth(options, context).predict(make_view(4, 4))
    assert not prior.metric
    np.testing.assert_allclose(prior.depth, 4.0)


def test_description_errors_name_file_and_key(write_description):
    path = write_description(input={"size": {"mode": "fixed", "widht": 3, "height": 4}}, outputs={})
    with pytest.raises(ConfigError, match=r"description\.yaml.*widht") as caught:
        load_description(path)
    assert "depth or normals" in str(caught.value)
    with pytest.raises(ConfigError, match="fastdepth"):
        load_description("fastdept")


def test_all_shipped_descriptions_load_and_are_pinned():
    for name in shipped_descriptions():
        description = load_description(name)
        assert description.name == name and description.summary
        if description.weights:
            assert "@" in description.weights.uri


def test_registry_takes_the_calibration_of_the_description():
    registry = Registry.discover()
    backend = Backend(use="onnx", options={"model": "x.onnx"})
    assert registry.calibration("depth", backend).relative_std == 0.25
    backend = Backend(use="onnx-joint", options={"description": "metric3d-v2-large"})
    assert registry.calibration("depth", backend) == DepthCalibration(
        std_scale=3.7757, relative_std=0.08, std_floor=0.02
    )


def test_listing_does_not_import_onnxruntime():
    code = (
        "import sys, mpsfm_onnx.plugin as p; p.mpsfm_providers(); "
        "assert not {'onnxruntime', 'torch'} & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_fastdepth_on_real_photos(shared_data, make_view, context):
    """Against sensor depth, after median scaling: measured 0.18 and 0.72 on these frames."""
    model = shared_data / "models" / "fastdepth_224.onnx"
    provider = OnnxDepth(OnnxOptions(model=str(model)), context)
    scene = shared_data / "data" / "hololens_room"
    errors, close, scales = [], [], []
    for path in sorted((scene / "images").iterdir())[::6]:
        image = cv2.cvtColor(cv2.imread(str(path)), cv2.COLOR_BGR2RGB)
        view = make_view(image.shape[1], image.shape[0], image=image)
        truth = cv2.imread(str(scene / "gt_depth" / f"{path.stem}.png"), cv2.IMREAD_UNCHANGED)
        depth = resize_map(provider.predict(view).depth, *view.camera.size)
        known = (truth > 0) & (depth > 0)
        ratio = depth[known] / (truth[known] / 1000.0)
        scales.append(np.median(ratio))
        ratio /= scales[-1]
        errors.append(np.abs(ratio - 1).mean())
        close.append((np.maximum(ratio, 1 / ratio) < 1.25).mean())
    assert len(errors) == 21
    assert 0.75 < np.median(scales) < 1.1  # metres, by and large; measured 0.89
    assert np.mean(errors) < 0.21
    assert np.mean(close) > 0.66
