"""Estimation of memory and disk space before a run, and measurement at its end.

The memory estimate is the sum of a fixed part, the caches, and the largest of three stages:
extraction, dense depth and results. Constants are bytes per pixel of arrays in memory, or derived
from the peak resident memory of a stage (CPython 3.11 on Linux, [tuned: benchmarks.resources]). The
estimate assumes a single connected component of images, which needs most memory.
"""

from __future__ import annotations

import math
import shutil
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from glob import escape
from pathlib import Path

import psutil

from mpsfm_core.config import Config
from mpsfm_core.data.errors import InputError
from mpsfm_core.dense.dense_view import dense_grid_size
from mpsfm_core.extraction.active_provider import worker_count
from mpsfm_core.extraction.features import CACHED_BYTES as CACHED_FEATURE_BYTES
from mpsfm_core.extraction.matching.keypoint_adjustment import CACHED_BYTES as CACHED_GRAY_BYTES
from mpsfm_core.extraction.priors.prior_maps import integration_grid
from mpsfm_core.inputs.images import CACHED_BYTES as CACHED_VIEW_BYTES
from mpsfm_core.providers import ProviderSpec, WeightsFile
from mpsfm_core.providers.provider_config import ProviderConfig
from mpsfm_core.providers.weights import WeightStore
from mpsfm_core.support.control_groups import ControlGroups
from mpsfm_core.support.disk_arrays import MEMORY_LIMIT
from mpsfm_core.support.threads import count_cores

TOLERANCE = 1.3
"""Maximum factor between estimated and measured memory or disk space."""

_MB = float(1 << 20)
_PROGRAM_MB = 320.0
"""Memory of interpreter, libraries and compiled kernels, MB."""
_TORCH_MB = 250.0
"""Additional memory if a provider needs torch, MB."""
_VIEW_BYTES = 3.0
"""Bytes per pixel of a cached RGB view."""
_GRAY_BYTES = 4.0
"""Bytes per pixel of a cached float32 gray image of keypoint adjustment."""
_DECODE_BYTES = 9.0
"""Bytes per pixel of an image during decoding, for the file, RGB and undistorted copies."""
_DETECTOR_BYTES = 280.0
"""Bytes of detector memory per input pixel, for the scale-space pyramids of SIFT."""
_NETWORK_RATIO = 2.0
"""Ratio of a loaded network's memory to the size of its weights file."""
_ACTIVATION_RATIO, _MAX_ACTIVATION_MB = 3.0, 320.0
"""Ratio of a network's activations to its weights file, and the maximum activations in MB."""
_PRIOR_BYTES = 106.0
"""Bytes per pixel of depth, normals and variances in the mapper, with derived maps."""
_DENSE_WORKER_BYTES = 320.0
"""Bytes per pixel of stereo matching, for a cost volume of 11 labels and its aggregation."""
_DENSE_MAP_BYTES = 20.0
"""Bytes per pixel of a dense depth map with variance and support."""
_FUSION_BYTES = 4.6
"""Bytes per pixel of a depth map during fusion into a point cloud."""
_POINT_BYTES = 120.0
"""Bytes per point of the dense cloud, including two temporary copies."""
_POINT_RATIO = 0.4
"""Ratio of points of the dense cloud to pixels of the depth maps."""

_KEYPOINT_BYTES = 544.0
"""Bytes per cached keypoint with position, scale and 128 float32 descriptor values."""
_PIXELS_PER_KEYPOINT = 60.0
"""Minimum number of image pixels per SIFT keypoint."""
_DEFAULT_MAX_KEYPOINTS = 4096
"""Assumed keypoints per image if the feature options set no limit."""
_CACHED_PRIOR_MB = 0.27
"""Disk space of the cached depth and normals of an image, MB."""
_CACHED_PAIR_BYTES = 6_000.0
"""Disk space of the cached matches and two-view geometry of a pair, bytes."""
_CACHED_DENSE_BYTES = 12.0
"""Disk space per pixel of a checkpoint of the dense stage, bytes."""
_WRITTEN_POINT_BYTES = 32.0
_WRITTEN_MAP_BYTES = 7.3
"""Disk space per pixel of a compressed depth map, bytes."""
_REPORT_MAP_BYTES = 8.0
"""Disk space per pixel of a prior map in the report page, compressed, bytes."""
_REPORT_MB, _REPORT_IMAGE_MB = 2.0, 0.22
"""Disk space of the report page without images, and per image, MB."""
_SAMPLING_PERIOD_S = 1.0


