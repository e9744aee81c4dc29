"""Depth and normals of the images, from their providers to the maps of the mapper."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from mpsfm_core import validation
from mpsfm_core.calibration.model import DepthCalibration, NormalCalibration
from mpsfm_core.data import DepthPrior, NormalPrior
from mpsfm_core.errors import ConfigError
from mpsfm_core.extraction import priors
from mpsfm_core.extraction.backends import ActiveProvider
from mpsfm_core.extraction.cache import digest
from mpsfm_core.extraction.matching import Candidates, PairMatcher
from mpsfm_core.extraction.workbench import Workbench

FROM_MATCHER = "matcher"
"""The depth provider's name that means: take the depth that the matcher predicts."""


@dataclass(frozen=True, eq=False)
class JointPrior:
    """Both priors of one pass of a network."""

    depth: DepthPrior
    normals: NormalPrior


class Predictions:
    """Runs the depth and normals providers; calibrates, resizes and masks what they say."""

    def __init__(
        self, bench: Workbench, matcher: PairMatcher, candidates: list[Candidates]
    ) -> None:
        self._bench = bench
        self._matcher = matcher
        config, registry = bench.config, bench.registry
        self._depth = bench.provider("depth", config.depth)
        self._joint = _is_joint(bench, self._depth)
        self._normals = None if self._joint else bench.provider("normals", config.normals)
        depth_calibration = registry.calibration("depth", config.depth)
        normal_calibration = registry.calibration("normals", config.normals)
        assert isinstance(depth_calibration, DepthCalibration)
        assert isinstance(normal_calibration, NormalCalibration)
        self._depth_calibration = depth_calibration
        self._normal_calibration = normal_calibration
        self._best = _best_pairs(candidates) if config.depth.use == FROM_MATCHER else None

    def run(self) -> list[tuple[DepthPrior, NormalPrior]]:
        """Run the stages; returns both priors of each image on its grid, with variances."""
        images = range(len(self._bench.images))
        if not self._depth.can("uncached") and self._best is None:
            self._bench.each("depth", images, self._predict_only, self._depth.workers)
        slowest = self._normals or self._depth
        return self._bench.each("normals", images, self._both, slowest.workers)

    def _predict_only(self, index: int) -> None:
        """Leaves the result in the cache: full-size maps of all images need not fit in memory."""
        self._predicted(index)

    def _both(self, index: int) -> tuple[DepthPrior, NormalPrior]:
        raw_depth, raw_normals = self._predicted(index)
        depth = self._depth_calibration.apply(raw_depth)
        if self._normals is not None:
            raw_normals = self._predict_normals(self._normals, index, depth)
        assert raw_normals is not None
        return self._on_grid(index, depth, self._normal_calibration.apply(raw_normals))

    def _predicted(self, index: int) -> tuple[DepthPrior, NormalPrior | None]:
        if self._best is not None:
            return self._from_matcher(index), None
        provider, bench = self._depth, self._bench
        inputs = bench.view_inputs(index, provider)
        if self._joint:

            def compute_both(instance: Any) -> JointPrior:
                return JointPrior(*validation.run_joint(provider.spec, instance, bench.view(index)))

            both = bench.result(provider, JointPrior, ["joint", *inputs], compute_both)
            return both.depth, both.normals

        def compute(instance: Any) -> DepthPrior:
            return validation.run_depth(provider.spec, instance, bench.view(index))

        return bench.result(provider, DepthPrior, inputs, compute), None

    def _from_matcher(self, index: int) -> DepthPrior:
        """Depth of the pair whose prediction is most certain; none at all without a pair."""
        assert self._best is not None
        if index not in self._best:
            empty = np.zeros((1, 1), dtype=np.float32)
            return DepthPrior(empty, empty, np.zeros((1, 1), dtype=np.bool_))
        candidates, side = self._best[index]
        return self._matcher.pair_depth(candidates.pair, side)

    def _predict_normals(
        self, provider: ActiveProvider, index: int, depth: DepthPrior
    ) -> NormalPrior:
        bench = self._bench
        inputs = bench.view_inputs(index, provider)
        if provider.can("needs-depth"):
            inputs.append(digest(depth))

        def compute(instance: Any) -> NormalPrior:
            return validation.run_normals(provider.spec, instance, bench.view(index), depth)

        return bench.result(provider, NormalPrior, inputs, compute)

    def _on_grid(
        self, index: int, depth: DepthPrior, normals: NormalPrior
    ) -> tuple[DepthPrior, NormalPrior]:
        options = self._bench.config.extraction
        grid = priors.integration_grid(
            self._bench.images[index].pinhole.size, options.integration_size
        )
        depth, normals = priors.resize_depth(depth, grid), priors.resize_normals(normals, grid)
        mask = self._bench.mask(index)
        if mask is not None:
            allowed = priors.allow_only(mask, grid)
            depth = priors.restrict_depth(depth, allowed)
            normals = priors.restrict_normals(normals, allowed)
        if options.edge_ratio is not None:
            normals = priors.distrust_edges(normals, depth, options.edge_ratio)
        return depth, normals


def _is_joint(bench: Workbench, depth: ActiveProvider) -> bool:
    """Whether one pass of the depth provider gives the normals too."""
    wanted, normals = bench.config.depth, bench.config.normals
    same = (wanted.use, wanted.options) == (normals.use, normals.options)
    return depth.can("joint-normals") and same and not wanted.wrap and not normals.wrap


def _best_pairs(candidates: list[Candidates]) -> dict[int, tuple[Candidates, int]]:
    """For each image the pair, and its place in it, with the highest mean precision."""
    best: dict[int, tuple[float, Candidates, int]] = {}
    for matches in candidates:
        if matches.precision is None:
            raise ConfigError(
                "depth.use: 'matcher' needs a matcher that predicts depth (capability pair-depth)"
            )
        for side, (image, precision) in enumerate(
            zip(matches.pair, matches.precision, strict=True)
        ):
            if image not in best or precision > best[image][0]:
                best[image] = (precision, matches, side)
    return {image: (matches, side) for image, (_, matches, side) in best.items()}
