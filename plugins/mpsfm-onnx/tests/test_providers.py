"""Tests of the ONNX providers on tiny networks and on FastDepth."""

from __future__ import annotations

import subprocess
import sys

import cv2
import numpy as np
import pytest
from mpsfm_onnx.description import load_description, shipped_descriptions
from mpsfm_onnx.network import Network
from mpsfm_onnx.options import OnnxOptions
from mpsfm_onnx.providers import OnnxDepth, OnnxJoint, OnnxNormals

from mpsfm_core.data.errors import ConfigError, WeightsError
from mpsfm_core.geometry import pixel_centers, rays, resize_map, unproject
from mpsfm_core.providers.provider_config import ProviderConfig
from mpsfm_core.providers.registry import Registry
from mpsfm_core.providers.uncertainty.calibration import DepthCalibration

IDENTITY_INPUT = {"size": {"mode": "longest", "side": 64, "enlarge": False}}
RED = "tiny (float[1,3,h,w] image) => (float[1,1,h,w] out) { out = Gather <axis = 1> (image, red) }"
"""ONNX network that returns the red channel of an image."""
FIRST = np.array([0])


def depth(**fields):
    return {"depth": {"name": "out", "metric": True, **fields}}


@pytest.fixture
def red(write_onnx, write_description):
    """Return options of a network whose depth in meters is the red channel."""
    model = write_onnx(RED, red=FIRST)
    description = write_description(input=IDENTITY_INPUT, outputs=depth())
    return OnnxOptions(description=description, model=str(model))


def test_depth_has_the_position_of_the_content(write_onnx, write_description, make_view, context):
    """Check that a bright square has the same position in image and depth map."""
    description = write_description(
        input={"size": {"mode": "fixed", "width": 128, "height": 160, "fit": "pad"}},
        outputs=depth(),
    )
    model = write_onnx(RED, red=FIRST)
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


def test_network_without_focal_length_output(red, make_view, context):
    assert OnnxDepth(red, context).estimate_focal(make_view(4, 4)) is None


def test_deterministic_and_leaves_the_view_alone(red, make_view, context):
    image = np.random.default_rng(0).integers(1, 255, (48, 64, 3), dtype=np.uint8)
    before = image.copy()
    provider = OnnxDepth(red, context)
    view = make_view(64, 48, image=image)
    first, second = provider.predict(view), provider.predict(view)
    np.testing.assert_array_equal(first.depth, image[..., 0])
    np.testing.assert_array_equal(first.depth, second.depth)
    np.testing.assert_array_equal(image, before)


def test_integer_models_get_rounded_integers(write_onnx, write_description, make_view, context):
    text = "tiny (uint8[1,3,h,w] image) => (float[1,3,h,w] out) { out = Cast <to = 1> (image) }"
    description = write_description(input={**IDENTITY_INPUT, "scale": 0.5}, outputs=depth())
    options = OnnxOptions(description=description, model=str(write_onnx(text)))
    prior = OnnxDepth(options, context).predict(make_view(4, 4, colour=(13, 0, 0)))
    np.testing.assert_array_equal(prior.depth, 6)  # the network input 6.5 is rounded to even


