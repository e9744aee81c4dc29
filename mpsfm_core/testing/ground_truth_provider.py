"""Providers that know the truth: what a wrapper under test is put around."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import MappingProxyType

import numpy as np

from mpsfm_core.data import Bool, DepthPrior, Float64, NormalPrior, View
from mpsfm_core.data.options import Options
from mpsfm_core.providers import Kind, ProviderContext, ProviderSpec
from mpsfm_core.testing.examples import Example
from mpsfm_core.testing.painted_views import NORMALS_STD, RELATIVE_STD, read_depth, read_normals


class GroundTruthOptions(Options):
    """What the wrapped provider is like."""

    variance: bool = True
    """Whether it gives a variance."""
    metric: bool = True
    """Whether its depth is called metric."""
    scale: float = 1.0
    """Of its depth."""


class GroundTruth:
    """Knows the examples it was told, their mirror images, and what is painted in any other view
    (a wrapper may cut, turn or blur what it was given)."""

    def __init__(self) -> None:
        self.given_depth: list[DepthPrior | None] = []
        """The depth that came with each question about normals."""
        self._examples: list[Example] = []

    def add_example(self, example: Example) -> None:
        """Learn the truth about an example."""
        self._examples.append(example)

    def factory(self, kind: Kind) -> Callable[[GroundTruthOptions, ProviderContext], object]:
        """The factory of a provider of this kind that asks this oracle."""
        make = GroundTruthDepth if kind == "depth" else GroundTruthNormals
        return lambda options, context: make(self, options)

    def answer(self, view: View) -> tuple[Float64, Float64, Bool]:
        """Depth (H, W), normals (H, W, 3) and where there is a surface."""
        example = self._recognised(view)
        if example is not None:
            truth = example.truth()
            return truth.depth, truth.normals, truth.valid
        depth = read_depth(view.image)
        return depth, read_normals(view.image), depth > 0

    def _recognised(self, view: View) -> Example | None:
        for example in reversed(self._examples):
            image = example.view.image
            if image.shape == view.image.shape:
                if np.array_equal(image, view.image):
                    return example
                if np.array_equal(image[:, ::-1], view.image):
                    return example.mirror()
        return None


class GroundTruthDepth:
    """Depth of the oracle."""

    def __init__(self, oracle: GroundTruth, options: GroundTruthOptions) -> None:
        self._oracle = oracle
        self._options = options

    def predict(self, view: View) -> DepthPrior:
        """The exact depth, on the view's grid."""
        depth, _, valid = self._oracle.answer(view)
        depth = self._options.scale * depth
        variance = (RELATIVE_STD * depth) ** 2 if self._options.variance else None
        return DepthPrior.from_arrays(depth, variance, valid, metric=self._options.metric)


class GroundTruthNormals:
    """Normals of the oracle."""

    def __init__(self, oracle: GroundTruth, options: GroundTruthOptions) -> None:
        self._oracle = oracle
        self._options = options

    def predict(self, view: View, depth: DepthPrior | None = None) -> NormalPrior:
        """The exact normals, on the view's grid."""
        self._oracle.given_depth.append(depth)
        _, normals, valid = self._oracle.answer(view)
        variance = np.full(valid.shape, NORMALS_STD**2) if self._options.variance else None
        return NormalPrior.from_arrays(normals, variance, valid, camera=view.camera)


def _spec(kind: Kind, factory: type) -> ProviderSpec:
    return ProviderSpec(kind, "oracle", f"{__name__}:{factory.__name__}", GroundTruthOptions)


GROUND_TRUTH_SPECS: Mapping[Kind, ProviderSpec] = MappingProxyType(
    {"depth": _spec("depth", GroundTruthDepth), "normals": _spec("normals", GroundTruthNormals)}
)
"""The specifications; a factory that asks an oracle takes the place of theirs."""
