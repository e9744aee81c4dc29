"""Depth and normals as the chosen providers give them, before calibration; cached."""

from __future__ import annotations

from typing import Any

from mpsfm_core.data import DepthPrior, NormalPrior
from mpsfm_core.extraction.active_provider import ActiveProvider
from mpsfm_core.extraction.cache import digest
from mpsfm_core.extraction.context import ExtractionContext
from mpsfm_core.extraction.empty_results import JointPrior
from mpsfm_core.providers import validation


class RawPriors:
    """Runs the depth and normals providers of a configuration.

    ``depth``, ``normals``: the providers in use; ``normals`` is None when one pass of the depth
    provider gives both.
    """

    def __init__(self, context: ExtractionContext) -> None:
        self._context = context
        self.depth = context.provider("depth", context.config.depth)
        joint = _is_joint(context, self.depth)
        self.normals = None if joint else context.provider("normals", context.config.normals)

    def predict(self, index: int) -> tuple[DepthPrior, NormalPrior | None]:
        """Depth of an image, and its normals if they come along."""
        provider, context = self.depth, self._context
        inputs = context.view_inputs(index, provider)
        if self.normals is None:

            def compute_both(instance: Any) -> JointPrior:
                return JointPrior(*validation.run_joint(provider.spec, instance, context.view(index)))

            both = context.result(provider, JointPrior, ["joint", *inputs], compute_both, [index])
            return both.depth, both.normals

        def compute(instance: Any) -> DepthPrior:
            return validation.run_depth(provider.spec, instance, context.view(index))

        return context.result(provider, DepthPrior, inputs, compute, [index]), None

    def predict_normals(self, index: int, depth: DepthPrior | None) -> NormalPrior:
        """Normals of an image by the normals provider; ``depth``: its calibrated depth, which a
        provider that does not say ``needs-depth`` does without."""
        provider, context = self.normals, self._context
        assert provider is not None
        inputs = context.view_inputs(index, provider)
        if provider.can("needs-depth"):
            inputs.append(digest(depth))

        def compute(instance: Any) -> NormalPrior:
            return validation.run_normals(provider.spec, instance, context.view(index), depth)

        return context.result(provider, NormalPrior, inputs, compute, [index])


def _is_joint(context: ExtractionContext, depth: ActiveProvider) -> bool:
    """Whether one pass of the depth provider gives the normals too."""
    wanted, normals = context.config.depth, context.config.normals
    same = (wanted.use, wanted.options) == (normals.use, normals.options)
    return depth.can("joint-normals") and same and not wanted.wrap and not normals.wrap
