"""Tests of extraction stages on remote workers, with an executor in this process.

The tests of mpsfm-dask and mpsfm-ray use real clusters.
"""

from __future__ import annotations

import pickle
from collections.abc import Callable, Generator, Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import pytest

from mpsfm_core import hookimpl
from mpsfm_core.config import Config, RuntimeOptions
from mpsfm_core.data import PinholeCamera
from mpsfm_core.data.errors import (
    ConfigError,
    DataError,
    InputError,
    ProviderOutputError,
    ReconstructionError,
)
from mpsfm_core.extraction.remote_execution import RemoteStep
from mpsfm_core.extraction.runner import Extraction, extract
from mpsfm_core.inputs.images import load_images
from mpsfm_core.providers.provider_config import ProviderConfig
from mpsfm_core.providers.registry import Registry
from mpsfm_core.testing.contract_case import describe_difference
from mpsfm_core.testing.synthetic.scenes import arc_poses, room_scene

CAMERA = PinholeCamera(160, 120, 140.0, 140.0, 80.0, 60.0)


class Pickled:
    """Executor that processes items from a pickled step, like another process."""

    def __init__(self) -> None:
        self.stages: dict[str, int] = {}
        self.closed = False
        self.another_cache: Path | None = None

    def run(self, step: Callable[[Any], None], items: Sequence[Any]) -> Generator[None, None, None]:
        arrived = pickle.loads(pickle.dumps(step))
        assert isinstance(arrived, RemoteStep)
        self.stages[arrived.stage] = len(items)
        if self.another_cache is not None:
            runtime = arrived.config.runtime.model_copy(update={"cache_dir": self.another_cache})
            config = arrived.config.model_copy(update={"runtime": runtime})
            arrived = RemoteStep(arrived.run, arrived.stage, arrived.images, config)
        for item in items:
            arrived(item)
            yield

    def close(self) -> None:
        self.closed = True


class Plugin:
    def __init__(self) -> None:
        self.executor = Pickled()

    @hookimpl
    def mpsfm_executor(self, name: str, options: Mapping[str, Any]) -> Pickled | None:
        return self.executor if name == "pickled" else None


@pytest.fixture
def plugin() -> Plugin:
    return Plugin()


@pytest.fixture
def run(tmp_path: Path, plugin: Plugin) -> Callable[..., Extraction]:
    (tmp_path / "photos").mkdir()
    for number, pose in enumerate(arc_poses(3, 10.0)):
        rgb = room_scene().render(CAMERA, pose).rgb
        cv2.imwrite(str(tmp_path / "photos" / f"{number}.png"), rgb[..., ::-1])
    registry = Registry.discover()
    registry.register(plugin, name="pickled")

    def run(executor: str, **changes: Any) -> Extraction:
        runtime = RuntimeOptions(cache_dir=tmp_path / executor, workers=2, executor=executor)
        values: dict[str, Any] = {
            "features": ProviderConfig(use="sift"),
            "matcher": ProviderConfig(use="mutual-nearest"),
            "depth": ProviderConfig(use="flat"),
            "normals": ProviderConfig(use="from-depth"),
            "runtime": runtime,
        }
        images = load_images(tmp_path / "photos")
        return extract(images, Config(**values | changes), registry)

    return run


def test_executor_results_equal_results_of_threads(
    run: Callable[..., Extraction], plugin: Plugin
) -> None:
    here, there = run("threads"), run("pickled")
    assert not describe_difference(here.problem, there.problem)
    executor = plugin.executor
    assert executor.stages["features"] == 3 and executor.stages["matching"] == 3
    assert executor.closed
    assert all(line["computed"] == 0 for line in there.report["providers"] if line["from_cache"])


def test_executor_computes_masks_and_retrieval(
    run: Callable[..., Extraction], plugin: Plugin
) -> None:
    changes = {
        "masks": (ProviderConfig(use="sky-simple"),),
        "retrieval": ProviderConfig(use="appearance"),
        "pairs": {"mode": "retrieval", "top_k": 1},
    }
    here, there = run("threads", **changes), run("pickled", **changes)
    assert not describe_difference(here.problem, there.problem)
    assert plugin.executor.stages["masks"] == plugin.executor.stages["retrieval"] == 3


def test_executor_without_shared_cache_is_an_input_error(
    run: Callable[..., Extraction], plugin: Plugin, tmp_path: Path
) -> None:
    plugin.executor.another_cache = tmp_path / "elsewhere"
    with pytest.raises(InputError, match=r"does not see the cache .*runtime\.cache_dir"):
        run("pickled")
    assert plugin.executor.closed


@pytest.mark.parametrize(
    ("name", "hint"), [("dask", "pip install mpsfm-dask"), ("thread", "did you mean 'threads'")]
)
def test_unknown_executor_is_a_config_error(
    run: Callable[..., Extraction], monkeypatch: pytest.MonkeyPatch, name: str, hint: str
) -> None:
    monkeypatch.setattr(Registry, "hook", _NoHook())
    with pytest.raises(ConfigError, match=hint):
        run(name)


class _NoHook:
    @staticmethod
    def mpsfm_executor(name: str, options: Mapping[str, Any]) -> None:
        return None


@pytest.mark.parametrize(
    "error",
    [
        DataError("depth", "is NaN"),
        ProviderOutputError("name", "photo.jpg", "depth", "is NaN"),
        ReconstructionError("none", {"status": "failed"}),
    ],
)
def test_errors_survive_pickling(error: Exception) -> None:
    arrived = pickle.loads(pickle.dumps(error))
    assert type(arrived) is type(error) and str(arrived) == str(error)
    assert vars(arrived) == vars(error)