def test_camera_and_constants_are_inputs(write_onnx, write_description, make_view, context):
    """Check the calibration matrix in pixels of the padded input, with the first pixel at 0."""
    text = """
    tiny (float[1,3,h,w] image, float[1,3,3] K, int64 steps) => (float[1,c,32,48] out) {
        number = Cast <to = 1> (steps)
        three = Expand (number, triple)
        all = Concat <axis = 1> (K, three)
        pixel = Reshape (all, twelve)
        out = Expand (pixel, full)
    }
    """
    size = {"mode": "longest", "side": 40, "multiple_of": 16, "fit": "pad"}
    intrinsics = {"name": "K", "first_pixel": 0}
    constants = {"steps": 1800}
    fed = {"name": "image", "size": size, "intrinsics": intrinsics, "constants": constants}
    description = write_description(input=fed, outputs=depth())
    shapes = {"triple": [1, 1, 3], "twelve": [1, 12, 1, 1], "full": [1, 12, 32, 48]}
    model = write_onnx(text, **{name: np.array(shape) for name, shape in shapes.items()})
    network = Network(load_description(description), context, str(model))
    answer = network.run(make_view(80, 60, focal=(100.0, 110.0)))
    # The view is resized to 40 x 30 and placed at (4, 1) of a network input of 48 x 32 pixels.
    expected = [[50, 0, 20 + 4 - 0.5], [0, 55, 15 + 1 - 0.5], [0, 0, 1], [1800] * 3]
    assert answer.maps["out"].shape == (30, 40, 12)
    np.testing.assert_allclose(answer.maps["out"][7, 9].reshape(4, 3), expected)


def test_guessed_focal_length_and_unit(write_onnx, write_description, make_view, context):
    """Check depth with an estimated focal length and unit, for a view stretched to a square."""
    text = """
    tiny (float[1,3,h,w] image) => (float[1,1,h,w] out, float[1] focal, float[1,1] unit) {
        out = Gather <axis = 1> (image, red)
        focal = Identity (guess)
        unit = Identity (metres)
    }
    """
    model = write_onnx(text, red=FIRST, guess=np.float32([50]), metres=np.float32([[0.25]]))
    description = write_description(
        input={"size": {"mode": "fixed", "width": 32, "height": 32}},
        outputs=depth(assumed_focal="focal", multiplier="unit"),
    )
    options = OnnxOptions(description=description, model=str(model))
    view = make_view(64, 16, colour=(8, 0, 0), focal=(120.0, 300.0))
    provider = OnnxDepth(options, context)
    np.testing.assert_allclose(provider.predict(view).depth, 8 * (120 * 32 / 64) / 50 * 0.25)
    # The network input has half of the view's width and a focal length of 50 pixels.
    assert provider.estimate_focal(view) == pytest.approx(100)


def test_mask_applies_to_depth_and_normals(write_onnx, write_description, make_view, context):
    text = """
    tiny (float[1,3,h,w] image) => (
        float[1,1,h,w] out, float[1,3,h,w] normal, float[1,1,h,w] mask)
    <float[1] back = {-200}> {
        out = Gather <axis = 1> (image, red)
        mask = Gather <axis = 1> (image, blue)
        x_y = Gather <axis = 1> (image, green_green)
        zero = Sub (x_y, x_y)
        z = Add (out, back)
        normal = Concat <axis = 1> (zero, z)
    }
    """
    model = write_onnx(text, red=FIRST, blue=np.array([2]), green_green=np.array([1, 1]))
    outputs = {**depth(), "normals": {"name": "normal"}, "mask": {"name": "mask", "minimum": 100}}
    description = write_description(input=IDENTITY_INPUT, outputs=outputs)
    image = np.full((2, 4, 3), 50, dtype=np.uint8)
    image[:, :2, 2] = 101
    options = OnnxOptions(description=description, model=str(model))
    prior, normals = OnnxJoint(options, context).predict_joint(make_view(4, 2, image=image))
    for valid in (prior.valid, normals.valid):
        assert valid.tolist() == [[True, True, False, False]] * 2
    np.testing.assert_array_equal(normals.normals[0, 0], [0, 0, -1])


def test_missing_weights_name_the_next_step(context):
    with pytest.raises(WeightsError, match=r"--set depth\.options\.model=FILE"):
        OnnxDepth(OnnxOptions(), context)
    with pytest.raises(WeightsError, match=r"nowhere\.onnx does not exist"):
        OnnxDepth(OnnxOptions(model="nowhere.onnx"), context)
    with pytest.raises(WeightsError, match="downloads are switched off"):
        OnnxDepth(OnnxOptions(description="depth-anything-v2-small"), context)


