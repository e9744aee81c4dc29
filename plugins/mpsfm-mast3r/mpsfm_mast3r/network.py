"""MASt3R's two-view network, which predicts points, descriptors and confidences."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from mpsfm_onnx.canvas import Canvas
from mpsfm_onnx.description import ImageInput, SideSize
from mpsfm_onnx.model import Model
from numpy.typing import NDArray

from mpsfm_core import DepthPrior, ProviderContext, View
from mpsfm_core.data import Float32, Float64, Int64
from mpsfm_mast3r.options import Mast3rOptions

_PATCH = 16
Tensors = Sequence[NDArray[Any]]
_TENSORS = ("pts3d", "conf", "desc", "desc_conf")


@dataclass(frozen=True)
class ViewOutput:
    """Outputs of MASt3R for one view in one pass, on the network input of size (h, w).

    ``points`` (h, w, 3) are in the camera frame of the first view of the pass, in meters.
    ``certainty`` (h, w) >= 1 is the confidence of ``points``. ``descriptors`` (h * w, d) are unit
    vectors. ``match_certainty`` (h * w,) > 0 is the confidence of ``descriptors``.
    """

    view: View
    canvas: Canvas
    points: Float32
    certainty: Float32
    descriptors: Float32
    match_certainty: Float32

    def depth(self) -> DepthPrior:
        """Return the depth of the first view, which is invalid where the network input crops it.

        The std of depth is ``1 / certainty`` meters [reference].
        """
        z = self.canvas.cut(self.points[..., 2:])[..., 0]
        certainty = self.canvas.cut(self.certainty[..., None])[..., 0]
        return DepthPrior.from_arrays(z, 1 / certainty.astype(np.float64) ** 2)

    def positions(self, cells: Int64) -> Float64:
        """Convert descriptor indices (n,) to pixels (n, 2) of the view."""
        rows, columns = np.divmod(cells, self.canvas.size[0])
        xy = np.stack([columns, rows], axis=-1) + 0.5
        return self.canvas.to_view(xy, self.view.camera.size)

    def cells(self, xy: Float64) -> Int64:
        """Convert pixels (n, 2) of the view to descriptor indices (n,), -1 in cropped borders."""
        placed = np.floor(self.canvas.from_view(xy, self.view.camera.size)).astype(np.int64)
        width, height = self.canvas.size
        inside = ((placed >= 0) & (placed < (width, height))).all(axis=1)
        return np.where(inside, placed[:, 1] * width + placed[:, 0], -1)

    @property
    def pixel_size(self) -> float:
        """Return the longer side of a network input pixel, in pixels of the view."""
        return max(v / i for v, i in zip(self.view.camera.size, self.canvas.image, strict=True))


class PairNetwork(ABC):
    """Interface of MASt3R networks, whose input images have the longer side ``size`` in pixels."""

    def __init__(self, size: int) -> None:
        self._rule = ImageInput(
            scale=1 / 255,
            mean=(0.5, 0.5, 0.5),
            std=(0.5, 0.5, 0.5),
            interpolation="lanczos",
            size=SideSize(mode="longest", side=size, multiple_of=_PATCH, fit="crop"),
        )

    @abstractmethod
    def answer(self, first: Float32, second: Float32) -> tuple[Tensors, Tensors]:
        """Run MASt3R on two RGB images (1, 3, h, w) with values in [-1, 1].

        Returns:
            For each image, points (h, w, 3) in the camera frame of the first image, their
            confidence (h, w), descriptors (h, w, d), and descriptor confidence (h, w).
        """

    def both(
        self, view_a: View, view_b: View
    ) -> tuple[tuple[ViewOutput, ViewOutput], tuple[ViewOutput, ViewOutput]]:
        """Run one pass with view a first and one with view b first, and return all outputs."""
        backward = self._run(view_b, view_a)
        return self._run(view_a, view_b), (backward[1], backward[0])

    def _run(self, first: View, second: View) -> tuple[ViewOutput, ViewOutput]:
        views = (first, second)
        canvases = [Canvas.plan(self._rule.size, view.camera.size) for view in views]
        images = (
            canvas.paint(view.image, self._rule)
            for canvas, view in zip(canvases, views, strict=True)
        )
        outputs = zip(views, canvases, self.answer(*images), strict=True)
        first_output, second_output = (
            _view_output(view, canvas, tensors) for view, canvas, tensors in outputs
        )
        return first_output, second_output


class OnnxPairNetwork(PairNetwork):
    """MASt3R network in an ONNX file.

    The inputs are ``img1`` and ``img2``. The outputs are ``pts3d_1`` (1, h, w, 3), ``conf_1`` (1,
    h, w), ``desc_1`` (1, h, w, d), ``desc_conf_1`` (1, h, w), and ``pts3d_2`` to ``desc_conf_2``
    for the second view.
    """

    def __init__(self, options: Mast3rOptions, context: ProviderContext) -> None:
        super().__init__(options.size)
        self._model = Model(context.resolve_weights(options.model, options.sha256), context)
        self._outputs = [f"{name}_{side}" for side in (1, 2) for name in _TENSORS]
        self._model.require(("img1", "img2"), self._outputs, "MASt3R")

    def answer(self, first: Float32, second: Float32) -> tuple[Tensors, Tensors]:
        """Run MASt3R's ONNX model, see :class:`PairNetwork`."""
        feed = {"img1": first, "img2": second}
        tensors = [tensor[0] for tensor in self._model.run(feed, self._outputs)]
        return tensors[:4], tensors[4:]


def _view_output(view: View, canvas: Canvas, tensors: Tensors) -> ViewOutput:
    points, certainty, descriptors, match_certainty = (t.astype(np.float32) for t in tensors)
    flat = descriptors.reshape(-1, descriptors.shape[-1])
    return ViewOutput(view, canvas, points, certainty, flat, match_certainty.reshape(-1))
