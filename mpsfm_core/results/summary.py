"""Content of ``summary.json``.

:class:`RunSummary` declares all keys of ``summary.json``. The functions of this module describe
images, pairs and reconstructions, and the pipeline adds providers, times, resources and
configuration.
"""

from __future__ import annotations

import json
import platform
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, TypedDict

import numpy as np
import pycolmap

from mpsfm_core.data import Float32, MappingProblem
from mpsfm_core.data.camera_models import IntrinsicParameter
from mpsfm_core.data.decisions import ImageReason, Value
from mpsfm_core.data.errors import InputError
from mpsfm_core.extraction.report import ExtractionReport
from mpsfm_core.geometry.statistics import pooled_median
from mpsfm_core.inputs.images import ImageSet, SourceImage
from mpsfm_core.mapping.scene.reconstruction import (
    MappingResult,
    Reconstruction,
    RegisteredImage,
)
from mpsfm_core.providers.registry import core_version
from mpsfm_core.results.evidence import count_explained_matches, describe_evidence
from mpsfm_core.results.original_images import OriginalImages
from mpsfm_core.support.format_versions import check_version

FORMAT = 1
"""Format version of ``summary.json`` and of the files in ``views/``."""


class ImagesSummary(TypedDict):
    """Status and statistics of the images of a run."""

    total: int
    registered: list[str]
    unconfirmed: dict[str, dict[str, Value]]
    """Reason why each tentatively registered image is not verified, by image name."""
    unregistered: dict[str, dict[str, Value]]
    """Reason why each unregistered image is not registered, by image name."""
    held_out: list[str]
    """Registered images that do not contribute to dense depth, cloud and mesh."""
    left_out: dict[str, str]
    """Reason why an image file is not used, by file name."""
    failed: dict[str, str]
    """Error message of a provider that failed on an image, by image name."""
    details: dict[str, dict[str, Any]]
    """Focal length, distortion and statistics of extraction
    (:class:`~mpsfm_core.extraction.report.ImageReport`), by image name."""


class PairsSummary(TypedDict):
    """Numbers of proposed, matched and verified image pairs, and the outcome of each pair."""

    proposed: int
    matched: int
    verified: int
    all: list[dict[str, Any]]
    """:class:`~mpsfm_core.extraction.report.PairReport` of each pair, with two more entries. The
    entry ``explained`` is the number of inliers whose keypoints share a 3D point of the first
    model. The entry ``cannot_start`` is the reason why the pair cannot initialize a component."""


class ReconstructionSummary(TypedDict):
    """Size, errors and evidence of one reconstruction."""

    images: int
    points: int
    observations: int
    mean_track_length: float
    mean_reprojection_error_px: float | None
    """Mean reprojection error over the 3D points in pixels of the original images."""
    median_relative_depth_std: float | None
    metric_scale: dict[str, Any] | None
    """:class:`~mpsfm_core.mapping.scene.reconstruction.MetricScale` of the reconstruction."""
    evidence: dict[str, Any]
    """Result of :func:`~mpsfm_core.results.evidence.describe_evidence`."""


ProviderSummary = TypedDict(
    "ProviderSummary",
    {
        "block": str,  # of the configuration
        "kind": str,
        "name": str,
        "computed": int,
        "from_cache": int,
        "seconds": float,
        "from": str,  # name and version of the provider's pip package
        "chosen": str,
        "passed_over": dict[str, dict[str, Value]],
        "code_license": str,
        "weights_license": str,
        "accuracy": str,
        "wrappers": list[str],
    },
)


class StageSummary(TypedDict):
    """Run time and peak memory of a stage of the pipeline."""

    seconds: float
    peak_memory_mb: float | None


