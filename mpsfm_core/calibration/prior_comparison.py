"""Comparison of a provider's depth or normal priors with ground truth on all images."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeVar

import numpy as np

from mpsfm_core.calibration.cross_validation import CalibrationData, StudyOptions
from mpsfm_core.calibration.file_truth import FileTruth
from mpsfm_core.calibration.model_selection import Alignment, DepthData, NormalData
from mpsfm_core.calibration.model_truth import sample_evenly
from mpsfm_core.calibration.samples import (
    MIN_SAMPLES,
    DepthSamples,
    DepthTruth,
    NormalSamples,
    compare_depth,
    compare_normals,
)
from mpsfm_core.data import NormalPrior
from mpsfm_core.data.errors import InputError
from mpsfm_core.extraction.active_provider import ActiveProvider
from mpsfm_core.extraction.context import ExtractionContext
from mpsfm_core.extraction.priors.raw_priors import RawPriors
from mpsfm_core.providers.uncertainty.calibration import DepthCalibration
from mpsfm_core.providers.uncertainty.calibration_file import CalibratedKind

Samples = TypeVar("Samples", DepthSamples, NormalSamples)

ALL_ALIGNMENTS: tuple[Alignment, ...] = ("scale", "scale-shift", "disparity")
"""Candidate alignments to true depth, for depth priors that are not metric."""

SAMPLES_PER_IMAGE = 500
"""Maximum number of pixels sampled per image from true maps, whose errors are correlated. [ours]"""


class PriorComparison:
    """Comparison of depth or normal priors with ground truth.

    Args:
        context: Extraction context.
        kind: Kind of the prior, depth or normals.
        alignments: Candidate alignments of prior depth to true depth, or None for the default of
            the provider.
        options: Options of pixel sampling, cross-validation and bootstrap.
    """

    def __init__(
        self,
        context: ExtractionContext,
        kind: CalibratedKind,
        alignments: Sequence[Alignment] | None,
        options: StudyOptions,
    ) -> None:
        self._context = context
        self._kind = kind
        self._alignments = alignments
        self._options = options
        self._raw = RawPriors(context)

    @property
    def provider(self) -> ActiveProvider:
        """Provider whose depth or normal priors are compared."""
        return (self._kind == "normals" and self._raw.normals) or self._raw.depth

    def with_files(self, options: Mapping[str, Any]) -> CalibrationData:
        """Compare the priors with true maps; images without a true map file are omitted.

        Args:
            options: Options of the provider ``files``, which reads the true maps.

        Raises:
            InputError: No image has a true map file with enough valid pixels.
        """
        truth = FileTruth(self._context, self._kind, options, SAMPLES_PER_IMAGE, self._options.seed)
        known = [i for i in range(len(self._context.images)) if truth.has(self._context.view(i))]
        if not known:
            raise InputError(
                f"{options['directory']} has no file for any of the images; "
                "files must be named like the images"
            )
        if self._kind == "normals":
            return NormalData(self._compare(known, lambda i: self._normals(i, truth)))

        def depth(index: int) -> DepthSamples | None:
            return self._depth(index, truth.depth(self._context.view(index), index))

        return self._depth_data(self._compare(known, depth), in_meters=True)

    def with_points(self, truth: Mapping[str, DepthTruth]) -> CalibrationData:
        """Compare depth priors with true depth at points, sampled uniformly over the image.

        Args:
            truth: True depth at points by image name, in any unit.

        Raises:
            InputError: No image has enough points with valid prior depth.
        """
        names = self._context.images.names
        points = {i: truth[name] for i, name in enumerate(names) if name in truth}
        known = [i for i, found in points.items() if len(found.xy) >= MIN_SAMPLES]

        def depth(index: int) -> DepthSamples | None:
            size = self._context.images[index].pinhole.size
            rng = np.random.default_rng([self._options.seed, index])
            even = sample_evenly(points[index], size, SAMPLES_PER_IMAGE, rng)
            return self._depth(index, even)

        return self._depth_data(self._compare(known, depth), in_meters=False)

    def _compare(
        self, images: Sequence[int], compare: Callable[[int], Samples | None]
    ) -> tuple[Samples, ...]:
        compared = self._context.each("comparison", images, compare, self.provider)
        samples = tuple(image for image in compared if image is not None)
        if not samples:
            raise InputError(
                f"none of {len(images)} images has {MIN_SAMPLES} pixels where both the prior and "
                f"the truth are valid"
            )
        return samples

    def _depth_data(self, samples: tuple[DepthSamples, ...], *, in_meters: bool) -> DepthData:
        usual = ("scale",) if samples[0].metric else ALL_ALIGNMENTS
        return DepthData(samples, tuple(self._alignments or usual), in_meters)

    def _depth(self, index: int, truth: DepthTruth) -> DepthSamples | None:
        image = self._context.images[index]
        return compare_depth(image.name, self._raw.predict(index)[0], image.pinhole.size, truth)

    def _normals(self, index: int, truth: FileTruth) -> NormalSamples | None:
        image = self._context.images[index]
        known = truth.normals(self._context.view(index), index)
        return compare_normals(
            image.name, self._predicted_normals(index), image.pinhole.size, known
        )

    def _predicted_normals(self, index: int) -> NormalPrior:
        provider = self._raw.normals
        if provider is not None and not provider.can("needs-depth"):
            return self._raw.predict_normals(index, None)
        depth, normals = self._raw.predict(index)
        if normals is not None:
            return normals
        calibration = self._context.registry.calibration("depth", self._context.config.depth)
        assert isinstance(calibration, DepthCalibration)
        return self._raw.predict_normals(index, calibration.apply(depth))
