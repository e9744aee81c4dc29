"""Content of ``summary.json``: results, providers, times and resources of a run."""

from __future__ import annotations

import platform
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pycolmap

from mpsfm_core.extraction.runner import Extraction
from mpsfm_core.inputs.images import ImageSet
from mpsfm_core.mapping.scene.reconstruction import MappingResult
from mpsfm_core.pipeline.provider_resolution import ProviderResolution
from mpsfm_core.pipeline.resources import (
    ChildMemoryMonitor,
    ResourceEstimate,
    measure_folder_mb,
)
from mpsfm_core.pipeline.stages import Stages
from mpsfm_core.providers.registry import core_version
from mpsfm_core.results.summary import FORMAT as SUMMARY_FORMAT
from mpsfm_core.results.summary import describe_images, describe_pairs, describe_reconstructions
from mpsfm_core.support.format_versions import VERSION


def summarize_results(
    images: ImageSet,
    extraction: Extraction,
    mapping: MappingResult,
    models: Sequence[pycolmap.Reconstruction],
) -> dict[str, Any]:
    """Summarize images, pairs and reconstructions after extraction and mapping."""
    return {
        "images": describe_images(images, extraction.report, mapping),
        "pairs": describe_pairs(extraction.report, mapping, extraction.problem),
        "reconstructions": describe_reconstructions(mapping, models, extraction.problem),
        "mapping_runs": mapping.report.runs,
        "mapping_steps": {
            name: {"seconds": seconds, "calls": mapping.report.counts.get(name)}
            for name, seconds in mapping.report.seconds.items()
        },
    }


def summarize_run(
    status: str, resolution: ProviderResolution, stages: Stages, usage: Sequence[Mapping[str, Any]]
) -> dict[str, Any]:
    """Summarize a run: status, warnings, times, providers, configuration and versions.

    Args:
        status: ``success`` or ``failed``.
        resolution: Configuration with one provider per block, and the reasons of the choices.
        stages: Recorder of the times, peak memory and warnings of all stages.
        usage: Entries of the extraction report with the number of results per provider.
    """
    return {
        VERSION: SUMMARY_FORMAT,
        "status": status,
        "warnings": list(stages.warnings),
        "stages": {name: asdict(record) for name, record in stages.report().items()},
        "providers": _describe_providers(resolution, usage),
        "config": resolution.config.model_dump(mode="json"),
        "versions": {
            "mpsfm-core": core_version(),
            "pycolmap": pycolmap.__version__,
            "python": platform.python_version(),
        },
    }


def summarize_resources(
    estimate: ResourceEstimate,
    stages: Stages,
    children: ChildMemoryMonitor,
    output: Path | None = None,
) -> dict[str, Any]:
    """Compare estimated with measured memory and disk space; memory is the peak so far."""
    peaks = [record.peak_memory_mb or 0.0 for record in stages.report().values()]
    measured = {
        "memory_mb": round(max(peaks, default=0.0) + children.peak_mb),
        "output_mb": None if output is None else round(measure_folder_mb(output)),
    }
    return {"predicted": asdict(estimate), "measured": measured}


def _describe_providers(
    resolution: ProviderResolution, usage: Sequence[Mapping[str, Any]]
) -> list[dict[str, Any]]:
    """Describe reason of the choice, licenses, number of results and time of each provider."""
    used = {(line["kind"], line["name"]): line for line in usage}
    unused = {"computed": 0, "from_cache": 0, "seconds": 0.0}
    described = []
    blocks = zip(resolution.choices, resolution.config.provider_configs(), strict=True)
    for choice, (_, kind, provider_config) in blocks:
        spec = choice.provider
        described.append(
            {
                "block": choice.block,
                **used.get((kind, spec.name), {"kind": kind, "name": spec.name, **unused}),
                "from": choice.origin,
                "chosen": choice.reason.value,
                "passed_over": {name: why.to_json() for name, why in choice.passed_over.items()},
                "code_license": spec.code_license,
                "weights_license": spec.weights_license,
                "accuracy": spec.accuracy,
                "wrappers": [wrapper.use for wrapper in provider_config.wrap],
            }
        )
    return described
