"""Calibration of a provider on a folder of images.

The ground truth is a folder of true maps, the points of a COLMAP model, or a reconstruction of the
images.

The module :mod:`mpsfm_core.providers.uncertainty.calibration` defines the calibration model.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime, timezone
from pathlib import Path, PurePath
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from mpsfm_core.calibration.cross_validation import (
    CalibrationData,
    CalibrationStudy,
    StudyOptions,
    run_study,
)
from mpsfm_core.calibration.model_selection import Alignment, round_significant, std_of
from mpsfm_core.calibration.model_truth import depth_truth_from_model
from mpsfm_core.calibration.prior_comparison import PriorComparison
from mpsfm_core.calibration.samples import DepthTruth
from mpsfm_core.config import Config
from mpsfm_core.data.errors import InputError
from mpsfm_core.extraction.active_provider import ActiveProvider, thread_count
from mpsfm_core.extraction.context import ExtractionContext
from mpsfm_core.inputs.images import load_images
from mpsfm_core.inputs.models import read_model
from mpsfm_core.pipeline.provider_resolution import resolve_providers
from mpsfm_core.pipeline.run import reconstruct
from mpsfm_core.pipeline.stages import Stages
from mpsfm_core.providers.provider_config import ProviderConfig
from mpsfm_core.providers.registry import Registry, core_version
from mpsfm_core.providers.uncertainty.calibration import Calibration
from mpsfm_core.providers.uncertainty.calibration_file import (
    CalibratedKind,
    CalibrationFile,
    Provenance,
)

_log = logging.getLogger(__name__)

MAX_ROUNDS = 4
"""Maximum number of reconstructions of a self-calibration [ours]."""
CONVERGENCE_RATIO = 0.05
"""Relative change of the median declared std below which a self-calibration has converged
[ours]."""
_METRICS = ("coverage", "coverage_without_scaling", "z_mad", "nll", "nll_heavy", "ause")


@dataclass(frozen=True)
class CalibrationImages:
    """Images with ground truth, given as in the arguments of :func:`mpsfm_core.reconstruct`."""

    folder: Path
    """Folder of the images."""
    intrinsics: Path | None = None
    """Intrinsics file or COLMAP model with the cameras of the images."""
    image_list: Path | None = None
    """File with the names of the images to use."""


@dataclass(frozen=True, eq=False)
class CalibrationResult:
    """Result of a calibration with the calibration file and the report."""

    file: CalibrationFile
    """Fitted calibration with the provider and images of its origin."""
    report: dict[str, Any]
    """All values of the calibration report as plain data."""


def calibrate(
    photos: CalibrationImages,
    config: Config,
    kind: CalibratedKind = "depth",
    *,
    ground_truth: Mapping[str, Any] | None = None,
    model: Path | None = None,
    alignments: Sequence[Alignment] | None = None,
    options: StudyOptions | None = None,
    registry: Registry | None = None,
) -> CalibrationResult:
    """Calibrate the depth or normals provider of a configuration.

    Args:
        photos: Images on which the provider is calibrated.
        config: Configuration whose ``depth`` or ``normals`` provider is calibrated.
        kind: Kind of the provider, depth or normals.
        ground_truth: Options of the provider ``files``, which reads the true depth or normal maps.
        model: COLMAP model whose points give the true depth. Without true maps and model, the
            images are reconstructed repeatedly until the std converges.
        alignments: Candidate alignments of prior depth to true depth, by default only the scale for
            metric networks, and all alignments for non-metric networks.
        options: Options of pixel sampling, cross-validation and bootstrap.
        registry: Registry of plugins; by default all installed plugins.

    Raises:
        InputError: An argument is invalid, or there are too few samples to fit the std.
        ReconstructionError: Self-calibration cannot reconstruct the images.
    """
    if ground_truth is not None and model is not None:
        raise InputError("give true maps or a model for the calibration, not both")
    if kind == "normals" and ground_truth is None:
        raise InputError("normals need true normal maps for calibration; give --ground-truth")
    registry = registry or Registry.discover()
    run = _Run(photos, config, kind, registry, alignments, options or StudyOptions())
    with threadpool_limits(thread_count(config.runtime), user_api="blas"):
        run.prepare()
        if ground_truth is not None:
            return run.with_files(ground_truth)
        return run.self_calibrate() if model is None else run.with_model(model)


def compare_prior(
    photos: CalibrationImages,
    config: Config,
    ground_truth: Mapping[str, Any] | None = None,
    kind: CalibratedKind = "depth",
    *,
    model: Path | None = None,
    options: StudyOptions | None = None,
    registry: Registry | None = None,
) -> CalibrationData:
    """Compare depth or normal priors with true maps or with the points of a COLMAP model.

    The function :func:`~mpsfm_core.calibration.cross_validation.evaluate_calibrations` evaluates
    the returned samples.

    Args:
        photos: Images on which prior and true maps are compared.
        config: Configuration with the depth or normals provider.
        ground_truth: Options of the provider ``files``, which reads the true depth or normal maps.
        kind: Kind of the provider, depth or normals.
        model: COLMAP model whose points give the true depth.
        options: Options of the pixel sampling.
        registry: Registry of plugins.

    Raises:
        InputError: Both or neither of `ground_truth` and `model` are given, or the ground truth has
            too few samples.
    """
    if (ground_truth is None) == (model is None):
        raise InputError("give either true maps or a COLMAP model to compare with")
    registry = registry or Registry.discover()
    run = _Run(photos, config, kind, registry, None, options or StudyOptions())
    with threadpool_limits(thread_count(config.runtime), user_api="blas"):
        run.prepare()
        if model is not None:
            return run.data_of_model(model)
        assert ground_truth is not None
        return run.data_of_files(ground_truth)


class _Run:
    """Calibration of one provider on a folder of images with one configuration."""

    def __init__(
        self,
        photos: CalibrationImages,
        config: Config,
        kind: CalibratedKind,
        registry: Registry,
        alignments: Sequence[Alignment] | None,
        options: StudyOptions,
    ) -> None:
        stages = Stages(registry)
        # Self-calibration also reconstructs the images, which needs all providers.
        needed = ("depth", "normals", "masks")
        config = resolve_providers(config, registry, stages, needed).config
        self._photos, self._config, self._kind = photos, config, kind
        self._registry, self._options = registry, options
        self._backend: ProviderConfig = getattr(config, kind)
        self._declared: Calibration = registry.calibration(kind, self._backend)
        images = load_images(photos.folder, photos.intrinsics, photos.image_list, config.inputs)
        self._context = ExtractionContext(images, config, registry, stages)
        self._comparison = PriorComparison(self._context, kind, alignments, options)

    def prepare(self) -> None:
        """Run the mask providers, because masked pixels are excluded from the comparison."""
        self._context.run_masks()

    def with_files(self, options: Mapping[str, Any]) -> CalibrationResult:
        """Calibrate the provider with true depth or normal maps."""
        data = self.data_of_files(options)
        return self._finish(data, f"{self._kind} maps in {PurePath(options['directory']).name}")

    def with_model(self, folder: Path) -> CalibrationResult:
        """Calibrate the provider with the points of a COLMAP model."""
        return self._finish(self.data_of_model(folder), f"points of a model: {folder.name}")

    def data_of_files(self, options: Mapping[str, Any]) -> CalibrationData:
        """Compare the prior of the provider with true depth or normal maps."""
        return self._comparison.with_files(options)

    def data_of_model(self, folder: Path) -> CalibrationData:
        """Compare the prior with the points of a COLMAP model."""
        truth = depth_truth_from_model(
            read_model(folder, self._photos.folder), self._context.images
        )
        if not truth:
            raise InputError(f"{folder}: the model has no points in any of the images")
        return self._comparison.with_points(truth)

    def self_calibrate(self) -> CalibrationResult:
        """Calibrate the provider with depth triangulated from reconstructions of the images."""
        current, rounds = self._declared, []
        without_bootstrap = self._options.model_copy(update={"bootstraps": 0})
        for _ in range(MAX_ROUNDS):
            data = self._comparison.with_points(self._reconstruct(current))
            fitted = run_study(data, self._declared, without_bootstrap).calibration
            change = _median_change(data, current, fitted)
            rounds.append({"calibration": fitted.model_dump(mode="json"), "change": change})
            current = fitted
            if change < CONVERGENCE_RATIO:
                break
        result = self._finish(data, f"own reconstruction, {len(rounds)} rounds")
        return CalibrationResult(result.file, {**result.report, "rounds": rounds})

    def _reconstruct(self, calibration: Calibration) -> dict[str, DepthTruth]:
        """Reconstruct with a calibration and triangulate true depth from viewing rays."""
        values = calibration.model_dump(mode="json")
        backend = self._backend.model_copy(update={"calibration": values})
        result = reconstruct(
            self._photos.folder,
            None,
            self._config.model_copy(update={self._kind: backend}),
            intrinsics=self._photos.intrinsics,
            image_list=self._photos.image_list,
            registry=self._registry,
        )
        truth: dict[str, DepthTruth] = {}
        for model in (result.model, *result.further_models):
            truth |= depth_truth_from_model(model, self._context.images)
        return truth

    def _finish(self, data: CalibrationData, truth: str) -> CalibrationResult:
        found = run_study(data, self._declared, self._options)
        for warning in found.warnings:
            _log.warning("calibration of %s: %s", self._backend.use, warning)
        file = CalibrationFile(
            kind=self._kind,
            calibration=found.calibration,
            provenance=self._provenance(found, truth),
        )
        head = {"kind": self._kind, "provenance": file.provenance.model_dump(mode="json")}
        return CalibrationResult(file, {**head, **found.report})

    def _provenance(self, found: CalibrationStudy, truth: str) -> Provenance:
        report, provider = found.report, self._comparison.provider
        chosen, *_ = provider.identity["providers"]
        return Provenance(
            provider=provider.spec.name,
            distribution=self._registry.version(provider.kind, provider.spec.name),
            wrappers=tuple(wrapper.use for wrapper in self._backend.wrap),
            options=_strip_folders(chosen["options"]),
            weights=_weights(provider),
            truth=truth,
            data=f"{len(self._context.images)} images of {_last_folders(self._photos.folder)}",
            date=datetime.now(timezone.utc).isoformat(timespec="seconds"),
            core=core_version(),
            images=len(report["images"]),
            pixels=report["samples"],
            intervals_95=_round_values(report["intervals_95"]),
            metrics={
                when: _round_values({name: metrics[name] for name in _METRICS if name in metrics})
                for when, metrics in report["metrics"].items()
            },
            warnings=found.warnings,
        )


def _median_change(data: CalibrationData, before: Calibration, after: Calibration) -> float:
    """Compute the median relative change of the declared depth std between two calibrations."""
    stds = [std_of(c, data.residuals(c)) for c in (before, after)]
    return float(np.expm1(np.median(np.abs(np.log(stds[1] / stds[0])))))


def _weights(provider: ActiveProvider) -> dict[str, str]:
    files: dict[str, str] = {}
    for part in provider.identity["providers"]:
        files |= {_strip_folders(uri): sha256 for uri, sha256 in part["files"].items()}
    return files


def _round_values(value: Any) -> Any:
    """Round the numbers in nested plain data to four significant digits."""
    if isinstance(value, dict):
        return {key: _round_values(content) for key, content in value.items()}
    if isinstance(value, list):
        return [_round_values(content) for content in value]
    return round_significant(value) if isinstance(value, float) else value


def _last_folders(folder: Path) -> str:
    """Return the last two folders of a path, because many image folders have the same name."""
    return "/".join(folder.resolve().parts[-2:])


def _strip_folders(value: Any) -> Any:
    """Replace paths of existing files in nested plain data by portable file names."""
    if isinstance(value, dict):
        return {key: _strip_folders(content) for key, content in value.items()}
    if isinstance(value, list):
        return [_strip_folders(content) for content in value]
    return PurePath(value).name if isinstance(value, str) and Path(value).exists() else value
