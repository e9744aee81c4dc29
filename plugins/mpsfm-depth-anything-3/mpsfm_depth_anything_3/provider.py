"""Provider that runs the authors' Depth Anything 3 network on groups of images."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from safetensors import SafetensorError
from safetensors.torch import load_model

from mpsfm_core import DepthPrior, MultiViewPrior, ProviderContext, View
from mpsfm_core.data import Float64
from mpsfm_core.data.errors import WeightsError
from mpsfm_core.geometry import resize_map
from mpsfm_core.providers.torch_runtime import inference, use_threads
from mpsfm_depth_anything_3.options import DepthAnything3Options

_PATCH = 14
_MEAN = np.float32([0.485, 0.456, 0.406])
_STD = np.float32([0.229, 0.224, 0.225])
_WARNINGS = 1
"""Log level of the ``depth_anything_3`` package that hides its progress messages."""


class DepthAnything3:
    """Provider of depth in one unit for a group of images, with their poses and intrinsics.

    Images are resized without changing their aspect ratio. The smaller images of a group are padded
    with the mean color on all sides. In contrast, the image loader of Depth Anything 3 crops the
    larger images.
    """

    def __init__(self, options: DepthAnything3Options, context: ProviderContext) -> None:
        use_threads(context)
        self._options = options
        self._device = context.device
        path = context.resolve_weights(options.file, options.sha256)
        self._network = network_of(options.network)
        try:
            load_model(as_published(self._network), path)
        except (SafetensorError, OSError) as error:
            raise WeightsError(f"the file {path} is not a safetensors file: {error}") from error
        except RuntimeError as error:
            reason = str(error).splitlines()[1].strip()
            raise WeightsError(
                f"the weights file {path} does not fit the network {options.network}: {reason}"
            ) from error
        self._network.to(self._device)

    def predict_group(self, views: Sequence[View]) -> MultiViewPrior:
        """Predict depth in one unit, its std, poses and intrinsics for a group of images.

        Args:
            views: The undistorted images that the network processes jointly.

        Returns:
            Depth, std, poses and intrinsics of the group. Depth is in meters for the nested
            network, and in an arbitrary unit for other networks.
        """
        sizes = [_network_size(view, self._options.resize) for view in views]
        width, height = np.max(sizes, axis=0).tolist()
        starts = [((width - w) // 2, (height - h) // 2) for w, h in sizes]
        pixels = np.zeros((len(views), height, width, 3), np.float32)
        for image, view, (left, top), (w, h) in zip(pixels, views, starts, sizes, strict=True):
            rgb = resize_map(view.image, w, h) / np.float32(255)
            image[top : top + h, left : left + w] = (rgb - _MEAN) / _STD
        given = torch.from_numpy(pixels).permute(0, 3, 1, 2)[None].contiguous()
        with inference():
            prediction = self._network(given.to(self._device))
        depth, confidence = (prediction[key][0].cpu().numpy() for key in ("depth", "depth_conf"))
        mean = float(depth.mean())
        metric = bool(prediction.get("is_metric", False))
        priors = []
        for (left, top), (w, h), z, sure in zip(starts, sizes, depth, confidence, strict=True):
            inside = slice(top, top + h), slice(left, left + w)
            std = self._options.relative_std * mean / sure[inside]
            priors.append(DepthPrior.from_arrays(z[inside], std**2, metric=metric))
        return MultiViewPrior(
            tuple(priors),
            prediction["extrinsics"][0, :, :3].double().cpu().numpy(),
            _intrinsics(prediction["intrinsics"][0].double().cpu().numpy(), views, starts, sizes),
        )


def network_of(name: str) -> Any:
    """Create the network ``name`` from the configuration files of ``depth_anything_3``."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # hide deprecation warnings of omegaconf and torch
        from depth_anything_3.cfg import create_object, load_config
        from depth_anything_3.registry import MODEL_REGISTRY
        from depth_anything_3.utils.logger import logger

        logger.level = _WARNINGS  # ``depth_anything_3`` would print its progress to the terminal
        return create_object(load_config(MODEL_REGISTRY[name])).eval()


def as_published(network: Any) -> torch.nn.Module:
    """Return the Depth Anything 3 network with the tensor names of its published weights.

    If several parts of the network share a tensor, the weights file contains the tensor only once.
    """
    return torch.nn.ModuleDict({"model": network})


def _network_size(view: View, longest: int) -> tuple[int, int]:
    """Compute the input size ``(width, height)`` in patches from the aspect ratio of the view."""
    scale = longest / max(view.camera.size)
    width, height = (max(1, round(side * scale / _PATCH)) for side in view.camera.size)
    return width * _PATCH, height * _PATCH


def _intrinsics(
    matrices: Float64,
    views: Sequence[View],
    starts: Sequence[tuple[int, int]],
    sizes: Sequence[tuple[int, int]],
) -> Float64:
    """Convert K (n, 3, 3) in pixels of the network input to (fx, fy, cx, cy) of the views."""
    scale = np.array([view.camera.size for view in views]) / np.array(sizes)
    focal = matrices[:, [0, 1], [0, 1]] * scale
    center = (matrices[:, :2, 2] - np.array(starts)) * scale
    return np.concatenate([focal, center], axis=1)
