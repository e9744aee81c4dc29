"""Tests of estimated memory and disk space, and of runs for which they are too small."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import psutil
import pytest

from mpsfm_core.config import Config, FastPass, RuntimeOptions
from mpsfm_core.data.errors import InputError
from mpsfm_core.inputs.images import ImageSet
from mpsfm_core.pipeline.resources import (
    MAX_RATIO,
    ResourceEstimate,
    estimate_resources,
    find_shortages,
    measure_weights,
    reduce_workers,
)
from mpsfm_core.pipeline.run import reconstruct
from mpsfm_core.providers import WeightsFile
from mpsfm_core.providers.provider_config import ProviderConfig
from mpsfm_core.providers.weights import WeightStore
from mpsfm_core.support.control_groups import ControlGroups
from mpsfm_core.support.memory import measure_memory

SIZE = (640, 480)
SIFT = ProviderConfig(use="sift", options={"max_keypoints": 4096, "resize": 3200})
NEAREST = ProviderConfig(use="mutual-nearest")
MB = 1 << 20


def make_config(**changes: object) -> Config:
    values = {
        "features": ProviderConfig(use="sift", options={"max_keypoints": 1000, "resize": 3200}),
        "matcher": NEAREST,
        "depth": ProviderConfig(use="flat"),
        "normals": ProviderConfig(use="from-depth"),
        "runtime": RuntimeOptions(workers=1),
    }
    return Config(**values | changes)


def test_estimate_grows_with_images_pixels_and_outputs() -> None:
    few, many = (estimate_resources([SIZE] * n, make_config(), ()) for n in (10, 100))
    assert many.memory_mb > few.memory_mb + 90 * 2 and many.cache_mb > 9 * few.cache_mb
    large = estimate_resources([(1280, 960)] * 10, make_config(), ())
    assert large.memory_mb > few.memory_mb
    sparse = estimate_resources([SIZE] * 100, make_config(dense={"enabled": False}), ())
    assert sparse.memory_mb < many.memory_mb and sparse.output_mb < many.output_mb


def test_estimate_of_many_images_is_small_because_priors_are_on_disk() -> None:
    config = make_config(dense={"enabled": False})
    few, many, most = (
        estimate_resources([SIZE] * n, config, ()).memory_mb for n in (100, 1000, 5000)
    )
    assert 0.5 < (most - many) / 4000 < 1 < few / 100


def test_estimate_counts_workers_and_networks_of_each_worker() -> None:
    def memory_mb(workers: int, *networks: int) -> float:
        return estimate_resources([(1920, 1080)] * 10, make_config(), networks, workers).memory_mb

    assert memory_mb(4) > memory_mb(1) + 3 * 500
    assert memory_mb(2, 600 * MB) - memory_mb(1, 600 * MB) == 4 * 600


@pytest.mark.parametrize(
    ("megapixels", "workers", "measured_mb"),
    # Three photos of each size with the configuration "sift", peak resident memory.
    [
        (3, 1, 1161),
        (3, 4, 2812),
        (12, 1, 2323),
        (12, 16, 6735),
        (24, 4, 6189),
        (48, 1, 2641),
        (108, 1, 5472),
    ],
)
def test_estimate_agrees_with_measured_peak(
    megapixels: float, workers: int, measured_mb: float
) -> None:
    size = (round(1500 * (megapixels / 1.5) ** 0.5), round(1000 * (megapixels / 1.5) ** 0.5))
    config = make_config(features=SIFT, fast_pass=FastPass(features=SIFT, matcher=NEAREST))
    estimate = estimate_resources([size] * 3, config, (), workers)
    assert estimate.memory_mb == pytest.approx(measured_mb, rel=0.25)


def test_estimate_of_large_images_is_limited_by_what_the_detector_sees() -> None:
    medium, large = ([(side, side * 2 // 3)] * 3 for side in (3200, 8485))
    difference = (
        estimate_resources(large, make_config(), ()).memory_mb
        - estimate_resources(medium, make_config(), ()).memory_mb
    )
    assert difference < 600  # decoded images only


def test_estimate_of_few_images_keeps_few_workers_busy() -> None:
    images = [(4000, 3000)] * 3
    three, eight = (estimate_resources(images, make_config(), (), n) for n in (3, 8))
    assert eight == three


def estimate_by_workers(workers: int) -> ResourceEstimate:
    return ResourceEstimate(500.0 + 1000 * workers, 0, 0)


@pytest.mark.parametrize(
    ("free_mb", "workers"), [(9000, 4), (4500, 4), (4400, 3), (2500, 2), (1600, 1), (100, 1)]
)
def test_reduce_workers_takes_as_many_as_fit(free_mb: float, workers: int) -> None:
    assert reduce_workers(estimate_by_workers, 4, free_mb) == workers


def test_measure_weights_includes_external_data(tmp_path: Path) -> None:
    store = WeightStore(tmp_path / "cache", offline=True)
    path = tmp_path / "large.onnx"
    path.write_bytes(bytes(10))
    assert measure_weights(WeightsFile(str(path), size=1), store) == 10
    path.with_name("large.onnx.data").write_bytes(bytes(2000))
    assert measure_weights(WeightsFile(str(path)), store) == 2010
    absent = WeightsFile("https://example.com/a.onnx", size=300)
    assert measure_weights(absent, store) == 300
    assert measure_weights(WeightsFile("https://example.com/b.onnx"), store) == 0


@pytest.fixture
def set_memory(monkeypatch: pytest.MonkeyPatch) -> Callable[[float, float], None]:
    """Pretend a machine with total and free memory in MB, and 1000 MB of free disk space."""

    def apply(total_mb: float, available_mb: float) -> None:
        memory = SimpleNamespace(total=total_mb * MB, available=available_mb * MB)
        monkeypatch.setattr(psutil, "virtual_memory", lambda: memory)
        disk = SimpleNamespace(free=1000 * MB)
        monkeypatch.setattr("shutil.disk_usage", lambda folder: disk)

    return apply


def test_find_shortages_of_a_run_that_fits_is_empty(set_memory, tmp_path: Path) -> None:
    set_memory(8000, 2000)
    assert find_shortages(ResourceEstimate(1900, 400, 400), tmp_path, tmp_path / "out") == []


def test_find_shortages_names_memory_and_disks_that_are_short(set_memory, tmp_path: Path) -> None:
    set_memory(8000, 2000)
    (memory,) = find_shortages(ResourceEstimate(9000, 0, 0), tmp_path, tmp_path / "out")
    assert "takes about 9000 MB of memory, but 2000 MB are free" in memory
    disks = find_shortages(ResourceEstimate(100, 1100, 1100), tmp_path, tmp_path / "out")
    assert len(disks) == 2 and "the cache" in disks[0] and "the results" in disks[1]


@pytest.mark.parametrize(
    "estimate", [ResourceEstimate(16_100, 0, 0), ResourceEstimate(100, 0, 2100)]
)
def test_find_shortages_refuses_a_run_that_cannot_fit(
    set_memory, estimate: ResourceEstimate, tmp_path: Path
) -> None:
    set_memory(8000, 2000)
    with pytest.raises(InputError, match=r"MB.*runtime\.check_resources=false"):
        find_shortages(estimate, tmp_path, tmp_path / "out")


def test_measure_memory_respects_limits_of_containers(tmp_path: Path) -> None:
    (tmp_path / "memory.max").write_text(f"{500 * MB}\n")
    (tmp_path / "memory.current").write_text(f"{300 * MB}\n")
    (tmp_path / "memory.stat").write_text(f"anon 1\ninactive_file {100 * MB}\n")
    (tmp_path / "membership").write_text("0::/\n")
    groups = ControlGroups(tmp_path, tmp_path / "membership")
    assert measure_memory(groups) == (500.0, 300.0)
    (tmp_path / "memory.max").write_text("max\n")
    assert measure_memory(groups)[0] > 500


@pytest.fixture
def photos(tmp_path: Path) -> Path:
    folder = tmp_path / "photos"
    folder.mkdir()
    for number in range(3):
        cv2.imwrite(str(folder / f"{number}.png"), np.zeros((900, 1200, 3), np.uint8))
    return folder


def test_run_that_cannot_fit_ends_before_an_image_is_decoded(
    photos: Path, set_memory, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    decoded: list[int] = []
    monkeypatch.setattr(ImageSet, "view", lambda self, index: decoded.append(index))
    set_memory(100, 100)
    runtime = RuntimeOptions(workers=1, cache_dir=tmp_path / "cache")
    with pytest.raises(
        InputError,
        match=r"this run takes about \d+ MB of memory, but .* 100 MB",
    ):
        reconstruct(photos, tmp_path / "out", make_config(runtime=runtime))
    assert not decoded and not (tmp_path / "out").exists()


def test_run_that_fits_with_fewer_workers_is_not_refused(
    photos: Path, set_memory, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Decoded(Exception):
        """Raised to end the run at the first image."""

    def stop(images: ImageSet, index: int) -> None:
        raise Decoded

    monkeypatch.setattr(ImageSet, "view", stop)
    set_memory(500, 500)
    runtime = RuntimeOptions(workers=3, cache_dir=tmp_path / "cache")
    estimates = [
        estimate_resources([(1200, 900)] * 3, make_config(), (), n).memory_mb for n in (1, 3)
    ]
    assert estimates[0] < 500 * MAX_RATIO < estimates[1]
    with pytest.raises(Decoded):
        reconstruct(photos, tmp_path / "out", make_config(runtime=runtime))
