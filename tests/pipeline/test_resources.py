"""What a run is said to take, and what happens where that is not there."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from mpsfm_core.config import Config, RuntimeOptions
from mpsfm_core.data.errors import InputError
from mpsfm_core.inputs.images import ImageSet
from mpsfm_core.pipeline import resources
from mpsfm_core.pipeline import run as pipeline
from mpsfm_core.pipeline.resources import ResourceEstimate, estimate_resources, shortages
from mpsfm_core.providers import WeightsFile
from mpsfm_core.providers.provider_config import ProviderConfig
from mpsfm_core.providers.weights import WeightStore

SIZE = (640, 480)


def config(**changes: object) -> Config:
    values = {
        "features": ProviderConfig(use="sift", options={"max_keypoints": 1000}),
        "matcher": ProviderConfig(use="mutual-nearest"),
        "depth": ProviderConfig(use="flat"),
        "normals": ProviderConfig(use="from-depth"),
        "runtime": RuntimeOptions(workers=1),
    }
    return Config(**values | changes)


def test_what_a_run_takes_grows_with_what_it_is_given() -> None:
    few, many = (estimate_resources([SIZE] * count, config(), (), ()) for count in (10, 100))
    assert many.memory_mb > few.memory_mb + 90 * 15 and many.cache_mb > 9 * few.cache_mb
    large = estimate_resources([(1280, 960)] * 10, config(), (), ())
    assert large.memory_mb > few.memory_mb
    sparse = estimate_resources([SIZE] * 100, config(dense={"enabled": False}), (), ())
    assert sparse.memory_mb < many.memory_mb and sparse.output_mb < many.output_mb
    maps = estimate_resources([SIZE] * 100, config(results={"dense_cloud": False}), (), ())
    assert maps.memory_mb < many.memory_mb and maps.output_mb < many.output_mb
    pairs = estimate_resources([SIZE] * 100, config(pairs={"mode": "sequential"}), (), ())
    assert pairs.cache_mb < many.cache_mb
    workers = estimate_resources([SIZE] * 10, config(runtime=RuntimeOptions(workers=4)), (), ())
    network = estimate_resources([SIZE] * 10, config(), (), [200 << 20])
    assert workers.memory_mb > few.memory_mb and network.memory_mb == few.memory_mb + 720


def test_the_size_of_a_network_is_that_of_its_files(tmp_path: Path) -> None:
    store = WeightStore(tmp_path / "cache", offline=True)
    path = tmp_path / "large.onnx"
    path.write_bytes(bytes(10))
    assert resources.network_bytes(WeightsFile(str(path), size=1), store) == 10
    path.with_name("large.onnx.data").write_bytes(bytes(2000))
    assert resources.network_bytes(WeightsFile(str(path)), store) == 2010
    absent = WeightsFile("https://example.com/a.onnx", size=300)
    assert resources.network_bytes(absent, store) == 300
    assert resources.network_bytes(WeightsFile("https://example.com/b.onnx"), store) == 0


@pytest.fixture
def machine(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(resources, "memory_mb", lambda: (8000.0, 2000.0))
    monkeypatch.setattr(resources, "_room_mb", lambda folder: 1000.0)


@pytest.mark.usefixtures("machine")
def test_a_run_that_fits_is_silent_and_one_that_may_not_is_told(tmp_path: Path) -> None:
    assert shortages(ResourceEstimate(1900, 400, 400), tmp_path, tmp_path / "out") == []
    (memory,) = shortages(ResourceEstimate(9000, 0, 0), tmp_path, tmp_path / "out")
    assert "takes about 9000 MB of memory and 2000 MB are free" in memory
    together = shortages(ResourceEstimate(100, 600, 600), tmp_path, tmp_path / "out")
    assert len(together) == 2 and "the cache" in together[0] and "the results" in together[1]


@pytest.mark.usefixtures("machine")
@pytest.mark.parametrize("needs", [ResourceEstimate(10_500, 0, 0), ResourceEstimate(100, 0, 1400)])
def test_a_run_that_cannot_fit_is_refused(needs: ResourceEstimate, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"MB are .*runtime\.check_resources=false"):
        shortages(needs, tmp_path, tmp_path / "out")


def test_limits_of_a_container_count(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "memory.max").write_text(f"{500 << 20}\n")
    (tmp_path / "memory.current").write_text(f"{300 << 20}\n")
    (tmp_path / "memory.stat").write_text(f"anon 1\ninactive_file {100 << 20}\n")
    monkeypatch.setattr(resources, "_control_groups", lambda: iter([tmp_path]))
    assert resources.memory_mb() == (500.0, 300.0)
    (tmp_path / "memory.max").write_text("max\n")
    assert resources.memory_mb()[0] > 500


def test_no_photo_is_decoded_by_a_run_that_cannot_fit(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    photos = tmp_path / "photos"
    photos.mkdir()
    for number in range(2):
        cv2.imwrite(str(photos / f"{number}.png"), np.zeros((20, 30, 3), np.uint8))
    decoded: list[int] = []
    monkeypatch.setattr(ImageSet, "view", lambda self, index: decoded.append(index))
    monkeypatch.setattr(resources, "memory_mb", lambda: (100.0, 100.0))
    runtime = RuntimeOptions(workers=1, cache_dir=tmp_path / "cache")
    with pytest.raises(InputError, match=r"this run takes about \d+ MB of memory and 100 MB"):
        pipeline.reconstruct(photos, tmp_path / "out", config(runtime=runtime))
    assert not decoded and not (tmp_path / "out").exists()
