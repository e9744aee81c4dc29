"""Prediction, calibration, resizing and masking of the depth and normal maps of the mapper."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from mpsfm_core.config import Config
from mpsfm_core.data import DepthPrior, NormalPrior
from mpsfm_core.data.errors import ConfigError
from mpsfm_core.extraction.cache import cache_folder
from mpsfm_core.extraction.context import ExtractionContext
from mpsfm_core.extraction.matching.pair_matching import CandidateMatches, PairMatcher
from mpsfm_core.extraction.priors import prior_maps as priors
from mpsfm_core.extraction.priors.multiview import GroupPriors
from mpsfm_core.extraction.priors.raw_priors import RawPriors
from mpsfm_core.providers import Kind
from mpsfm_core.providers.provider_config import FROM_MATCHER, FROM_MULTIVIEW
from mpsfm_core.providers.registry import Registry
from mpsfm_core.providers.uncertainty.calibration import DepthCalibration, NormalCalibration
from mpsfm_core.support.disk_arrays import DiskArrays, store_fields


class PriorPredictor:
    """Runs the depth and normals providers; calibrates, resizes and masks their maps.

    Args:
        context: Context of the extraction with images, options and progress.
        matcher: Matcher that predicts depth, used if the setting ``depth.use`` is ``matcher``.
        candidates: Candidate matches, from which the pair with the best depth of each image is
            chosen.
        groups: Predictions of the multi-view network, for ``depth.use: multiview``.
    """

    def __init__(
        self,
        context: ExtractionContext,
        matcher: PairMatcher | None,
        candidates: list[CandidateMatches],
        groups: GroupPriors | None = None,
    ) -> None:
        self._context = context
        self._matcher = matcher
        self._groups = groups if context.config.depth.use == FROM_MULTIVIEW else None
        config, registry = context.config, context.registry
        self._raw = RawPriors(context)
        depth_calibration = _depth_calibration(config, registry)
        normal_calibration = registry.calibration("normals", config.normals)
        assert isinstance(normal_calibration, NormalCalibration)
        self._depth_calibration = depth_calibration
        self._normal_calibration = normal_calibration
        self._disk = DiskArrays(cache_folder(config.runtime.cache_dir))
        self._best = _best_pairs(candidates) if config.depth.use == FROM_MATCHER else None

    @property
    def follows_focal(self) -> bool:
        """True if the network uses the focal length, to which its metric depth is proportional."""
        return self._raw.depth.can("intrinsics-aware")

    def run(self, originals: Mapping[int, int]) -> list[tuple[DepthPrior, NormalPrior]]:
        """Compute depth and normals of each image on the mapper's grid, with variances.

        The maps of many images are in temporary files of the cache folder.

        Args:
            originals: Index of the original image by index of the duplicate, which has the maps of
                its original.
        """
        count = len(self._context.images)
        images = [image for image in range(count) if image not in originals]
        depth = self._raw.depth
        if not depth.can("uncached"):
            self._context.each("depth", images, self._predict_only, depth)
        slowest = self._raw.normals or depth
        local = self._best is not None or self._groups is not None
        maps = self._context.each("normals", images, self._prepare_maps, slowest, local=local)
        maps_of = dict(zip(images, maps, strict=True))
        return [maps_of[originals.get(image, image)] for image in range(count)]

    def _predict_only(self, index: int) -> None:
        """Predict depth into the disk cache, because full-size maps may exceed the memory."""
        self.predicted(index)

    def _prepare_maps(self, index: int) -> tuple[DepthPrior, NormalPrior]:
        raw_depth, raw_normals = self.full_size(index)
        raw_normals = self._normal_calibration.apply(raw_normals)
        depth, normals = self._on_grid(index, raw_depth, raw_normals)
        return store_fields(depth, self._disk.store), store_fields(normals, self._disk.store)

    def full_size(self, index: int) -> tuple[DepthPrior, NormalPrior]:
        """Return full-size calibrated depth and uncalibrated normals of an image from the cache."""
        raw_depth, normals = self.predicted(index)
        depth = self._depth_calibration.apply(raw_depth)
        return depth, self._raw.predict_normals(index, depth) if normals is None else normals

    def predicted(self, index: int) -> tuple[DepthPrior, NormalPrior | None]:
        """Return uncalibrated depth (and normals if the network predicts both) from the cache."""
        if self._groups is not None:
            return self._groups.depth(index), None
        if self._best is not None:
            return self._from_matcher(index), None
        return self._raw.predict(index)

    def _from_matcher(self, index: int) -> DepthPrior:
        """Return the matcher's most precise depth of an image; an empty prior if unmatched."""
        assert self._best is not None and self._matcher is not None
        if index not in self._best:
            empty = np.zeros((1, 1), dtype=np.float32)
            return DepthPrior(empty, empty, np.zeros((1, 1), dtype=np.bool_))
        candidates, side = self._best[index]
        return self._matcher.pair_depth(candidates.pair, side)

    def _on_grid(
        self, index: int, depth: DepthPrior, normals: NormalPrior
    ) -> tuple[DepthPrior, NormalPrior]:
        size = self._context.images[index].pinhole.size
        mask, options = self._context.mask(index), self._context.config.extraction
        return priors.fit_to_grid(depth, normals, size, mask, options)


def _depth_calibration(config: Config, registry: Registry) -> DepthCalibration:
    """Return the depth calibration of the configuration, or of the network that predicts depth."""
    kind: Kind = "depth"
    backend = config.depth
    if backend.use == FROM_MULTIVIEW and config.multiview and backend.calibration is None:
        kind, backend = "multiview", config.multiview
    calibration = registry.calibration(kind, backend)
    assert isinstance(calibration, DepthCalibration)
    return calibration


def check_depth_source(config: Config, registry: Registry) -> None:
    """Raise ConfigError if ``depth.use`` is ``matcher`` and no matcher predicts depth."""
    chosen = [b for b in (config.matcher, config.dense_matcher) if b is not None]
    specs = [registry.spec("matcher", backend.use) for backend in chosen]
    predicts_depth = any("pair-depth" in spec.capabilities for spec in specs)
    if config.depth.use == FROM_MATCHER and not predicts_depth:
        names = ", ".join(repr(spec.name) for spec in specs)
        raise ConfigError(f"depth.use: 'matcher': {names} predicts no depth (pair-depth)")


def _best_pairs(candidates: list[CandidateMatches]) -> dict[int, tuple[CandidateMatches, int]]:
    """Return the pair with the most precise depth of each image, and whether it is image 0 or 1."""
    best: dict[int, tuple[float, CandidateMatches, int]] = {}
    for matches in candidates:
        for side, image in enumerate(matches.pair):
            precision = matches.precision[side]
            if precision > 0 and (image not in best or precision > best[image][0]):
                best[image] = (precision, matches, side)
    return {image: (matches, side) for image, (_, matches, side) in best.items()}