def test_file_that_is_no_model(tmp_path, context):
    path = tmp_path / "photo.onnx"
    path.write_bytes(b"not a model")
    with pytest.raises(WeightsError, match="cannot be opened as an ONNX model"):
        OnnxDepth(OnnxOptions(model=str(path)), context)


def test_model_of_another_description(red, context):
    with pytest.raises(ConfigError, match=r"needs inputs \['image'\] and outputs \['depth'\].*has"):
        OnnxDepth(OnnxOptions(model=red.model), context)


def test_network_without_the_wanted_output(red, context):
    with pytest.raises(ConfigError, match="predicts no normals"):
        OnnxNormals(red, context)


def test_relative_depth_is_not_called_metric(red, write_description, make_view, context):
    outputs = depth(output="disparity", metric=False)
    options = OnnxOptions(
        description=write_description(input=IDENTITY_INPUT, outputs=outputs), model=red.model
    )
    prior = OnnxDepth(options, context).predict(make_view(4, 4, colour=(4, 0, 0)))
    assert not prior.metric
    np.testing.assert_allclose(prior.depth, 0.25)


def test_description_errors_name_file_and_key(write_description):
    path = write_description(input={"size": {"mode": "fixed", "widht": 3, "height": 4}}, outputs={})
    with pytest.raises(ConfigError, match=r"description\.yaml.*widht") as caught:
        load_description(path)
    assert "depth or normals" in str(caught.value)
    with pytest.raises(ConfigError, match="fastdepth"):
        load_description("fastdept")


SHIPPED_STAND_INS = {
    "depth-anything-v2-small": (
        "(float[b,3,h,w] pixel_values) => (float[b,h,w] predicted_depth)",
        "depth = Squeeze (meaning, axis) predicted_depth = Reciprocal (depth)",
    ),
    "depth-anything-v2-metric": (
        "(float[b,3,h,w] pixel_values) => (float[b,h,w] predicted_depth)",
        "predicted_depth = Squeeze (meaning, axis)",
    ),
    "depth-pro": (
        "(float[b,3,h,w] pixel_values) => (float[b,h,w] predicted_depth, float[b] focallength_px)",
        "predicted_depth = Squeeze (meaning, axis) focallength_px = Identity (guess)",
    ),
}
"""Interface of each shipped network, with the red channel (0 to 1) as depth."""


@pytest.mark.parametrize("name", SHIPPED_STAND_INS)
def test_shipped_descriptions_fit_their_networks(name, write_onnx, make_view, context):
    """Check the descriptions in the package with networks that return the input's red channel."""
    rule = load_description(name).input
    signature, body = SHIPPED_STAND_INS[name]
    red = f"red = Gather <axis = 1> ({rule.name}, first) a = Mul (red, std) meaning = Add (a, mean)"
    model = write_onnx(
        f"tiny {signature} {{ {red} {body} }}",
        first=FIRST,
        std=np.float32(rule.std[0]),
        mean=np.float32(rule.mean[0]),
        axis=np.array([1]),
        guess=np.float32([700]),
    )
    view = make_view(640, 480, colour=(102, 5, 6), focal=(500.0, 510.0))
    prior = OnnxDepth(OnnxOptions(description=name, model=str(model)), context).predict(view)
    factor = 500 * (1536 / 640) / 700 if name == "depth-pro" else 1.0
    assert prior.shape == ((1536, 1536) if name == "depth-pro" else (518, 686))
    np.testing.assert_allclose(prior.depth[prior.valid], 0.4 * factor, rtol=1e-3)
    assert prior.valid.all() and prior.metric == (name != "depth-anything-v2-small")


