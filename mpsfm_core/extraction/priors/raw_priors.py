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

    def __init__(self, bench: ExtractionContext) -> None:
        self._bench = bench
        self.depth = bench.provider("depth", bench.config.depth)
        joint = _is_joint(bench, self.depth)
        self.normals = None if joint else bench.provider("normals", bench.config.normals)

    def predict(self, index: int) -> tuple[DepthPrior, NormalPrior | None]:
        """Depth of an image, and its normals if they come along."""
        provider, bench = self.depth, self._bench
        inputs = bench.view_inputs(index, provider)
        if self.normals is None:

            def compute_both(instance: Any) -> JointPrior:
                return JointPrior(*validation.run_joint(provider.spec, instance, bench.view(index)))

            both = bench.result(provider, JointPrior, ["joint", *inputs], compute_both, [index])
            return both.depth, both.normals

        def compute(instance: Any) -> DepthPrior:
            return validation.run_depth(provider.spec, instance, bench.view(index))

        return bench.result(provider, DepthPrior, inputs, compute, [index]), None

    def predict_normals(self, index: int, depth: DepthPrior | None) -> NormalPrior:
        """Normals of an image by the normals provider; ``depth``: its calibrated depth, which a
        provider that does not say ``needs-depth`` does without."""
        provider, bench = self.normals, self._bench
        assert provider is not None
        inputs = bench.view_inputs(index, provider)
        if provider.can("needs-depth"):
            inputs.append(digest(depth))

        def compute(instance: Any) -> NormalPrior:
            return validation.run_normals(provider.spec, instance, bench.view(index), depth)

        return bench.result(provider, NormalPrior, inputs, compute, [index])


def _is_joint(bench: ExtractionContext, depth: ActiveProvider) -> bool:
    """Whether one pass of the depth provider gives the normals too."""
    wanted, normals = bench.config.depth, bench.config.normals
    same = (wanted.use, wanted.options) == (normals.use, normals.options)
    return depth.can("joint-normals") and same and not wanted.wrap and not normals.wrap