@dataclass(frozen=True)
class ResourceEstimate:
    """Estimated peak memory (with child processes) and disk space of a run, in MB."""

    memory_mb: float
    cache_mb: float
    output_mb: float

    def __str__(self) -> str:
        return (
            f"{self.memory_mb:.0f} MB of memory, {self.cache_mb:.0f} MB of cache and "
            f"{self.output_mb:.0f} MB of results, if all photos end in one model"
        )


def estimate_resources(
    sizes: Sequence[tuple[int, int]],
    config: Config,
    providers: Sequence[ProviderSpec],
    networks: Sequence[int],
    workers: int | None = None,
) -> ResourceEstimate:
    """Estimate memory and disk space of a run.

    Args:
        sizes: (width, height) of the undistorted images in pixels.
        config: Configuration in which each block has one available provider.
        providers: Specifications (requirements and weights) of the chosen providers.
        networks: Size in bytes of the weights of each network, see :func:`measure_weights`.
        workers: Number of worker threads; default: the number in ``config.runtime``.
    """
    memory = _PROGRAM_MB * _MB + _TORCH_MB * _MB * any("torch" in p.requires for p in providers)
    memory += _cached_bytes(sizes, config)
    stages = (
        _extraction_bytes(sizes, config, networks, workers or worker_count(config.runtime)),
        _dense_bytes(sizes, config, workers or config.runtime.workers or count_cores()),
        _result_bytes(sizes, config),
    )
    memory += max(stages)
    cache, output = _cache_folder_bytes(sizes, config), _output_bytes(sizes, config)
    return ResourceEstimate(round(memory / _MB), round(cache / _MB), round(output / _MB))


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


def find_shortages(estimate: ResourceEstimate, cache: Path, output: Path | None) -> list[str]:
    """Compare an estimate with free memory and disk; return a warning per shortage.

    Raises:
        InputError: the estimate exceeds the total memory of the machine or container, or the free
            disk space, by more than the factor :data:`TOLERANCE`.
    """
    total_mb, free_mb = measure_memory()
    warnings = []
    need = f"this run takes about {estimate.memory_mb:.0f} MB of memory"
    remedy = "reduce inputs.max_image_size or dense.max_size, use fewer photos"
    if estimate.memory_mb > TOLERANCE * total_mb:
        raise InputError(
            f"{need}, but the machine or container has {total_mb:.0f} MB: {remedy}, "
            f"or set runtime.check_resources=false"
        )
    if estimate.memory_mb > free_mb:
        warnings.append(f"{need}, but {free_mb:.0f} MB are free, so the run may fail: {remedy}")
    folders = {"the cache": (cache, estimate.cache_mb)}
    if output is not None:
        folders["the results"] = (output, estimate.output_mb)
    for name, (folder, size_mb) in folders.items():
        free_mb = _free_disk_mb(folder)
        text = f"{name} in {folder} take about {size_mb:.0f} MB and {free_mb:.0f} MB are free"
        if name == "the results" and size_mb > TOLERANCE * free_mb:
            raise InputError(f"{text}: free disk space, or set runtime.check_resources=false")
        on_same_disk = (mb for path, mb in folders.values() if _same_disk(path, folder))
        if sum(on_same_disk) > free_mb:
            warnings.append(f"{text}: the run may fail")
    return warnings


