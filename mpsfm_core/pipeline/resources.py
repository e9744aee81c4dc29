"""Memory and disk that a run takes: predicted before the first photo is decoded, measured after.

The prediction is for photos that all end in one group, which takes most memory; in several, each
has a cloud of its own, which takes more disk. Its terms are what the code keeps a pixel, where that
can be said, else read off the peaks of resident memory of each stage (``summary.json``): of runs
with 5, 24 and 60 rendered photos, CPython 3.11 on Linux. docs/robustness.md has the errors.
"""

from __future__ import annotations

import math
import shutil
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from glob import escape
from pathlib import Path

import psutil

from mpsfm_core.config import Config
from mpsfm_core.data.errors import InputError
from mpsfm_core.dense.dense_view import dense_grid_size
from mpsfm_core.extraction.active_provider import worker_count
from mpsfm_core.extraction.features import CACHED_BYTES as CACHED_FEATURES
from mpsfm_core.extraction.matching.keypoint_adjustment import CACHED_BYTES as CACHED_GREY
from mpsfm_core.extraction.priors.prior_maps import integration_grid
from mpsfm_core.inputs.images import CACHED_BYTES as CACHED_VIEWS
from mpsfm_core.providers import ProviderSpec, WeightsFile
from mpsfm_core.providers.weights import WeightStore
from mpsfm_core.support.disk_arrays import IN_MEMORY

TOLERANCE = 1.3
"""The prediction is to be off by less than this factor."""

_MB = float(1 << 20)
_PROGRAM_MB = 265.0
"""Interpreter and libraries (232), what the first photos bring with them (25), the report (8)."""
_TORCH_MB = 250.0
"""More where a provider's library is torch, once (estimated)."""
_COMPILED_MB = 54.0
"""Compiled kernels of mapping and what loads them."""
_WORKER_BYTES = 350.0
"""A pixel of the photo that a worker has in hand: SIFT's pyramid of the doubled image."""
_WEIGHTS = 2.0
"""Times the size of its file a network is in memory, in each worker: in ONNX Runtime 1.7 (MoGe-2
ViT-S, 98 MB) and 1.8 (DSINE, 339 MB). While it is loaded it may be more, 4.3 for DSINE."""
_WORKING, _MOST_WORKING_MB = 3.0, 320.0
"""Times that size what it computes with, and how much at most: 317 MB for MoGe-2 with 1800 tokens
and for DSINE at 1024 x 683, which is 3.2 and 0.9 times their size."""
_PRIOR_BYTES = 106.0
"""A pixel of the prior maps: depth and normals with variances (26), and what mapping adds (80)."""
_DENSE_BYTES = 12.0
"""A pixel of the dense stage: the final map (9), and what was found (11) as far as it does not fit
into what earlier stages left free."""
_DENSE_KEPT_BYTES = 20.0
"""Both, all of it, for what is on disk where it is too much."""
_DENSE_WORKER_BYTES = 320.0
"""A pixel of the photo that a worker matches: 11 labels, each of a byte from 5 views and of 6
arrays of 4 bytes. On the coarse grid it may be 700, in what earlier stages left free."""
_RESULT_BYTES = 4.6
"""A pixel of the final depth maps: whether it is certain (1); number and votes of those that become
points (9 for 0.4)."""
_POINT_BYTES = 120.0
"""A point of the cloud (44), once more in parts (44), and as it is written (32)."""
_POINTS = 0.4
"""Of the pixels become points (0.27 to 0.46 were seen), as long as they may."""

_KEYPOINT_BYTES = 544.0
"""A keypoint with 128 values of 4 bytes, position and scale, in memory and in the cache."""
_KEYPOINT_PIXELS = 60.0
"""Pixels of a photo for each keypoint, at least: SIFT found one in 62 to 325 on photos of four
scenes, 320 to 1280 wide."""
_CACHE_MAP_MB = 0.27
"""Depth and normals of a photo by `compact`; larger networks leave more."""
_CACHE_PAIR_BYTES = 6_000.0
"""Matches and two-view geometry of a pair."""
_DENSE_CACHE_BYTES = 12.0
"""A pixel that the dense stage found, until the run ends."""
_WRITTEN_POINT_BYTES = 32.0
_WRITTEN_BYTES = 7.3
"""A pixel of the final depth maps, compressed."""
_VIEW_BYTES = 8.0
"""A pixel of a prior that the report is made from, compressed: 8.6 to 9.5 of photos, 2 to 4 of
scenes without noise."""
_PAGE_MB, _PAGE_PHOTO_MB = 2.0, 0.22
"""The report and what it shows, once and for each photo; the model is little beside it."""
_USUAL_KEYPOINTS = 4096
"""Of a photo, where the options of the features do not say it."""
_EVERY_S = 1.0
_GROUPS = Path("/sys/fs/cgroup")


