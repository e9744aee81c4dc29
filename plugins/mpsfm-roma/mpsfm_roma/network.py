"""RoMa's network, which predicts a dense warp between two views."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any

import numpy as np
from mpsfm_onnx.canvas import Canvas
from mpsfm_onnx.description import FixedSize, ImageInput
from mpsfm_onnx.model import Model
from numpy.typing import NDArray

from mpsfm_core import ProviderContext, View
from mpsfm_core.data import Bool, Float32, Float64, Int64
from mpsfm_core.geometry import sample_bilinear, scale_pixels
from mpsfm_roma.options import RomaOptions


@dataclass(frozen=True)
class Warp:
    """Dense warp: the positions of the pixels of one view in the other view.

    ``size`` is the ``(width, height)`` of the first view, which the (h, w) grid of the warp covers.
    ``target`` (h, w, 2) are positions in pixels of the second view. ``certainty`` (h, w) is in [0,
    1], and 0 if the target is outside of the second view.
    """

    size: tuple[int, int]
    target: Float64
    certainty: Float32

    def source(self, rows: Int64, columns: Int64) -> Float64:
        """Convert rows and columns of the warp to pixels (n, 2) of the first view."""
        height, width = self.certainty.shape
        xy = np.stack([columns, rows], axis=-1).astype(np.float64) + 0.5
        return scale_pixels(xy, (width, height), self.size)

    def at(self, xy: Float64) -> tuple[Float64, Float64]:
        """Interpolate warp targets (n, 2) and certainty (n,) at pixels (n, 2) of the first view."""
        height, width = self.certainty.shape
        grid = scale_pixels(xy, self.size, (width, height))
        everywhere: Bool = np.ones((height, width), dtype=np.bool_)
        planes = (self.target[..., 0], self.target[..., 1], self.certainty)
        x, y, certainty = (sample_bilinear(plane, everywhere, grid)[0] for plane in planes)
        return np.stack([x, y], axis=-1), certainty


class WarpNetwork(ABC):
    """Interface of RoMa networks, in an ONNX file or in torch."""

    @abstractmethod
    def answer(self, view_a: View, view_b: View) -> tuple[NDArray[Any], NDArray[Any], bool]:
        """Run the network on two images, like RoMa's function ``match``.

        Returns:
            The warp (h, w, 4), its certainty (h, w), and True if the warp is symmetric. The warp
            has positions ``x_a, y_a, x_b, y_b`` in [-1, 1], where ``x_a, y_a`` are on a regular
            grid. A symmetric warp also has the warp of the second view in its right half, where
            ``x_b, y_b`` are on a regular grid.
        """

    def warps(self, view_a: View, view_b: View) -> tuple[Warp, Warp | None]:
        """Compute the warp from view a to b and, for a symmetric model, from view b to a."""
        warp, certainty, symmetric = self.answer(view_a, view_b)
        half = warp.shape[1] // 2 if symmetric else warp.shape[1]
        there = _warp(view_a, view_b, warp[:, :half, 2:], certainty[:, :half])
        if not symmetric:
            return there, None
        return there, _warp(view_b, view_a, warp[:, half:, :2], certainty[:, half:])


class OnnxWarpNetwork(WarpNetwork):
    """RoMa network in an ONNX file.

    The inputs are two images (1, 3, height, width), normalized by the mean and std of ImageNet. The
    outputs are warp and
        certainty, with or without a batch dimension.
    """

    def __init__(self, options: RomaOptions, context: ProviderContext) -> None:
        self._model = Model(context.resolve_weights(options.model, options.sha256), context)
        self._model.require(options.inputs, options.outputs, "RoMa")
        self._inputs, self._outputs = options.inputs, options.outputs
        self._rule = ImageInput(
            scale=1 / 255,
            mean=(0.485, 0.456, 0.406),
            std=(0.229, 0.224, 0.225),
            interpolation="smooth-cubic",
            size=FixedSize(mode="fixed", width=options.width, height=options.height),
        )

    def answer(self, view_a: View, view_b: View) -> tuple[NDArray[Any], NDArray[Any], bool]:
        """Run RoMa's ONNX model, see :class:`WarpNetwork`."""
        images = (
            Canvas.plan(self._rule.size, v.camera.size).paint(v.image, self._rule)
            for v in (view_a, view_b)
        )
        feed = dict(zip(self._inputs, images, strict=True))
        warp, certainty = (np.squeeze(t) for t in self._model.run(feed, self._outputs))
        size = self._rule.size
        assert isinstance(size, FixedSize)
        return warp, certainty, warp.shape[1] * size.height == 2 * warp.shape[0] * size.width


def _warp(view: View, other: View, target: Float32, certainty: Float32) -> Warp:
    inside = (np.abs(target) <= 1).all(axis=-1)
    xy = (np.clip(target, -1, 1).astype(np.float64) + 1) / 2 * other.camera.size
    sure = np.where(inside, np.clip(certainty, 0, 1), 0).astype(np.float32)
    return Warp(view.camera.size, xy, sure)
