"""Coarse estimate of memory and disk space before a run, which limits the number of workers.

The estimate is the sum of the program, the cached images, and the larger of two stages. In
extraction, each worker decodes an image, or runs a detector or network. In the dense stage, each
worker has a cost volume. For three photos of 3 to 108 megapixels, SIFT, and 1 to 16 workers, the
estimate was within 25 % of the measured peak (Linux). The estimate excludes GPU memory, and
networks whose library downloads the weights.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from glob import escape
from pathlib import Path

from mpsfm_core.config import Config
from mpsfm_core.data.errors import InputError
from mpsfm_core.dense.dense_view import dense_grid_size
from mpsfm_core.extraction.active_provider import worker_count
from mpsfm_core.extraction.priors.prior_maps import integration_grid
from mpsfm_core.inputs.images import CACHED_BYTES
from mpsfm_core.providers import WeightsFile
from mpsfm_core.providers.weights import WeightStore
from mpsfm_core.support.disk_arrays import MEMORY_LIMIT
from mpsfm_core.support.memory import MB, measure_memory
from mpsfm_core.support.threads import count_cores

MAX_RATIO = 2.0
"""Ratio of estimate and available memory or disk space from which a run is refused. [ours]"""

_PROGRAM_MB = 400.0
"""Memory of interpreter, libraries and compiled kernels, MB. [tuned: benchmarks.resources]"""
_RGB_BYTES = 3.0
"""Bytes per pixel of a decoded image; a worker has three copies: file, decoded and undistorted."""
_UNDISTORTION_BYTES = 16.0
"""Bytes per pixel of the two cached tables that undistort images, with two float32 coordinates."""
_GRAY_BYTES = 5.0
"""Bytes per pixel of an image as uint8 and float32 gray values, before its size is reduced."""
_DETECTOR_BYTES = 280.0
"""Bytes per pixel of the scale space of SIFT, for each worker. [tuned: benchmarks.resources]"""
_NETWORK_RATIO = 4.0
"""Ratio of a network's memory, with activations, to its weights. [tuned: benchmarks.resources]"""
_PRIOR_BYTES = 106.0
"""Bytes per pixel of depth, normals, variances and derived maps in the mapper."""
_STORED_PRIOR_BYTES = 26.0
"""Bytes per pixel of depth, normals and variances, of which ``MEMORY_LIMIT`` is in memory."""
_MATCHES_BYTES = 600_000.0
"""Bytes per image of matches and observations in the mapper, with 650 matches per image. [tuned:
benchmarks.scale]"""
_COST_VOLUME_BYTES = 320.0
"""Bytes per pixel of a cost volume of 11 depth labels and its aggregation, for each worker."""
_DENSE_BYTES = 40.0
"""Bytes per pixel of dense depth maps and of the points fused from them, up to ``MEMORY_LIMIT``."""
_DISK_BYTES = 40.0
"""Bytes per pixel of depth maps and prior maps, in the results and in the cache."""


@dataclass(frozen=True)
class ResourceEstimate:
    """Estimated peak memory (with child processes) and disk space of a run, in MB."""

    memory_mb: float
    cache_mb: float
    output_mb: float

    def __str__(self) -> str:
        return (
            f"{self.memory_mb:.0f} MB of memory, {self.cache_mb:.0f} MB of cache and "
            f"{self.output_mb:.0f} MB of results"
        )


