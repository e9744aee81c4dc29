"""What an executor has to keep to, as checks for the tests of a plugin that brings one."""

from __future__ import annotations

import os
import shutil
import signal
import sys
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2

from mpsfm_core.config import Config, RuntimeOptions
from mpsfm_core.data import PinholeCamera
from mpsfm_core.data.errors import ConfigError, DataError, ProviderRunError
from mpsfm_core.extraction.events import NullExtractionEvents
from mpsfm_core.extraction.runner import Extraction, extract
from mpsfm_core.inputs.images import load_images
from mpsfm_core.providers import Executor
from mpsfm_core.providers.provider_config import ProviderConfig
from mpsfm_core.providers.registry import Registry
from mpsfm_core.testing.contract_case import describe_difference
from mpsfm_core.testing.synthetic.scenes import arc_poses, room_scene

_CAMERA = PinholeCamera(320, 240, 280.0, 280.0, 160.0, 120.0)
_INTRINSICS = "1: {params: [280, 280, 160, 120], images: all}"
_COUNT = 4


@dataclass(frozen=True)
class _Leaves:
    """A step that leaves a file, with the number of its process, for each item."""

    folder: Path

    def __call__(self, item: int) -> None:
        (self.folder / f"{item}-{os.getpid()}").touch()


@dataclass(frozen=True)
class _Dies(_Leaves):
    """A step whose first worker is lost in the middle of an item."""

    def __call__(self, item: int) -> None:
        if item == 3:
            try:
                (self.folder / "lost").mkdir()
            except FileExistsError:
                pass
            else:
                os.kill(os.getpid(), signal.SIGKILL)
        super().__call__(item)


def _fails(item: int) -> None:
    if item == 2:
        raise DataError("item", "is 2")


def check_items(executor: Executor, folder: Path) -> None:
    """Every item is done once, by more than one process that is not this one."""
    folder.mkdir()
    assert sum(1 for _ in executor.run(_Leaves(folder), range(40))) == 40
    done = [path.name.split("-") for path in folder.iterdir()]
    assert sorted(int(item) for item, _ in done) == list(range(40))
    processes = {process for _, process in done}
    assert len(processes) > 1 and str(os.getpid()) not in processes


def check_lost_worker(executor: Executor, folder: Path) -> None:
    """What a killed worker had begun is done by another."""
    folder.mkdir()
    assert sum(1 for _ in executor.run(_Dies(folder), range(8))) == 8
    assert (folder / "lost").exists()
    assert {path.name.split("-")[0] for path in folder.glob("*-*")} == set(map(str, range(8)))


def check_errors(executor: Executor) -> None:
    """An error of a step arrives as it was raised, and the executor can be used again."""
    try:
        with closing(executor.run(_fails, range(4))) as run:
            for _ in run:
                pass
    except DataError as error:
        assert (error.field, error.rule) == ("item", "is 2")
    else:
        raise AssertionError("the error did not arrive")
    assert sum(1 for _ in executor.run(_fails, [0, 1])) == 2


def check_extraction(name: str, options: dict[str, Any], folder: Path) -> None:
    """An extraction gives what threads give, bit for bit; Ctrl-C ends it, and what was done stays;
    a worker that does not see the cache says so."""
    _make_photos(folder)
    here = _extract(folder, RuntimeOptions(cache_dir=folder / "here", workers=2))
    runtime = RuntimeOptions(
        cache_dir=folder / "there", workers=2, executor=name, executor_options=options
    )
    try:
        with _hearing_ctrl_c():
            _extract(folder, runtime, _CtrlC())
    except KeyboardInterrupt:
        pass
    else:
        raise AssertionError("Ctrl-C was not heard")
    watch = _Watch()
    there = _extract(folder, runtime, watch)
    assert not (found := describe_difference(here.problem, there.problem)), found
    assert _entries(folder / "here") == _entries(folder / "there")
    pairs = _COUNT * (_COUNT - 1) // 2
    assert watch.done["features"] == _COUNT and watch.done["matching"] == pairs
    used = {line["kind"]: line["computed"] for line in there.report["providers"]}
    assert not used["matcher"], "this process matched itself"