def measure_memory(groups: ControlGroups | None = None) -> tuple[float, float]:
    """Return total and free memory in MB that this process may use.

    Args:
        groups: Control groups with memory limits; default: the control groups of this process.
    """
    machine = psutil.virtual_memory()
    limits = (groups or ControlGroups()).memory_limits()
    total = min([machine.total, *(limit.total for limit in limits)])
    free = min([machine.available, *(limit.free for limit in limits)])
    return total / _MB, free / _MB


class ChildMemoryMonitor:
    """Measures the peak resident memory of all child processes together."""

    def __init__(self) -> None:
        self.peak_mb = 0.0

    @contextmanager
    def watching(self) -> Iterator[None]:
        """Sample the memory of child processes once per second inside a ``with`` block."""
        ended = threading.Event()
        thread = threading.Thread(target=self._sample_until, args=(ended,), name="mpsfm memory")
        thread.start()
        try:
            yield
        finally:
            ended.set()
            thread.join()

    def _sample_until(self, ended: threading.Event) -> None:
        process = psutil.Process()
        while not ended.wait(_SAMPLING_PERIOD_S):
            resident = 0
            with suppress(psutil.Error):
                for child in process.children(recursive=True):
                    with suppress(psutil.Error):
                        resident += child.memory_info().rss
            self.peak_mb = max(self.peak_mb, resident / _MB)


def measure_folder_mb(folder: Path) -> float:
    """Return the size of all files below a folder in MB."""
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file()) / _MB


def _cached_bytes(sizes: Sequence[tuple[int, int]], config: Config) -> float:
    """Estimate the bytes of the in-memory caches of views, features and gray images."""
    views = min(CACHED_VIEW_BYTES, _VIEW_BYTES * _num_pixels(sizes))
    features = min(CACHED_FEATURE_BYTES, _feature_bytes(sizes, config))
    gray = 0.0
    if config.adjustment.enabled:
        detected = sum(_detection_pixels(size, config) for size in sizes)
        gray = min(CACHED_GRAY_BYTES, _GRAY_BYTES * detected)
    return views + features + gray


def _extraction_bytes(
    sizes: Sequence[tuple[int, int]], config: Config, networks: Sequence[int], workers: int
) -> float:
    """Estimate the bytes of extraction workers for image decoding and a detector or networks."""
    decoding = _DECODE_BYTES * max(width * height for width, height in sizes)
    detector = _DETECTOR_BYTES * max(_detection_pixels(size, config) for size in sizes)
    limit = _MAX_ACTIVATION_MB * _MB
    network = sum(_NETWORK_RATIO * size + min(_ACTIVATION_RATIO * size, limit) for size in networks)
    return min(workers, len(sizes)) * max(decoding, detector, network)


def _dense_bytes(sizes: Sequence[tuple[int, int]], config: Config, workers: int) -> float:
    """Estimate the bytes of the dense stage, for all maps and a cost volume per worker."""
    if not config.dense.enabled:
        return _PRIOR_BYTES * _num_pixels(_prior_grids(sizes, config))
    grids = _final_grids(sizes, config)
    cost_volume = _DENSE_WORKER_BYTES * max(width * height for width, height in grids)
    return _map_bytes(sizes, config) + min(workers, len(sizes)) * cost_volume


def _result_bytes(sizes: Sequence[tuple[int, int]], config: Config) -> float:
    """Estimate the bytes of the results stage, for all maps and the points of the cloud."""
    fusion = _FUSION_BYTES * _num_pixels(_final_grids(sizes, config))
    return _map_bytes(sizes, config) + fusion + _POINT_BYTES * _num_points(sizes, config)


def _map_bytes(sizes: Sequence[tuple[int, int]], config: Config) -> float:
    """Estimate the bytes of the maps in memory from mapping to the results."""
    priors = _PRIOR_BYTES * _num_pixels(_prior_grids(sizes, config))
    if not config.dense.enabled:
        return priors
    return priors + min(MEMORY_LIMIT, _DENSE_MAP_BYTES * _num_pixels(_final_grids(sizes, config)))