@dataclass(frozen=True)
class ResourceEstimate:
    """Megabytes: peak of memory of the process and those it starts, cache and output folder."""

    memory_mb: float
    cache_mb: float
    output_mb: float

    def __str__(self) -> str:
        """For people."""
        return (
            f"{self.memory_mb:.0f} MB of memory, {self.cache_mb:.0f} MB of cache and "
            f"{self.output_mb:.0f} MB of results, if all photos end in one group"
        )


def estimate_resources(
    sizes: Sequence[tuple[int, int]],
    config: Config,
    providers: Sequence[ProviderSpec],
    networks: Sequence[int],
) -> ResourceEstimate:
    """What a run will take.

    ``sizes``: (width, height) of the undistorted views. ``providers``: those that were chosen;
    ``networks``: bytes of each network's file, see :func:`network_bytes`.
    """
    count, workers = len(sizes), worker_count(config.runtime)
    pixels = [width * height for width, height in sizes]
    grids = [integration_grid(size, config.extraction.integration_size) for size in sizes]
    final = prior = sum(width * height for width, height in grids)
    torch = any("torch" in spec.requires for spec in providers)
    most = _keypoints(config)
    features = _KEYPOINT_BYTES * sum(min(most, size / _KEYPOINT_PIXELS) for size in pixels)
    memory = (_PROGRAM_MB + _COMPILED_MB + torch * _TORCH_MB) * _MB
    memory += min(CACHED_VIEWS, 3 * sum(pixels)) + min(CACHED_FEATURES, features)
    if config.adjustment.enabled:
        memory += min(CACHED_GREY, 4 * sum(pixels))
    memory += _PRIOR_BYTES * prior + workers * _WORKER_BYTES * max(pixels)
    for size in networks:
        memory += workers * (_WEIGHTS * size + min(_WORKING * size, _MOST_WORKING_MB * _MB))
    cache = features + _CACHE_MAP_MB * _MB * count + _CACHE_PAIR_BYTES * _pairs(count, config)
    if config.dense.enabled:
        dense = [math.prod(dense_grid_size(size, config.dense.max_size)) for size in sizes]
        final = sum(dense)
        memory += min(_DENSE_BYTES * final, IN_MEMORY)
        memory += workers * _DENSE_WORKER_BYTES * max(dense)
        cache += _DENSE_CACHE_BYTES * final + max(0.0, _DENSE_KEPT_BYTES * final - IN_MEMORY)
    results = config.results
    points = results.dense_cloud * min(results.dense_max_points, _POINTS * final)
    memory += _RESULT_BYTES * final + _POINT_BYTES * points
    output = _WRITTEN_POINT_BYTES * points + results.depth_maps * _WRITTEN_BYTES * final
    output += results.report * ((_PAGE_MB + _PAGE_PHOTO_MB * count) * _MB + _VIEW_BYTES * prior)
    return ResourceEstimate(round(memory / _MB), round(cache / _MB), round(output / _MB))


def network_bytes(file: WeightsFile, store: WeightStore) -> int:
    """Of a network's file, with what lies beside it where it is in parts; as its publisher says
    where it is not on this machine, 0 where nobody says it."""
    path = store.locate(file.uri)
    if path is None:
        return file.size or 0
    return sum(part.stat().st_size for part in path.parent.glob(f"{escape(path.name)}*"))