def check_failing_provider(name: str, options: dict[str, Any], folder: Path) -> None:
    """A provider that fails on a photo, or hangs, is asked about it once, by a worker; the rule is
    that of threads: the run ends and names it, or goes on without the photo and lists it."""
    _make_photos(folder)
    with _installed(folder):
        runtime = RuntimeOptions(
            cache_dir=folder / "cache",
            workers=2,
            executor=name,
            executor_options=options,
        )
        try:
            _extract(folder, runtime, depth="shaky")
        except ProviderRunError as error:
            assert "'shaky'" in str(error)
        else:
            raise AssertionError("the provider's error did not end the run")
        for mark in folder.glob("asked-*"):
            mark.unlink()
        shutil.rmtree(folder / "cache" / "extraction" / "depth", ignore_errors=True)
        (folder / "hang").touch()  # all that takes time is in the cache now
        skipping = runtime.model_copy(update={"on_error": "skip", "timeout_s": _TIMEOUT_S})
        found = _extract(folder, skipping, depth="shaky")
    reasons = found.report["failed"]
    assert list(reasons) == ["1.png", "2.png"], reasons
    assert "ZeroDivisionError" in reasons["1.png"]
    assert f"no answer within {_TIMEOUT_S:g} s" in reasons["2.png"]
    valid = [image.depth.valid.any() for image in found.problem.images]
    assert valid == [True, False, False, True]
    asked = [path.name.split("-")[1:] for path in folder.glob("asked-*")]
    for photo in reasons:
        processes = [process for asked_photo, process in asked if asked_photo == photo]
        assert len(processes) == 1 and processes[0] != str(os.getpid()), (photo, processes)


_TIMEOUT_S = 10.0
_SHAKY = """
import os, time
from pathlib import Path
import numpy as np
from mpsfm_core import DepthPrior, ProviderSpec, hookimpl

class Shaky:
    def __init__(self, options, context): pass

    def predict(self, view):
        Path({folder!r}, f"asked-{{view.name}}-{{os.getpid()}}").touch()
        if view.name == "1.png":
            raise ZeroDivisionError("in the network")
        if view.name == "2.png" and Path({folder!r}, "hang").exists():
            time.sleep(600)
        return DepthPrior.from_arrays(np.full(view.image.shape[:2], 3.0, np.float32))

@hookimpl
def mpsfm_providers():
    return [ProviderSpec(kind="depth", name="shaky", factory=Shaky)]
"""


@contextmanager
def _installed(folder: Path) -> Iterator[None]:
    """While this lasts, a plugin that fails is installed, here and for processes started here."""
    site, name = folder / "site", "mpsfm_shaky"
    about = site / f"{name}-1.0.dist-info"
    about.mkdir(parents=True)
    (site / f"{name}.py").write_text(_SHAKY.format(folder=str(folder)), encoding="utf-8")
    (about / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n")
    (about / "entry_points.txt").write_text(f"[mpsfm.plugins]\nshaky = {name}\n")
    before = os.environ.get("PYTHONPATH")
    os.environ["PYTHONPATH"] = os.pathsep.join([str(site), *([before] if before else [])])
    sys.path.insert(0, str(site))
    try:
        yield
    finally:
        sys.path.remove(str(site))
        sys.modules.pop(name, None)
        if before is None:
            del os.environ["PYTHONPATH"]
        else:
            os.environ["PYTHONPATH"] = before


class _Watch(NullExtractionEvents):
    def __init__(self) -> None:
        self.done: dict[str, int] = {}

    def stage_progress(self, stage: str, done: int, total: int) -> None:
        assert done == self.done.get(stage, 0) + 1 and done <= total
        self.done[stage] = done


@contextmanager
def _hearing_ctrl_c() -> Iterator[None]:
    """Where tests run side by side their processes are told to ignore it."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


class _CtrlC(NullExtractionEvents):
    def stage_progress(self, stage: str, done: int, total: int) -> None:
        if stage == "matching":
            signal.raise_signal(signal.SIGINT)


def _make_photos(folder: Path) -> None:
    photos = folder / "photos"
    photos.mkdir(parents=True)
    scene = room_scene()
    for number, pose in enumerate(arc_poses(_COUNT, 10.0)):
        cv2.imwrite(str(photos / f"{number}.png"), scene.render(_CAMERA, pose).rgb[..., ::-1])
    (folder / "intrinsics.yaml").write_text(_INTRINSICS, encoding="utf-8")


def _extract(
    folder: Path,
    runtime: RuntimeOptions,
    events: NullExtractionEvents | None = None,
    depth: str = "flat",
) -> Extraction:
    config = Config(
        features=ProviderConfig(use="sift"),
        matcher=ProviderConfig(use="mutual-nearest"),
        depth=ProviderConfig(use=depth),
        normals=ProviderConfig(use="from-depth"),
        runtime=runtime,
    )
    images = load_images(folder / "photos", folder / "intrinsics.yaml", None, config.inputs)
    return extract(images, config, Registry.discover(), events)


def _entries(cache: Path) -> dict[str, bytes]:
    """What a cache holds, without the marks of runs."""
    root = cache / "extraction"
    kinds = ("features", "matcher", "normals", "depth")
    return {
        str(path.relative_to(root)): path.read_bytes()
        for kind in kinds
        for path in (root / kind).rglob("*.npz")
    }


def check_options(executor: Any) -> None:
    """``executor(options)`` refuses what it does not know, with the place in the configuration."""
    try:
        executor({"adress": "here"})
    except ConfigError as error:
        assert "runtime.executor_options.adress" in str(error) and "address" in str(error)
    else:
        raise AssertionError("a wrong option was accepted")