class RunSummary(TypedDict):
    """Content of ``summary.json``."""

    format_version: int
    status: str
    """``success`` or ``failed``."""
    warnings: list[str]
    doubts: list[dict[str, Value]]
    """Reasons (``DoubtReason``) to doubt the output of a provider for all images or pairs."""
    hooks: list[dict[str, Value]]
    """Reasons (``HookReason``) why hooks of plugins were left out or their values are doubtful."""
    stages: dict[str, StageSummary]
    providers: list[ProviderSummary]
    config: dict[str, Any]
    versions: dict[str, str]
    photos: str | None
    """Absolute path of the images folder, or None for images in memory."""
    videos: list[dict[str, Any]]
    """File, keyframes and localized frames of each video; empty for photos."""
    matches_from: str | None
    """File from which matches were imported, or None if the images were matched."""
    images: ImagesSummary
    pairs: PairsSummary
    reconstructions: list[ReconstructionSummary]
    """Summary of each component; the first component is the model in ``sparse``."""
    mapping_runs: int
    """Number of mapper runs with different seeds."""
    mapping_steps: dict[str, dict[str, Any]]
    """Run time in seconds and number of calls of each step of the mapper."""
    mapping_parts: list[dict[str, Any]]
    """Number of images, seconds, CPU seconds, peak memory in MB, and worker of each part; empty for
    mapping in one piece."""
    georeference: dict[str, Any] | None
    """Alignment of the first reconstruction with GPS positions, or the reason why it is not
    aligned."""
    dense: list[dict[str, Any]] | None
    """Report of multi-view stereo for each reconstruction, or None if stereo is disabled."""
    resources: dict[str, Any]
    """Estimated (``predicted``) and ``measured`` memory and disk space of the run."""


def read_summary(path: Path) -> dict[str, Any]:
    """Read a ``summary.json``.

    Raises:
        InputError: the file is missing, damaged, from a newer MP-SfM or not the summary of a run.
    """
    try:
        summary = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(
            f"{path}: {error.strerror}; give a folder that 'mpsfm reconstruct' wrote"
        ) from error
    except (ValueError, RecursionError) as error:
        raise InputError(f"summary {path} is damaged: {error}") from error
    if not isinstance(summary, dict) or summary.get("status") not in ("success", "failed"):
        raise InputError(f"{path} is not the summary of a run")
    check_version(summary, FORMAT, path)
    return summary


def describe_versions() -> dict[str, str]:
    """Return the versions of MP-SfM, pycolmap and Python."""
    return {
        "mpsfm-core": core_version(),
        "pycolmap": pycolmap.__version__,
        "python": platform.python_version(),
    }


def describe_mapping_steps(mapping: MappingResult) -> dict[str, dict[str, Any]]:
    """Describe run time and number of calls of each step of the mapper."""
    report = mapping.report
    return {
        name: {"seconds": seconds, "calls": report.counts.get(name)}
        for name, seconds in report.seconds.items()
    }


def describe_images(
    images: ImageSet,
    extraction: ExtractionReport,
    mapping: MappingResult,
    photos: OriginalImages,
) -> ImagesSummary:
    """Describe status and statistics of all images, with reasons for unregistered images.

    Args:
        images: images of the run with the initial cameras, which were given or guessed.
        extraction: report of the extraction of features, priors and matches.
        mapping: result of the mapper.
        photos: original images with the refined cameras.
    """
    component = {
        image.name: number
        for number, reconstruction in enumerate(mapping.reconstructions)
        for image in reconstruction.confirmed_images
    }
    placed = {image.name for model in mapping.reconstructions[:1] for image in model.images}
    registered = {image.name: image for model in mapping.reconstructions for image in model.images}
    reasons = {}
    for name in images.names:
        if name not in component:
            reasons[name] = mapping.report.image_reasons.get(
                name, ImageReason.NOT_RECORDED.because()
            ).to_json()
        elif component[name] > 0:
            reasons[name] = ImageReason.OTHER_COMPONENT.because(component=component[name]).to_json()
    return {
        "total": len(images),
        "registered": [name for name in images.names if name not in reasons],
        "unconfirmed": {name: reason for name, reason in reasons.items() if name in placed},
        "unregistered": {name: reason for name, reason in reasons.items() if name not in placed},
        "held_out": sorted(
            image.name for image in registered.values() if image.held_out and image.confirmed
        ),
        "left_out": images.left_out,
        "failed": extraction["failed"],
        "details": {
            image.name: {
                **_describe_camera(image, registered.get(image.name), photos),
                **extraction["images"][image.name],
            }
            for image in images
        },
    }


