"""Comparison of depth from every architecture with the pipeline of transformers."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from mpsfm_transformers import stand_in
from mpsfm_transformers.depth import HubDepth, PromptDepth
from mpsfm_transformers.hub import LoadedModel, quiet
from mpsfm_transformers.options import DepthOptions, PromptOptions
from mpsfm_transformers.placement import preparation_for
from transformers import AutoImageProcessor, AutoModelForDepthEstimation

from mpsfm_core import View
from mpsfm_core.data.errors import ConfigError
from mpsfm_core.geometry import resize_map
from mpsfm_core.providers.registry import Registry

SIZES = [(149, 107), (107, 149), (320, 240)]


@pytest.fixture(scope="module")
def models(tmp_path_factory):
    folder = tmp_path_factory.mktemp("models")
    return {name: make(folder / name) for name, make in stand_in.DEPTH.items()}


def of_the_library(folder, view):
    """Run the pipeline of transformers on an image, and return network input and output."""
    with quiet(), torch.inference_mode():
        processor = AutoImageProcessor.from_pretrained(folder, backend="pil")
        network = AutoModelForDepthEstimation.from_pretrained(folder).eval()
        inputs = processor(view.image, return_tensors="pt", input_data_format="channels_last")
        outputs = network(**inputs)
    return processor, outputs


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("name", ["depth-anything", "dpt", "glpn"])
def test_depth_equals_pipeline_of_transformers(models, context, photo, name, size):
    view = photo(*size)
    prior = HubDepth(DepthOptions(model=str(models[name])), context).predict(view)
    _, outputs = of_the_library(models[name], view)
    expected = outputs.predicted_depth[0].numpy()
    if name == "dpt":
        expected = 1 / expected
    np.testing.assert_allclose(prior.depth, expected, rtol=1e-5)
    assert prior.metric == (name != "dpt")
    assert prior.valid.all()


@pytest.mark.parametrize("size", SIZES)
def test_depth_pro_as_the_library_computes_it(models, context, photo, size):
    """Compare depth with the steps of Depth Pro's image processor, which needs torchvision."""
    view = photo(*size)
    provider = HubDepth(DepthOptions(model=str(models["depth-pro"])), context)
    with quiet(), torch.inference_mode():
        network = AutoModelForDepthEstimation.from_pretrained(models["depth-pro"]).eval()
        rgb = torch.tensor(view.image).permute(2, 0, 1)[None] / 255
        pixels = torch.nn.functional.interpolate((rgb - 0.5) / 0.5, (112, 112), mode="bilinear")
        outputs = network(pixel_values=pixels)
    angle = torch.deg2rad(outputs.field_of_view[0])
    focal = 0.5 * view.camera.width / torch.tan(0.5 * angle)
    assert provider.estimate_focal(view) == pytest.approx(float(focal), rel=1e-5)
    seen = View(view.name, view.image, photo(*size, focal=float(focal)).camera)
    inverse = outputs.predicted_depth[0] * view.camera.width / focal
    expected = 1 / inverse.clamp(1e-4, 1e4)
    np.testing.assert_allclose(provider.predict(seen).depth, expected.numpy(), rtol=1e-4)


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("name", stand_in.DEPTH)
def test_cut_map_covers_the_image(models, context, photo, name, size):
    """Check that the network input, cut to the area of the view, is the resized image."""
    gray = np.add.outer(np.arange(size[1]) * 0.5, np.arange(size[0])).astype(np.uint8)
    view = photo(*size)
    view = View(view.name, np.repeat(gray[..., None], 3, axis=2), view.camera)
    loaded = LoadedModel(
        AutoModelForDepthEstimation, DepthOptions(model=str(models[name])), context
    )
    prepared = preparation_for(loaded)(view)
    mean = loaded.preprocessor.get("image_mean", [0.0])[0]
    std = loaded.preprocessor.get("image_std", [1.0])[0]
    seen = prepared.cut((prepared.pixels[0, 0].numpy() * std + mean) * 255)
    expected = resize_map(gray, seen.shape[1], seen.shape[0])
    # Resizing filters differ at the image border, and in the rounding of an 8-bit gray ramp.
    inner = np.s_[3:-3, 3:-3]
    wrapped = np.abs(seen - expected)[inner] > 60
    error = np.abs(seen - expected)[inner][~wrapped]
    assert wrapped.mean() < 0.1
    assert abs(np.median((seen - expected)[inner][~wrapped])) < 0.3
    assert np.percentile(error, 90) < 1.5


