"""Depth from any model that ``AutoModelForDepthEstimation`` of transformers loads."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from scipy.ndimage import distance_transform_edt
from transformers import AutoModelForDepthEstimation

from mpsfm_core import DepthPrior, ProviderContext, View
from mpsfm_core.data import Float32, Float64
from mpsfm_core.data.errors import ConfigError
from mpsfm_core.providers.builtin.files import DepthFiles
from mpsfm_core.providers.builtin.options import DepthFileOptions
from mpsfm_core.providers.torch_runtime import inference
from mpsfm_transformers.hub import LoadedModel
from mpsfm_transformers.options import DepthOptions, Output, PromptOptions, look_up_model
from mpsfm_transformers.placement import Preparation, preparation_for

_PROMPTED = "prompt_depth_anything"
_FARTHEST_M = 250.0
"""Maximum depth in meters that Depth Pro predicts. [reference]"""
_NO_SPREAD_M = 1e-6
"""Offset in meters that is added to one pixel of constant sensor depth, because the library
transformers cannot normalize a constant."""

_METRIC = ("glpn", "zoedepth", "tipsv2_dpt")
"""Values of ``model_type`` in ``config.json`` of models that predict meters."""


class HubDepth:
    """Provider of depth from a Hub model, at the resolution of the network output."""

    def __init__(self, options: DepthOptions, context: ProviderContext) -> None:
        self._model = LoadedModel(AutoModelForDepthEstimation, options, context)
        config = self._model.network.config
        if config.model_type == _PROMPTED:
            raise ConfigError(
                f"the model {options.model} needs depth maps of a sensor: use the provider "
                f"prompt-depth-anything"
            )
        self._output, self._metric = resolve_output(config, options)
        self._preparation = preparation_for(self._model)
        self._by_focal = config.model_type == "depth_pro"

    def predict(self, view: View) -> DepthPrior:
        """Predict the depth of a view, for Depth Pro from the focal length of its camera."""
        value, _ = self._run(view)
        if self._by_focal:
            inverse = value.astype(np.float64) * (view.camera.width / view.camera.fx)
            return _inverse(inverse, self._metric, 1 / _FARTHEST_M)
        if self._output == "disparity":
            return _inverse(value.astype(np.float64), self._metric)
        return DepthPrior.from_arrays(value, metric=self._metric)

    def estimate_focal(self, view: View) -> float | None:
        """Estimate the horizontal focal length in pixels with Depth Pro, else return None."""
        if not self._by_focal:
            return None
        angle = self._run(view)[1]
        if angle is None:
            return None
        return 0.5 * view.camera.width / float(np.tan(0.5 * np.radians(angle)))

    def _run(self, view: View) -> tuple[Float32, float | None]:
        """Return the network's depth map, and its predicted angle of view in degrees, if any."""
        prepared = self._preparation(view)
        with inference():
            prediction = self._model.network(pixel_values=prepared.pixels.to(self._model.device))
        angle = getattr(prediction, "field_of_view", None)
        value = prepared.cut(prediction.predicted_depth[0].float().cpu().numpy())
        return value, None if angle is None else float(angle.reshape(-1)[0])


class PromptDepth:
    """Provider of sensor depth that Prompt Depth Anything refines by the image."""

    def __init__(self, options: PromptOptions, context: ProviderContext) -> None:
        self._model = LoadedModel(AutoModelForDepthEstimation, options, context)
        family = self._model.network.config.model_type
        if family != _PROMPTED:
            raise ConfigError(
                f"the model {options.model} is of the family {family!r}, not {_PROMPTED!r}"
            )
        files = DepthFileOptions(
            directory=options.directory,
            suffix=options.suffix,
            scale=options.scale,
            relative_std=1.0,  # provider ``files`` requires a std, not used here
        )
        self._sensor = DepthFiles(files, context)
        self._preparation: Preparation = preparation_for(self._model)

    def predict(self, view: View) -> DepthPrior:
        """Predict metric depth, with only invalid pixels if the view has no sensor depth."""
        sensor = self._sensor.predict(view)
        if not sensor.valid.any():
            return sensor
        prompt = torch.from_numpy(_without_holes(sensor))[None, None].to(self._model.device)
        prepared = self._preparation(view)
        pixels = prepared.pixels.to(self._model.device)
        with inference():
            prediction = self._model.network(pixel_values=pixels, prompt_depth=prompt)
        return DepthPrior.from_arrays(prepared.cut(prediction.predicted_depth[0].cpu().numpy()))


def resolve_output(config: Any, options: DepthOptions) -> tuple[Output, bool]:
    """Return whether a model predicts depth or disparity, and True if its depth is metric.

    The options of the user have priority over the table of known models, and the table over the
    model configuration.

    Raises:
        ConfigError: The model does not predict depth.
    """
    family = config.model_type
    if family == "chmv2":
        raise ConfigError(f"the model {options.model} predicts the height of trees, not depth")
    metric = family in _METRIC or family == "depth_pro"
    if family == "depth_anything":
        metric = config.depth_estimation_type == "metric"
    output: Output = "depth" if metric and family != "depth_pro" else "disparity"
    entry = look_up_model(options.model)
    sources = [(entry.output, entry.metric), (options.output, options.metric)]
    for said_output, said_metric in sources:
        output = said_output or output
        metric = metric if said_metric is None else said_metric
    return output, metric


def _inverse(inverse: Float64, metric: bool, smallest: float = 0.0) -> DepthPrior:
    with np.errstate(divide="ignore"):
        depth = np.where(inverse > smallest, 1 / inverse, 0)
    return DepthPrior.from_arrays(depth, metric=metric)


def _without_holes(sensor: DepthPrior) -> Float32:
    """Fill invalid pixels with the nearest valid depth, and avoid a constant depth map."""
    nearest = distance_transform_edt(~sensor.valid, return_distances=False, return_indices=True)
    filled: Float32 = sensor.depth[tuple(nearest)]
    if filled.min() == filled.max():
        filled[0, 0] += np.float32(_NO_SPREAD_M)
    return filled