def _describe_camera(
    image: SourceImage, registered: RegisteredImage | None, photos: OriginalImages
) -> dict[str, Any]:
    """Describe initial and refined focal length and distortion of an image, with std or reason."""
    described: dict[str, Any] = {
        "focal_length_from": image.focal_source,
        "focal_length_px": image.camera.mean_focal_length(),
    }
    if registered is None:
        return described
    focal_px = photos.original_camera(registered).mean_focal_length()
    if focal_px != described["focal_length_px"]:
        described["refined_focal_length_px"] = focal_px
    if any(result.is_refined for result in registered.calibration.values()):
        described["camera_model"] = photos.original_camera(registered).model_name
    for parameter, calibrated in registered.calibration.items():
        name = parameter.name.lower()
        if calibrated.std is not None and parameter == IntrinsicParameter.FOCAL_LENGTH:
            described["focal_length_std_px"] = focal_px * calibrated.std
        elif calibrated.std is not None:
            is_radial = parameter == IntrinsicParameter.RADIAL_DISTORTION
            value = registered.distortion[0] if is_radial else calibrated.estimate.value
            described[name] = float(value)
            described[f"{name}_std"] = calibrated.std
        if calibrated.reason is not None:
            described[f"{name}_reason"] = calibrated.reason.to_json()
    return described


def describe_pairs(
    extraction: ExtractionReport, mapping: MappingResult, problem: MappingProblem
) -> PairsSummary:
    """Describe matches and inliers of all image pairs, and why pairs were dropped.

    The entry ``explained`` counts the inliers of a pair whose keypoints share a 3D point of the
    first model. The entry ``cannot_start`` explains why a pair cannot initialize a component.

    Args:
        extraction: report of the extraction of features, priors and matches.
        mapping: result of the mapper.
        problem: mapping problem, the input of the mapper.
    """
    described = []
    models = mapping.reconstructions[:1]
    explained = count_explained_matches(models[0], problem) if models else {}
    for pair in extraction["pairs"]:
        entry: dict[str, Any] = {**pair}
        names = tuple(pair["images"])
        if names in explained:
            entry["explained"] = explained[names]
        if (reason := mapping.report.pair_reasons.get(" ".join(names))) is not None:
            entry["cannot_start"] = reason.to_json()
        described.append(entry)
    return {
        "proposed": extraction["pairs_proposed"],
        "matched": extraction["pairs_matched"],
        "verified": extraction["pairs_verified"],
        "all": described,
    }


def describe_reconstructions(
    mapping: MappingResult, models: Sequence[pycolmap.Reconstruction], problem: MappingProblem
) -> list[ReconstructionSummary]:
    """Describe size and errors of each reconstruction, the model in ``sparse`` first.

    The entry ``mean_reprojection_error_px`` is the mean over the 3D points in pixels of the
    original images.

    Args:
        mapping: result of the mapper.
        models: COLMAP models of the reconstructions.
        problem: mapping problem, the input of the mapper.
    """
    return [
        _describe(reconstruction, model, problem)
        for reconstruction, model in zip(mapping.reconstructions, models, strict=True)
    ]


def _describe(
    reconstruction: Reconstruction, model: pycolmap.Reconstruction, problem: MappingProblem
) -> ReconstructionSummary:
    def read_relative_stds() -> Iterator[Float32]:
        for image in reconstruction.images:
            depth = image.depth
            if depth.variance is not None:
                std = np.sqrt(depth.variance[depth.valid])
                yield np.asarray(std / depth.depth[depth.valid], np.float32)

    return {
        "images": len(reconstruction.images),
        "points": model.num_points3D(),
        "observations": model.compute_num_observations(),
        "mean_track_length": model.compute_mean_track_length() if model.num_points3D() else 0.0,
        "mean_reprojection_error_px": _mean_error(model),
        "median_relative_depth_std": pooled_median(read_relative_stds),
        "metric_scale": None if reconstruction.metric is None else asdict(reconstruction.metric),
        "evidence": describe_evidence(reconstruction, problem),
    }


def _mean_error(model: pycolmap.Reconstruction) -> float | None:
    return float(model.compute_mean_reprojection_error()) if model.num_points3D() else None