def test_unidepth_interface_gives_true_depth(write_onnx, make_view, context):
    """Check the ray input, fixed size and std of a network like UniDepth, with points at 4 m."""
    red = "r = Gather <axis = 1> (rgbs, first) a = Mul (r, std) b = Add (a, mean) c = Mul (b, ten)"
    model = write_onnx(
        f"""uni (float[b,3,28,42] rgbs, float[b,3,28,42] rays) => (
            float[b,3,28,42] pts_3d, float[b,1,28,42] confidence, float[b,3,3] intrinsics) {{
            {red} pts_3d = Mul (c, rays) d = Mul (c, none) confidence = Add (d, e)
            intrinsics = Identity (guess)
        }}""",
        first=FIRST,
        std=np.float32(0.229),
        mean=np.float32(0.485),
        ten=np.float32(10),
        none=np.float32(0),
        e=np.float32(np.e),
        guess=np.eye(3, dtype=np.float32)[None],
    )
    view = make_view(60, 56, colour=(102, 5, 6), focal=(50.0, 51.0))
    options = OnnxOptions(description="unidepth-v2", model=str(model))
    prior = OnnxDepth(options, context).predict(view)
    assert prior.shape == (28, 30) and prior.metric and prior.valid.all()
    through = rays(view.camera.resized(30, 28), pixel_centers(30, 28))
    expected = 4 / np.linalg.norm(through, axis=-1)
    np.testing.assert_allclose(prior.depth, expected, rtol=1e-5)
    np.testing.assert_allclose(prior.variance, 1, rtol=1e-5)


def test_moge_interface_gives_true_depth(write_onnx, make_view, context):
    """Check MoGe's points of a plane at z = 2 m, given in half meters with a shift and a hole."""
    text = """
    moge (float[b,3,h,w] image, int64 num_tokens) => (
        float[b,h,w,3] points, float[b,h,w,3] normal, float[b,h,w] mask, float[b] scale) {
        points = Identity (p)
        normal = Identity (n)
        mask = Identity (m)
        scale = Identity (s)
    }
    """
    view = make_view(8, 6, focal=(7.0, 7.5))
    points = unproject(view.camera, pixel_centers(8, 6), np.full((6, 8), 4.0)) - [0, 0, 0.3]
    normals = np.broadcast_to([0.0, 0.0, -1.0], (1, 6, 8, 3))
    mask = np.ones((1, 6, 8))
    mask[0, 2, 3] = 0.4
    arrays = {"p": points[None], "n": normals, "m": mask, "s": [0.5]}
    model = write_onnx(text, **{name: np.float32(value) for name, value in arrays.items()})
    options = OnnxOptions(description="moge-2", model=str(model))
    prior, facing = OnnxJoint(options, context).predict_joint(view)
    np.testing.assert_array_equal(prior.valid, mask[0] > 0.5)
    np.testing.assert_allclose(prior.depth[prior.valid], 2.0, rtol=1e-5)
    assert prior.metric and np.array_equal(facing.valid, prior.valid)


def test_all_shipped_descriptions_load_and_are_pinned():
    for name in shipped_descriptions():
        description = load_description(name)
        assert description.name == name and description.summary
        if description.weights:
            assert "@" in description.weights.uri


def test_registry_takes_the_calibration_of_the_description():
    registry = Registry.discover()
    backend = ProviderConfig(use="onnx", options={"model": "x.onnx"})
    assert registry.calibration("depth", backend).relative_std == 0.25
    backend = ProviderConfig(use="onnx", options={"description": "depth-pro"})
    assert registry.calibration("depth", backend) == DepthCalibration(
        std_scale=1.0, relative_std=0.0875
    )


def test_listing_does_not_import_onnxruntime():
    code = (
        "import sys, mpsfm_onnx.plugin as p; p.mpsfm_providers(); "
        "assert not {'onnxruntime', 'torch'} & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_fastdepth_on_real_photos(shared_data, make_view, context):
    """Compare FastDepth with sensor depth after median scaling (measured AbsRel: 0.18)."""
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
    assert 0.75 < np.median(scales) < 1.1  # median of predicted over true depth is 0.89
    assert np.mean(errors) < 0.21
    assert np.mean(close) > 0.66