def test_zoedepth_as_the_library_cuts_it(models, context, photo):
    """Compare ZoeDepth with transformers, which crops depth after resizing."""
    view = photo(320, 240)
    _, outputs = of_the_library(models["zoedepth"], view)
    prior = HubDepth(DepthOptions(model=str(models["zoedepth"])), context).predict(view)
    pad_h, pad_w = int(np.sqrt(120) * 3), int(np.sqrt(160) * 3)
    large = torch.nn.functional.interpolate(
        outputs.predicted_depth[None], (240 + 2 * pad_h, 320 + 2 * pad_w), mode="bicubic"
    )[0, 0, pad_h:-pad_h, pad_w:-pad_w].numpy()
    expected = resize_map(large, prior.shape[1], prior.shape[0])
    np.testing.assert_allclose(prior.depth, expected, rtol=3e-3)


def test_known_models_have_the_right_output_and_unit(models, context, tmp_path):
    relative = stand_in.depth_anything(tmp_path / "r", depth_estimation_type="relative")
    provider = HubDepth(DepthOptions(model=str(relative)), context)
    assert (provider._output, provider._metric) == ("disparity", False)
    said = DepthOptions(model=str(models["dpt-dinov2"]), output="depth", metric=True)
    provider = HubDepth(said, context)
    assert (provider._output, provider._metric) == ("depth", True)


def test_prompted_by_a_sensor(context, photo, tmp_path):
    """Check that larger sensor depth results in larger predicted depth."""
    model = stand_in.prompt_depth_anything(tmp_path / "model")
    view = photo()
    depth = np.linspace(1000, 3000, 23 * 32).reshape(23, 32)[:, ::-1].copy()
    depth[5:9, 4:20] = 0
    medians = []
    for factor in (1, 2):
        np.save(tmp_path / "photo.npy", depth * factor)
        options = PromptOptions(model=str(model), directory=tmp_path, scale=0.001)
        prior = PromptDepth(options, context).predict(view)
        assert prior.metric and prior.valid.all()
        medians.append(np.median(prior.depth))
    assert medians[1] / medians[0] == pytest.approx(2, rel=1e-4)
    np.save(tmp_path / "photo.npy", 0 * depth)
    assert not PromptDepth(options, context).predict(view).valid.any()


def test_model_for_another_provider_raises(models, context, tmp_path):
    model = stand_in.prompt_depth_anything(tmp_path / "model")
    with pytest.raises(ConfigError, match="use the provider prompt-depth-anything"):
        HubDepth(DepthOptions(model=str(model)), context)
    with pytest.raises(ConfigError, match="of the family 'dpt'"):
        PromptDepth(PromptOptions(model=str(models["dpt"]), directory=tmp_path), context)


def test_declared_uncertainty():
    registry = Registry.discover()
    hook = {
        name: registry.call_hook(
            "mpsfm_calibration",
            kind="depth",
            provider="transformers",
            options=DepthOptions(model=name),
        )[0]
        for name in (
            "apple/DepthPro-hf",
            "depth-anything/Depth-Anything-V2-Small-hf@0123abc",
            "depth-anything/Depth-Anything-V2-Metric-Outdoor-Base-hf",
        )
    }
    assert [c.relative_std for c in hook.values()] == [0.0875, 0.16, 0.079]
    assert [c.shift_space for c in hook.values()] == ["depth", "disparity", "depth"]
