"""Calibrate a provider on a folder of photos: with true maps, with a model, or with nothing.

This stands above the pipeline, which it uses; the model of calibrations itself
(:mod:`mpsfm_core.providers.uncertainty.calibration`) is below all providers.
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
"""Reconstructions of a self-calibration (ours)."""
SETTLED = 0.05
"""A round that changes the median std by less than this share is the last (ours)."""
_KEPT_METRICS = ("coverage", "coverage_without_scaling", "z_mad", "nll", "nll_heavy", "ause")


@dataclass(frozen=True)
class CalibrationImages:
    """The images to calibrate on, as :func:`mpsfm_core.reconstruct` takes them."""

    folder: Path
    intrinsics: Path | None = None
    image_list: Path | None = None


@dataclass(frozen=True, eq=False)
class CalibrationResult:
    """``file``: the calibration with its provenance. ``report``: all numbers, plain data."""

    file: CalibrationFile
    report: dict[str, Any]


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
        photos: the images. config: its ``depth`` or ``normals`` block is what is calibrated.
        ground_truth: options of the provider ``files`` that reads the true maps.
        model: COLMAP model whose points are true depth. Without either, depth is compared with
            the points of our own reconstruction, which is repeated until the std settles.
        alignments: what may be tried for depth; by default the scale for metric networks, and
            all three for others. options: of the fit.
        registry: the providers to choose from, by default those of all installed plugins.

    Raises:
        InputError: what was given is wrong, or does not suffice for a fit.
        ReconstructionError: without truth, and nothing could be reconstructed.
    """
    if ground_truth is not None and model is not None:
        raise InputError("give true maps or a model, not both")
    if kind == "normals" and ground_truth is None:
        raise InputError("normals can only be calibrated with true normal maps")
    registry = registry or Registry.discover()
    run = _Run(photos, config, kind, registry, alignments, options or StudyOptions())
    with threadpool_limits(thread_count(config.runtime), user_api="blas"):
        run.prepare()
        if ground_truth is not None:
            return run.with_files(ground_truth)
        return run.alone() if model is None else run.with_model(model)


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
    """A prior beside true maps or a model's points, for :func:`mpsfm_core.calibration.cross_validation.evaluate_calibrations`.

    Arguments and errors as of :func:`calibrate`; one of ``ground_truth`` and ``model``.
    """
    if (ground_truth is None) == (model is None):
        raise InputError("give true maps or a model")
    registry = registry or Registry.discover()
    run = _Run(photos, config, kind, registry, None, options or StudyOptions())
    with threadpool_limits(thread_count(config.runtime), user_api="blas"):
        run.prepare()
        if model is not None:
            return run.data_of_model(model)
        assert ground_truth is not None
        return run.data_of_files(ground_truth)


class _Run:
    """One calibration."""

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
        needed = ("depth", "normals", "masks")  # a reconstruction sees to the others itself
        config = resolve_providers(config, registry, stages, needed).config
        self._photos, self._config, self._kind = photos, config, kind
        self._registry, self._options = registry, options
        self._backend: ProviderConfig = getattr(config, kind)
        self._declared: Calibration = registry.calibration(kind, self._backend)
        images = load_images(photos.folder, photos.intrinsics, photos.image_list, config.inputs)
        self._context = ExtractionContext(images, config, registry, stages)
        self._comparison = PriorComparison(self._context, kind, alignments, options)

    def prepare(self) -> None:
        """Run the mask providers: what they mask is not compared."""
        self._context.run_masks()

    def with_files(self, options: Mapping[str, Any]) -> CalibrationResult:
        """Calibrate with true maps."""
        data = self.data_of_files(options)
        return self._finish(data, f"{self._kind} maps in {PurePath(options['directory']).name}")

    def with_model(self, folder: Path) -> CalibrationResult:
        """Calibrate with the points of a COLMAP model."""
        return self._finish(self.data_of_model(folder), f"points of a model: {folder.name}")

    def data_of_files(self, options: Mapping[str, Any]) -> CalibrationData:
        """The prior beside true maps."""
        return self._comparison.with_files(options)

    def data_of_model(self, folder: Path) -> CalibrationData:
        """The prior beside the points of a COLMAP model."""
        truth = depth_truth_from_model(read_model(folder), self._context.images)
        if not truth:
            raise InputError(f"{folder}: the model has no points in any of the images")
        return self._comparison.with_points(truth)

    def alone(self) -> CalibrationResult:
        """Reconstruct, compare with what the rays of its points say, and again."""
        current, rounds = self._declared, []
        quick = self._options.model_copy(update={"bootstraps": 0})
        for _ in range(MAX_ROUNDS):
            data = self._comparison.with_points(self._reconstruct(current))
            fitted = run_study(data, self._declared, quick).calibration
            change = _median_change(data, current, fitted)
            rounds.append({"calibration": fitted.model_dump(mode="json"), "change": change})
            current = fitted
            if change < SETTLED:
                break
        result = self._finish(data, f"own reconstruction, {len(rounds)} rounds")
        return CalibrationResult(result.file, {**result.report, "rounds": rounds})

    def _reconstruct(self, calibration: Calibration) -> dict[str, DepthTruth]:
        """True depth by the rays of all models that can be made with a calibration."""
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
            options=_without_folders(chosen["options"]),
            weights=_weights(provider),
            truth=truth,
            data=f"{len(self._context.images)} images of {_last_folders(self._photos.folder)}",
            date=datetime.now(timezone.utc).isoformat(timespec="seconds"),
            core=core_version(),
            images=len(report["images"]),
            pixels=report["samples"],
            intervals_95=_short(report["intervals_95"]),
            metrics={
                when: _short({name: metrics[name] for name in _KEPT_METRICS if name in metrics})
                for when, metrics in report["metrics"].items()
            },
            warnings=found.warnings,
        )


def _median_change(data: CalibrationData, before: Calibration, after: Calibration) -> float:
    """Median over the samples of how much the std changed, as a share."""
    stds = [std_of(c, data.residuals(c)) for c in (before, after)]
    return float(np.expm1(np.median(np.abs(np.log(stds[1] / stds[0])))))


def _weights(provider: ActiveProvider) -> dict[str, str]:
    files: dict[str, str] = {}
    for part in provider.identity["providers"]:
        files |= {_without_folders(uri): sha256 for uri, sha256 in part["files"].items()}
    return files


def _short(value: Any) -> Any:
    """Plain data with numbers of four digits, for files that people read."""
    if isinstance(value, dict):
        return {key: _short(content) for key, content in value.items()}
    if isinstance(value, list):
        return [_short(content) for content in value]
    return round_significant(value) if isinstance(value, float) else value


def _last_folders(folder: Path) -> str:
    """``scene/images``: many folders of photos have one name."""
    return "/".join(folder.resolve().parts[-2:])


def _without_folders(value: Any) -> Any:
    """Plain data with the names of files for their paths: what is shipped names no machine."""
    if isinstance(value, dict):
        return {key: _without_folders(content) for key, content in value.items()}
    if isinstance(value, list):
        return [_without_folders(content) for content in value]
    return PurePath(value).name if isinstance(value, str) and Path(value).exists() else value
