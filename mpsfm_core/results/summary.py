"""Content of ``summary.json``: images, pairs and reconstructions as plain data."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap

from mpsfm_core.data import MappingProblem
from mpsfm_core.data.decisions import ImageReason
from mpsfm_core.data.errors import InputError
from mpsfm_core.inputs.images import ImageSet, SourceImage
from mpsfm_core.mapping.scene.reconstruction import (
    MappingResult,
    MetricScale,
    Reconstruction,
    RegisteredImage,
)
from mpsfm_core.results.evidence import count_explained_matches, describe_evidence
from mpsfm_core.support.format_versions import check_version

FORMAT = 1
"""Format version of ``summary.json`` and of the files in ``views/``."""


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


def describe_images(
    images: ImageSet, extraction: Mapping[str, Any], mapping: MappingResult
) -> dict[str, Any]:
    """Describe status and statistics of all images, with reasons for unregistered images.

    Args:
        images: images of the run.
        extraction: report of the extraction of features, priors and matches.
        mapping: result of the mapper.
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
        "left_out": images.left_out,
        "failed": extraction.get("failed", {}),
        "details": {
            image.name: {
                **_focal_length(image, registered.get(image.name)),
                **extraction["images"][image.name],
            }
            for image in images
        },
    }


def _focal_length(image: SourceImage, registered: RegisteredImage | None) -> dict[str, Any]:
    """Describe initial and refined focal length of an image, with std or the reason of no std."""
    described: dict[str, Any] = {
        "focal_length_from": image.focal_source,
        "focal_length_px": image.camera.mean_focal_length(),
    }
    if registered is None:
        return described
    focal_px = image.refined_camera(registered.camera).mean_focal_length()
    if registered.camera != image.pinhole:
        described["refined_focal_length_px"] = focal_px
    if registered.focal_log_std is not None:
        described["focal_length_std_px"] = focal_px * registered.focal_log_std
    if registered.focal_reason is not None:
        described["focal_length_reason"] = registered.focal_reason.to_json()
    return described


def describe_pairs(
    extraction: Mapping[str, Any], mapping: MappingResult, problem: MappingProblem
) -> dict[str, Any]:
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
        entry = dict(pair)
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
) -> list[dict[str, Any]]:
    """Describe size and errors of each reconstruction, the model in ``sparse`` first.

    The entry ``mean_reprojection_error_px`` is the mean over the 3D points in pixels of the
    original images.

    Args:
        mapping: result of the mapper.
        models: COLMAP models of the reconstructions.
        problem: mapping problem, the input of the mapper.
    """
    return [
        {**_describe(reconstruction, model), "evidence": describe_evidence(reconstruction, problem)}
        for reconstruction, model in zip(mapping.reconstructions, models, strict=True)
    ]


def _describe(reconstruction: Reconstruction, model: pycolmap.Reconstruction) -> dict[str, Any]:
    relative_std = [
        np.sqrt(image.depth.variance[image.depth.valid]) / image.depth.depth[image.depth.valid]
        for image in reconstruction.images
        if image.depth.variance is not None
    ]
    return {
        "images": len(reconstruction.images),
        "points": model.num_points3D(),
        "observations": model.compute_num_observations(),
        "mean_track_length": model.compute_mean_track_length() if model.num_points3D() else 0.0,
        "mean_reprojection_error_px": _mean_error(model),
        "median_relative_depth_std": _median(relative_std),
        "metric_scale": _metric(reconstruction.metric),
    }


def _mean_error(model: pycolmap.Reconstruction) -> float | None:
    return float(model.compute_mean_reprojection_error()) if model.num_points3D() else None


def _median(values: Sequence[np.ndarray[Any, Any]]) -> float | None:
    pooled = np.concatenate(values) if values else np.zeros(0)
    return float(np.median(pooled)) if len(pooled) else None


def _metric(metric: MetricScale | None) -> dict[str, Any] | None:
    return None if metric is None else asdict(metric)