def estimate_resources(
    sizes: Sequence[tuple[int, int]],
    config: Config,
    networks: Sequence[int],
    workers: int | None = None,
) -> ResourceEstimate:
    """Estimate memory and disk space of a run.

    Args:
        sizes: (width, height) of the undistorted images in pixels.
        config: Configuration in which each block has one available provider.
        networks: Size in bytes of the weights of each network, see :func:`measure_weights`.
        workers: Number of worker threads; default: the number in ``config.runtime``.
    """
    largest = max(sizes, key=_count_pixels)
    decoded = 3 * _RGB_BYTES * _count_pixels(largest)
    in_extraction = min(len(sizes), workers or worker_count(config.runtime)) * max(
        decoded,
        _DETECTOR_BYTES * _count_detected_pixels(largest, config),
        _NETWORK_RATIO * sum(networks),
    )
    grids = [integration_grid(size, config.extraction.integration_size) for size in sizes]
    num_pixels = sum(map(_count_pixels, grids))
    in_memory = min(num_pixels, MEMORY_LIMIT / _STORED_PRIOR_BYTES)
    in_mapping = _PRIOR_BYTES * in_memory
    in_mapping += _MATCHES_BYTES * (1 - in_memory / num_pixels) * len(sizes)
    if config.dense.enabled:
        grids = [dense_grid_size(size, config.dense.max_size) for size in sizes]
        num_pixels = sum(map(_count_pixels, grids))
        in_mapping += min(MEMORY_LIMIT, _DENSE_BYTES * num_pixels)
        busy = min(len(sizes), workers or config.runtime.workers or count_cores())
        in_mapping += busy * _COST_VOLUME_BYTES * max(map(_count_pixels, grids))
        # Views are decoded one after the other and undistorted with the refined camera.
        in_mapping += decoded + (_GRAY_BYTES + _UNDISTORTION_BYTES) * _count_pixels(largest)
    cached = min(CACHED_BYTES, _RGB_BYTES * sum(map(_count_pixels, sizes)))
    disk_mb = round(_DISK_BYTES * num_pixels / MB)
    memory_mb = _PROGRAM_MB + (cached + max(in_extraction, in_mapping)) / MB
    return ResourceEstimate(round(memory_mb), disk_mb, disk_mb)


def reduce_workers(
    estimate: Callable[[int], ResourceEstimate], workers: int, free_mb: float
) -> int:
    """Return the largest number of workers (at least 1) that fits into free memory.

    Args:
        estimate: Function that estimates the resources for a number of workers.
        workers: Maximum number of worker threads.
        free_mb: Free memory, MB.
    """
    counts = range(workers, 1, -1)
    return next((count for count in counts if estimate(count).memory_mb <= free_mb), 1)


def measure_weights(file: WeightsFile, store: WeightStore) -> int:
    """Return the size of a network's weights in bytes, including files of external data.

    For a missing file, the size is the one declared by the plugin, or 0.
    """
    path = store.locate(file.uri)
    if path is None:
        return file.size or 0
    return sum(part.stat().st_size for part in path.parent.glob(f"{escape(path.name)}*"))


def measure_folder_mb(folder: Path) -> float:
    """Return the size of all files below a folder in MB."""
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file()) / MB


def find_shortages(estimate: ResourceEstimate, cache: Path, output: Path | None) -> list[str]:
    """Compare an estimate with free memory and disk space; return a warning per shortage.

    Raises:
        InputError: the estimate exceeds the total memory of the machine or container, or the free
            disk space for the results, by more than the factor :data:`MAX_RATIO`.
    """
    total_mb, free_mb = measure_memory()
    warnings = []
    need = f"this run takes about {estimate.memory_mb:.0f} MB of memory"
    remedy = "reduce inputs.max_image_size or dense.max_size, use fewer photos"
    if estimate.memory_mb > MAX_RATIO * total_mb:
        total = f"{total_mb:.0f} MB"
        raise InputError(
            f"{need}, but the machine or container has only {total}: {remedy}, "
            f"or set runtime.check_resources=false"
        )
    if estimate.memory_mb > free_mb:
        warnings.append(f"{need}, but {free_mb:.0f} MB are free, so the run may fail: {remedy}")
    folders = {"the cache": (cache, estimate.cache_mb)}
    if output is not None:
        folders["the results"] = (output, estimate.output_mb)
    for name, (folder, size_mb) in folders.items():
        existing = next(path for path in (folder, *folder.resolve().parents) if path.exists())
        free_mb = shutil.disk_usage(existing).free / MB
        text = f"{name} in {folder} take about {size_mb:.0f} MB and {free_mb:.0f} MB are free"
        if name == "the results" and size_mb > MAX_RATIO * free_mb:
            raise InputError(f"{text}: free disk space, or set runtime.check_resources=false")
        if size_mb > free_mb:
            warnings.append(f"{text}: the run may fail")
    return warnings


def _count_pixels(size: tuple[int, int]) -> int:
    return size[0] * size[1]


def _count_detected_pixels(size: tuple[int, int], config: Config) -> float:
    """Return the number of pixels of an image that the feature detectors process."""
    blocks = [config.features, None if config.fast_pass is None else config.fast_pass.features]
    sides = [block.options.get("resize") or max(size) for block in blocks if block is not None]
    return _count_pixels(size) * min(1.0, max(sides, default=0) / max(size)) ** 2