def shortages(needs: ResourceEstimate, cache: Path, output: Path | None) -> list[str]:
    """What is short, in words; empty where the run fits.

    Raises:
        InputError: it cannot fit: more than all the memory that this machine or container has, or
            results larger than the disk has room for, by more than the prediction may be off.
    """
    limit, free = memory_mb()
    found = []
    much = f"this run takes about {needs.memory_mb:.0f} MB of memory"
    less = "set inputs.max_image_size or dense.max_size lower, use fewer photos"
    if needs.memory_mb > TOLERANCE * limit:
        raise InputError(
            f"{much} and {limit:.0f} MB are there: {less}, or set runtime.check_resources=false"
        )
    if needs.memory_mb > free:
        found.append(f"{much} and {free:.0f} MB are free: it may fail; {less}")
    places = {"the cache": (cache, needs.cache_mb)}
    if output is not None:
        places["the results"] = (output, needs.output_mb)
    for what, (folder, size) in places.items():
        room = _room_mb(folder)
        text = f"{what} in {folder} take about {size:.0f} MB and {room:.0f} MB are free"
        if what == "the results" and size > TOLERANCE * room:
            raise InputError(f"{text}: make room, or set runtime.check_resources=false")
        if sum(mb for other, mb in places.values() if _same_disk(other, folder)) > room:
            found.append(f"{text}: it may fail where other files go there too")
    return found


def memory_mb() -> tuple[float, float]:
    """All memory that this process may use, and what is free of it: of the machine, and of the
    control groups (containers, job schedulers) that it is in."""
    machine = psutil.virtual_memory()
    limits, free = [machine.total], [machine.available]
    for folder in _control_groups():
        with suppress(OSError, ValueError, StopIteration):
            limit = int(_first(folder, "memory.max", "memory.limit_in_bytes"))
            used = int(_first(folder, "memory.current", "memory.usage_in_bytes"))
            lines = (folder / "memory.stat").read_text().splitlines()
            files = next(int(x.split()[1]) for x in lines if x.startswith("inactive_file "))
            limits.append(limit)
            free.append(max(0, limit - (used - files)))  # what is cached of files is given back
    return min(limits) / _MB, min(free) / _MB


class ChildMemoryMonitor:
    """Memory of the processes that this one starts; its own is in the stages' records."""

    def __init__(self) -> None:
        self.peak_mb = 0.0

    @contextmanager
    def watching(self) -> Iterator[None]:
        """Look every second while this lasts."""
        ended = threading.Event()
        thread = threading.Thread(target=self._watch, args=(ended,), name="mpsfm memory")
        thread.start()
        try:
            yield
        finally:
            ended.set()
            thread.join()

    def _watch(self, ended: threading.Event) -> None:
        own = psutil.Process()
        while not ended.wait(_EVERY_S):
            resident = 0
            with suppress(psutil.Error):
                for child in own.children(recursive=True):
                    with suppress(psutil.Error):
                        resident += child.memory_info().rss
            self.peak_mb = max(self.peak_mb, resident / _MB)


def folder_mb(folder: Path) -> float:
    """Megabytes of the files below a folder."""
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file()) / _MB


def _control_groups() -> Iterator[Path]:
    """Folders of the control groups of this process, as far up as they are seen here."""
    with suppress(OSError):
        for line in Path("/proc/self/cgroup").read_text().splitlines():
            _, controllers, path = line.split(":", 2)
            if controllers in ("", "memory"):
                root = _GROUPS / "memory" if controllers else _GROUPS
                own = root / path.lstrip("/")
                yield own
                yield from (parent for parent in own.parents if parent.is_relative_to(root))


def _first(folder: Path, *names: str) -> str:
    return next((folder / name).read_text() for name in names if (folder / name).is_file())


def _room_mb(folder: Path) -> float:
    return shutil.disk_usage(_existing(folder)).free / _MB


def _same_disk(a: Path, b: Path) -> bool:
    return _existing(a).stat().st_dev == _existing(b).stat().st_dev


def _existing(folder: Path) -> Path:
    """The folder, or the nearest above it that is there."""
    folder = folder.resolve()
    return next(path for path in (folder, *folder.parents) if path.exists())


def _keypoints(config: Config) -> int:
    """Of a photo, at most."""
    options = {} if config.features is None else config.features.options
    return int(options.get("max_keypoints") or _USUAL_KEYPOINTS)


def _pairs(count: int, config: Config) -> int:
    """Pairs that are matched, at most."""
    pairs, every = config.pairs, count * (count - 1) // 2
    partners = {
        "exhaustive": count,
        "sequential": pairs.overlap,
        "retrieval": pairs.top_k,
        "auto": pairs.partners + pairs.overlap,
    }
    return min(every, count * partners[pairs.mode])