def _cache_folder_bytes(sizes: Sequence[tuple[int, int]], config: Config) -> float:
    size = _feature_bytes(sizes, config) + _CACHED_PRIOR_MB * _MB * len(sizes)
    size += _CACHED_PAIR_BYTES * _max_pairs(len(sizes), config)
    if config.dense.enabled:
        dense = _num_pixels(_final_grids(sizes, config))
        size += _CACHED_DENSE_BYTES * dense + max(0.0, _DENSE_MAP_BYTES * dense - MEMORY_LIMIT)
    return size


def _output_bytes(sizes: Sequence[tuple[int, int]], config: Config) -> float:
    results = config.results
    size = _WRITTEN_POINT_BYTES * _num_points(sizes, config)
    if results.depth_maps:
        size += _WRITTEN_MAP_BYTES * _num_pixels(_final_grids(sizes, config))
    if results.report:
        size += (_REPORT_MB + _REPORT_IMAGE_MB * len(sizes)) * _MB
        size += _REPORT_MAP_BYTES * _num_pixels(_prior_grids(sizes, config))
    return size


def _num_pixels(sizes: Sequence[tuple[int, int]]) -> int:
    return sum(width * height for width, height in sizes)


def _prior_grids(sizes: Sequence[tuple[int, int]], config: Config) -> list[tuple[int, int]]:
    return [integration_grid(size, config.extraction.integration_size) for size in sizes]


def _final_grids(sizes: Sequence[tuple[int, int]], config: Config) -> list[tuple[int, int]]:
    if not config.dense.enabled:
        return _prior_grids(sizes, config)
    return [dense_grid_size(size, config.dense.max_size) for size in sizes]


def _num_points(sizes: Sequence[tuple[int, int]], config: Config) -> float:
    if not config.results.dense_cloud:
        return 0.0
    points = _POINT_RATIO * _num_pixels(_final_grids(sizes, config))
    return min(config.results.dense_max_points, points)


def _feature_configs(config: Config) -> list[ProviderConfig]:
    blocks = [config.features, None if config.fast_pass is None else config.fast_pass.features]
    return [block for block in blocks if block is not None]


def _detection_pixels(size: tuple[int, int], config: Config) -> float:
    """Return the number of pixels of the largest image that a detector processes."""
    pixels = 0.0
    for block in _feature_configs(config):
        side = block.options.get("resize") or max(size)
        ratio = min(1.0, side / max(size))
        pixels = max(pixels, math.prod(size) * ratio**2)
    return pixels


def _feature_bytes(sizes: Sequence[tuple[int, int]], config: Config) -> float:
    """Estimate the bytes of the features of all images, without a cache limit."""
    limits = [
        int(block.options.get("max_keypoints") or _DEFAULT_MAX_KEYPOINTS)
        for block in _feature_configs(config)
    ]
    limit = max(limits, default=0)
    return _KEYPOINT_BYTES * sum(
        min(limit, _detection_pixels(size, config) / _PIXELS_PER_KEYPOINT) for size in sizes
    )


def _max_pairs(num_images: int, config: Config) -> int:
    """Return the maximum number of pairs that pair selection can give."""
    pairs = config.pairs
    partners = {
        "exhaustive": num_images,
        "sequential": pairs.overlap,
        "retrieval": pairs.top_k,
        "auto": pairs.partners + pairs.overlap,
    }
    return min(num_images * (num_images - 1) // 2, num_images * partners[pairs.mode])


def _free_disk_mb(folder: Path) -> float:
    return shutil.disk_usage(_nearest_existing(folder)).free / _MB


def _same_disk(a: Path, b: Path) -> bool:
    return _nearest_existing(a).stat().st_dev == _nearest_existing(b).stat().st_dev


def _nearest_existing(folder: Path) -> Path:
    """Return a folder if it exists, else its nearest existing ancestor."""
    folder = folder.resolve()
    return next(path for path in (folder, *folder.parents) if path.exists())
