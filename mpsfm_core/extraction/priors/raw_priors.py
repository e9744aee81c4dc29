"""Prediction and caching of uncalibrated depth and normals."""

from __future__ import annotations

from typing import Any

from mpsfm_core.data import DepthPrior, NormalPrior
from mpsfm_core.extraction.active_provider import ActiveProvider
from mpsfm_core.extraction.cache import digest
from mpsfm_core.extraction.context import ExtractionContext
from mpsfm_core.extraction.empty_results import JointPrior
from mpsfm_core.providers.kinds.depth import run_depth, run_joint
from mpsfm_core.providers.kinds.normals import run_normals


class RawPriors:
    """Runs the depth and normals providers of a configuration.

    Attributes:
        depth: Provider of depth.
        normals: Provider of normals, or None if the depth provider predicts both in one pass.
    """

    def __init__(self, context: ExtractionContext) -> None:
        self._context = context
        self.depth = context.provider("depth", context.config.depth)
        joint = _is_joint(context, self.depth)
        self.normals = None if joint else context.provider("normals", context.config.normals)

    def predict(self, index: int) -> tuple[DepthPrior, NormalPrior | None]:
        """Predict depth of an image, and normals if the depth provider predicts both."""
        provider, context = self.depth, self._context
        inputs = context.view_inputs(index, provider)
        if self.normals is None:

            def compute_both(instance: Any) -> JointPrior:
                return JointPrior(*run_joint(provider.spec, instance, context.view(index)))

            both = context.result(provider, JointPrior, ["joint", *inputs], compute_both, [index])
            return both.depth, both.normals

        def compute(instance: Any) -> DepthPrior:
            return run_depth(provider.spec, instance, context.view(index))

        return context.result(provider, DepthPrior, inputs, compute, [index]), None

    def predict_normals(self, index: int, depth: DepthPrior | None) -> NormalPrior:
        """Predict normals of an image with the normals provider.

        Args:
            index: Index of the image.
            depth: Calibrated depth, for providers with the capability ``needs-depth``.
        """
        provider, context = self.normals, self._context
        assert provider is not None
        inputs = context.view_inputs(index, provider)
        if provider.can("needs-depth"):
            inputs.append(digest(depth))

        def compute(instance: Any) -> NormalPrior:
            return run_normals(provider.spec, instance, context.view(index), depth)

        return context.result(provider, NormalPrior, inputs, compute, [index])


def _is_joint(context: ExtractionContext, depth: ActiveProvider) -> bool:
    """Check whether one forward pass of the depth provider predicts depth and normals."""
    depth_config, normals = context.config.depth, context.config.normals
    same = (depth_config.use, depth_config.options) == (normals.use, normals.options)
    return depth.can("joint-normals") and same and not depth_config.wrap and not normals.wrap
