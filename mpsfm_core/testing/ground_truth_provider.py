"""Depth and normals providers that return the ground truth, for tests of wrappers."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import MappingProxyType

import numpy as np

from mpsfm_core.data import Bool, DepthPrior, Float64, NormalPrior, View
from mpsfm_core.data.options import Options
from mpsfm_core.geometry import pixel_centers
from mpsfm_core.providers import Kind, ProviderContext, ProviderSpec
from mpsfm_core.testing.examples import Example
from mpsfm_core.testing.painted_views import RELATIVE_STD, read_depth, read_normals


class GroundTruthOptions(Options):
    """Options of the ground-truth provider that a wrapper under test wraps."""

    variance: bool = True
    """True if the returned depth and normals have a variance."""
    metric: bool = True
    """True if the returned depth has the flag ``metric``."""
    scale: float = 1.0
    """Factor by which the true depth is multiplied."""
    mirrored_hole: bool = False
    """True if the maps of mirrored views have no value in the left third, as networks reject other
    pixels of a mirrored view."""
    reduction: int = 1
    """Factor by which the returned depth or normal map is smaller than the view."""


class GroundTruth:
    """Ground truth of synthetic views and of all views whose colors encode depth and normals.

    Known synthetic views and their mirror images are recognized by their pixels. Depth and normals
    of any other view, for instance a crop made by a wrapper, are decoded from colors that encode
    them.
    """

    def __init__(self) -> None:
        self.received_depth: list[bool] = []
        """One value per call of the normals provider, True if the call received a depth prior."""
        self.wrong_inputs: list[str] = []
        """Errors of the cameras and depth priors that the wrapper passed to the provider."""
        self._examples: list[Example] = []

    def add_example(self, example: Example) -> None:
        """Add a synthetic view, which is recognized by its pixels from then on."""
        self._examples.append(example)

    def factory(self, kind: Kind) -> Callable[[GroundTruthOptions, ProviderContext], object]:
        """Return the factory of a depth or normals provider with this ground truth."""
        make = GroundTruthDepth if kind == "depth" else GroundTruthNormals
        return lambda options, context: make(self, options)

    def predict(
        self, view: View, options: GroundTruthOptions
    ) -> tuple[Float64, Float64, Bool, Float64]:
        """Return depth (h, w), normals (h, w, 3), validity and relative std (h, w) of a view."""
        example = self._recognize(view)
        if example is not None:
            if example.camera != view.camera:
                self.wrong_inputs.append(
                    f"the camera of {example.name!r}: {view.camera} instead of {example.camera}"
                )
            shape = tuple(-(-side // options.reduction) for side in view.image.shape[:2])
            truth = example.truth((shape[0], shape[1]))
            spread = relative_std(truth.valid.shape, mirrored=example.mirrored)
            valid = truth.valid.copy()
            if example.mirrored and options.mirrored_hole:
                valid[:, : valid.shape[1] // 3] = False
            depth, normals = truth.depth * valid, truth.normals * valid[..., None]
            return depth, normals, valid, spread
        depth = read_depth(view.image)
        spread = np.full(depth.shape, RELATIVE_STD)
        return depth, read_normals(view.image), depth > 0, spread

    def receive_depth(self, view: View, depth: DepthPrior | None) -> None:
        """Record the depth prior that a wrapper passes to its normals provider."""
        self.received_depth.append(depth is not None)
        example = self._recognize(view)
        if depth is None or example is None:
            return
        truth = example.truth(depth.shape)
        where = truth.smooth & depth.valid
        if where.any() and np.median(abs(depth.depth[where] / truth.depth[where] - 1)) > 0.02:
            self.wrong_inputs.append(f"the depth of another view for {example.name!r}")

    def _recognize(self, view: View) -> Example | None:
        for example in reversed(self._examples):
            image = example.view.image
            if image.shape == view.image.shape:
                if np.array_equal(image, view.image):
                    return example
                if np.array_equal(image[:, ::-1], view.image):
                    return example.mirror()
        return None


def relative_std(shape: tuple[int, int], *, mirrored: bool = False) -> Float64:
    """Return relative standard deviations (h, w) from 0.02 to 0.1 without any symmetry."""
    x, y = np.moveaxis(pixel_centers(shape[1], shape[0]) / (shape[1], shape[0]), -1, 0)
    x = 1 - x if mirrored else x
    spread: Float64 = 0.02 + 0.08 * np.clip(0.75 * x + 0.25 * y, 0, 1)
    return spread


class GroundTruthDepth:
    """Depth provider that returns the ground truth on the pixel grid of the view."""

    def __init__(self, ground_truth: GroundTruth, options: GroundTruthOptions) -> None:
        self._ground_truth = ground_truth
        self._options = options

    def predict(self, view: View) -> DepthPrior:
        """Return the true depth of a view."""
        depth, _, valid, spread = self._ground_truth.predict(view, self._options)
        depth = self._options.scale * depth
        variance = (spread * depth) ** 2 if self._options.variance else None
        return DepthPrior.from_arrays(depth, variance, valid, metric=self._options.metric)


class GroundTruthNormals:
    """Normals provider that returns the ground truth on the pixel grid of the view."""

    def __init__(self, ground_truth: GroundTruth, options: GroundTruthOptions) -> None:
        self._ground_truth = ground_truth
        self._options = options

    def predict(self, view: View, depth: DepthPrior | None = None) -> NormalPrior:
        """Return the true normals of a view and record the received depth prior."""
        self._ground_truth.receive_depth(view, depth)
        _, normals, valid, spread = self._ground_truth.predict(view, self._options)
        variance = (2 * spread) ** 2 if self._options.variance else None
        return NormalPrior.from_arrays(normals, variance, valid, camera=view.camera)


def _make_spec(kind: Kind, factory: type) -> ProviderSpec:
    reference = f"{__name__}:{factory.__name__}"
    return ProviderSpec(kind, "ground-truth", reference, GroundTruthOptions)


GROUND_TRUTH_SPECS: Mapping[Kind, ProviderSpec] = MappingProxyType(
    {
        "depth": _make_spec("depth", GroundTruthDepth),
        "normals": _make_spec("normals", GroundTruthNormals),
    }
)
"""Specifications by kind. The contract tests replace the factory of the ground-truth provider by
:meth:`GroundTruth.factory`."""
