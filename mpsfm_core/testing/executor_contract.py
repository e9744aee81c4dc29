"""Contract checks for plugins with an executor, which distributes work to processes."""

from __future__ import annotations

import json
import os
import shutil
import signal
import socket
import sys
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2

from mpsfm_core.config import Config, RuntimeOptions
from mpsfm_core.data import PinholeCamera
from mpsfm_core.data.errors import ConfigError, DataError, ProviderRunError
from mpsfm_core.dense.densify import densify
from mpsfm_core.dense.options import DenseOptions
from mpsfm_core.extraction.cache import digest
from mpsfm_core.extraction.events import NullExtractionEvents
from mpsfm_core.extraction.executors import open_executor
from mpsfm_core.extraction.runner import Extraction, extract
from mpsfm_core.inputs.images import load_images
from mpsfm_core.mapping.options import MapperOptions
from mpsfm_core.mapping.parts import part_mapping
from mpsfm_core.pipeline.checkpoints import DenseCheckpoints
from mpsfm_core.pipeline.parts import PartMapper
from mpsfm_core.pipeline.remote_stereo import MatchStereo, RemoteStereo
from mpsfm_core.pipeline.stages import Stages
from mpsfm_core.providers import Executor
from mpsfm_core.providers.provider_config import ProviderConfig
from mpsfm_core.providers.registry import Registry
from mpsfm_core.testing.contract_case import describe_difference
from mpsfm_core.testing.posed_room import make_posed_room
from mpsfm_core.testing.synthetic.halls import make_hall_problem
from mpsfm_core.testing.synthetic.scenes import arc_poses, room_scene

_CAMERA = PinholeCamera(320, 240, 280.0, 280.0, 160.0, 120.0)
_INTRINSICS = "1: {params: [280, 280, 160, 120], images: all}"
_NUM_IMAGES = 4


@dataclass(frozen=True)
class _WriteMarker:
    """Test step that writes one file per work item, named after the item and the process id."""

    folder: Path

    def __call__(self, item: int) -> None:
        (self.folder / f"{item}-{os.getpid()}").touch()


@dataclass(frozen=True)
class _KillFirstWorker(_WriteMarker):
    """Test step that kills the first worker process in the middle of a work item."""

    def __call__(self, item: int) -> None:
        if item == 3:
            _kill_once(self.folder)
        super().__call__(item)


@dataclass(frozen=True)
class _KillingExecutor:
    """Executor whose workers run a step on an image, except that the first worker is killed."""

    executor: Executor
    folder: Path

    def run(self, step: Callable[[Any], None], items: Sequence[Any]) -> Generator[None, None, None]:
        return self.executor.run(_KillFirstImage(self.folder, step), items)

    def close(self) -> None:
        self.executor.close()


@dataclass(frozen=True)
class _KillFirstImage:
    """Test step that kills the worker process of the first image, and records the others."""

    folder: Path
    step: Callable[[Any], None]

    def __call__(self, item: tuple[str, Sequence[str]]) -> None:
        _kill_once(self.folder)
        self.step(item)
        (self.folder / f"{item[0]}-{os.getpid()}").touch()


def _kill_once(folder: Path) -> None:
    """Kill this process, unless another process has been killed with the same folder."""
    try:
        (folder / "lost").mkdir()
    except FileExistsError:
        return
    os.kill(os.getpid(), signal.SIGKILL)


class _KillFirstPartWorker(Stages):
    """Receiver of progress that kills the worker of the first completed part."""

    def __init__(self, folder: Path) -> None:
        super().__init__(Registry())
        self._folder = folder
        self.killed = ""

    def stage_progress(self, stage: str, done: int, total: int) -> None:
        if done == 1:
            (record, *_) = self._folder.glob("mapping/parts/*.json")
            self.killed = json.loads(record.read_text(encoding="utf-8"))["worker"]
            os.kill(int(self.killed.rpartition(":")[2]), signal.SIGKILL)


def _fail_on_two(item: int) -> None:
    """Test step that raises an exception for the work item with index 2."""
    if item == 2:
        raise DataError("item", "is 2")


def check_items(executor: Executor, folder: Path) -> None:
    """Require that several worker processes together run every work item exactly once.

    Args:
        executor: Executor under test.
        folder: Folder that the check creates and that the workers can access.
    """
    folder.mkdir()
    num_finished = sum(1 for _ in executor.run(_WriteMarker(folder), range(40)))
    assert num_finished == 40, f"{num_finished} of 40 work items are reported as finished"
    done = [path.name.split("-") for path in folder.iterdir()]
    finished = sorted(int(item) for item, _ in done)
    assert finished == list(range(40)), "a work item is lost or runs twice"
    processes = {process for _, process in done}
    assert str(os.getpid()) not in processes, "work items run in the process of the caller"
    assert len(processes) > 1, "all work items run in one process"


def check_lost_worker(executor: Executor, folder: Path) -> None:
    """Require that another worker process runs the work item of a killed worker process.

    Args:
        executor: Executor under test.
        folder: Folder that the check creates and that the workers can access.
    """
    folder.mkdir()
    assert sum(1 for _ in executor.run(_KillFirstWorker(folder), range(8))) == 8
    assert (folder / "lost").exists()
    assert {path.name.split("-")[0] for path in folder.glob("*-*")} == set(map(str, range(8)))


def check_errors(executor: Executor) -> None:
    """Require that the exception of a worker reaches the caller and the executor stays usable."""
    try:
        with closing(executor.run(_fail_on_two, range(4))) as run:
            for _ in run:
                pass
    except DataError as error:
        assert (error.field, error.rule) == ("item", "is 2")
    else:
        raise AssertionError("the exception of the step did not reach the caller")
    assert sum(1 for _ in executor.run(_fail_on_two, [0, 1])) == 2


def check_mapping_in_parts(
    name: str, options: dict[str, Any], folder: Path, *, kills_worker: bool = False
) -> None:
    """Require that mapping in parts is bitwise equal on the executor and in this process.

    Args:
        name: Value of ``runtime.executor``.
        options: Value of ``runtime.executor_options``.
        folder: Folder that the check creates and that the workers can access.
        kills_worker: If true, kill the worker that has completed the first part.
    """
    problem = make_hall_problem(64, map_width=48, points_per_view=40).problem
    settings = MapperOptions(parts=20)
    runtime = RuntimeOptions(cache_dir=folder, workers=1, executor=name, executor_options=options)
    stages = _KillFirstPartWorker(folder) if kills_worker else Stages(Registry())
    part_mapper = PartMapper(runtime, Registry.discover(), stages)
    local = part_mapping.reconstruct(problem, settings)
    remote = part_mapping.reconstruct(problem, settings, map_parts=part_mapper)
    part_mapper.forget()
    assert len(part_mapper.records) >= 4
    workers = {record.worker for record in part_mapper.records}
    assert f"{socket.gethostname()}:{os.getpid()}" not in workers, "the main process mapped a part"
    if isinstance(stages, _KillFirstPartWorker):
        assert stages.killed in workers and len(workers) > 1
    expected, actual = ([digest(m) for m in r.reconstructions] for r in (local, remote))
    assert actual == expected, "mapping on the executor gives another result"
    remaining = [path for path in folder.rglob("*") if path.is_file()]
    assert not remaining, f"files of parts remain: {remaining}"


def check_dense_stage(name: str, options: dict[str, Any], folder: Path) -> None:
    """Require that dense depth maps are bitwise equal on the executor and in this process.

    Ctrl-C interrupts a first run, and a worker of the second run is killed.

    Args:
        name: Value of ``runtime.executor``.
        options: Value of ``runtime.executor_options``.
        folder: Folder that the check creates and that the workers can access.
    """
    room, dense, cache = make_posed_room(6), DenseOptions(), folder / "cache"
    images, model = room.write_images(folder / "photos"), room.reconstruction
    checkpoints = DenseCheckpoints(cache, model, [image.digest for image in images], dense)
    step = MatchStereo(images, dense, checkpoints, threads=1)
    local, _ = densify(model, images.view_of, dense)
    runtime = RuntimeOptions(executor=name, executor_options=options)
    finished: list[tuple[int, int]] = []
    with open_executor(runtime, Registry.discover()) as executor:
        assert executor is not None
        interrupted = RemoteStereo(
            executor, model, step, lambda done, total: signal.raise_signal(signal.SIGINT)
        )
        try:
            with _enable_keyboard_interrupt():
                densify(model, images.view_of, dense, match_remotely=interrupted)
        except KeyboardInterrupt:
            pass
        else:
            raise AssertionError("Ctrl-C did not end the dense stage")
        killing = _KillingExecutor(executor, folder)
        remote = RemoteStereo(
            killing, model, step, lambda done, total: finished.append((done, total))
        )
        actual, _ = densify(
            model, images.view_of, dense, checkpoints=checkpoints, match_remotely=remote
        )
    total = len(model.images)
    assert finished == [(done, total) for done in range(1, total + 1)]
    assert (folder / "lost").exists(), "no worker was killed"
    recorded = [path.name.rpartition("-") for path in folder.glob("*.png-*")]
    assert {image for image, _, _ in recorded} == set(images.names)
    assert str(os.getpid()) not in {process for _, _, process in recorded}
    assert digest(actual) == digest(local), "the executor gives other depth maps"
    checkpoints.forget()
    remaining = [path for path in cache.rglob("*") if path.is_file()]
    assert not remaining, f"files of the dense stage remain: {remaining}"


def check_extraction(name: str, options: dict[str, Any], folder: Path) -> None:
    """Require extraction bitwise equal to that with threads, also if Ctrl-C interrupts the run.

    Args:
        name: Value of ``runtime.executor``.
        options: Value of ``runtime.executor_options``.
        folder: Folder that the check creates and that the workers can access.
    """
    _write_images(folder)
    local = _extract(folder, RuntimeOptions(cache_dir=folder / "local", workers=2))
    runtime = RuntimeOptions(
        cache_dir=folder / "remote", workers=2, executor=name, executor_options=options
    )
    try:
        with _enable_keyboard_interrupt():
            _extract(folder, runtime, _InterruptEvents())
    except KeyboardInterrupt:
        pass
    else:
        raise AssertionError("Ctrl-C did not end the extraction")
    watch = _ProgressEvents()
    remote = _extract(folder, runtime, watch)
    assert not (found := describe_difference(local.problem, remote.problem)), found
    assert _read_cache(folder / "local") == _read_cache(folder / "remote")
    pairs = _NUM_IMAGES * (_NUM_IMAGES - 1) // 2
    assert watch.done["features"] == _NUM_IMAGES and watch.done["matching"] == pairs
    used = {line["kind"]: line["computed"] for line in remote.report["providers"]}
    assert not used["matcher"], "the main process matched pairs itself"


def check_failing_provider(name: str, options: dict[str, Any], folder: Path) -> None:
    """Require that a worker calls a provider that raises or hangs only once per image.

    As with the executor ``threads``, the run either stops and names the provider, or continues
    without the image and lists the image as failed.

    Args:
        name: Value of ``runtime.executor``.
        options: Value of ``runtime.executor_options``.
        folder: Folder that the check creates and that the workers can access.
    """
    _write_images(folder)
    with _install_failing_plugin(folder):
        runtime = RuntimeOptions(
            cache_dir=folder / "cache",
            workers=2,
            executor=name,
            executor_options=options,
        )
        try:
            _extract(folder, runtime, depth="failing")
        except ProviderRunError as error:
            assert "'failing'" in str(error)
        else:
            raise AssertionError("the provider's error did not end the run")
        for mark in folder.glob("called-*"):
            mark.unlink()
        shutil.rmtree(folder / "cache" / "extraction" / "depth", ignore_errors=True)
        (folder / "hang").touch()  # The results of all slow extraction steps are in the cache now.
        skipping = runtime.model_copy(update={"on_error": "skip", "timeout_s": _TIMEOUT_S})
        found = _extract(folder, skipping, depth="failing")
    reasons = found.report["failed"]
    assert list(reasons) == ["1.png", "2.png"], reasons
    assert "ZeroDivisionError" in reasons["1.png"]
    assert f"no answer within {_TIMEOUT_S:g} s" in reasons["2.png"]
    valid = [image.depth.valid.any() for image in found.problem.images]
    assert valid == [True, False, False, True]
    asked = [path.name.split("-")[1:] for path in folder.glob("called-*")]
    for photo in reasons:
        processes = [process for called_image, process in asked if called_image == photo]
        assert len(processes) == 1 and processes[0] != str(os.getpid()), (photo, processes)


_TIMEOUT_S = 10.0
_FAILING_PLUGIN = """
import os, time
from pathlib import Path
import numpy as np
from mpsfm_core import DepthPrior, ProviderSpec, hookimpl

class FailingDepth:
    def __init__(self, options, context): pass

    def predict(self, view):
        Path({folder!r}, f"called-{{view.name}}-{{os.getpid()}}").touch()
        if view.name == "1.png":
            raise ZeroDivisionError("in the network")
        if view.name == "2.png" and Path({folder!r}, "hang").exists():
            time.sleep(600)
        return DepthPrior.from_arrays(np.full(view.image.shape[:2], 3.0, np.float32))

@hookimpl
def mpsfm_providers():
    return [ProviderSpec(kind="depth", name="failing", factory=FailingDepth)]
"""


@contextmanager
def _install_failing_plugin(folder: Path) -> Iterator[None]:
    """Install a failing plugin for this process and for the processes that it starts."""
    site, name = folder / "site", "mpsfm_failing"
    about = site / f"{name}-1.0.dist-info"
    about.mkdir(parents=True)
    (site / f"{name}.py").write_text(_FAILING_PLUGIN.format(folder=str(folder)), encoding="utf-8")
    (about / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n")
    (about / "entry_points.txt").write_text(f"[mpsfm.plugins]\nfailing = {name}\n")
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


class _ProgressEvents(NullExtractionEvents):
    """Plugin that records the progress reports of each pipeline stage and verifies their counts."""

    def __init__(self) -> None:
        self.done: dict[str, int] = {}

    def stage_progress(self, stage: str, done: int, total: int) -> None:
        assert done == self.done.get(stage, 0) + 1 and done <= total
        self.done[stage] = done


@contextmanager
def _enable_keyboard_interrupt() -> Iterator[None]:
    """Restore the default SIGINT handler, which parallel test runners may disable."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


class _InterruptEvents(NullExtractionEvents):
    """Plugin that raises SIGINT as soon as matching has started."""

    def stage_progress(self, stage: str, done: int, total: int) -> None:
        if stage == "matching":
            signal.raise_signal(signal.SIGINT)


def _write_images(folder: Path) -> None:
    """Write rendered images and their intrinsics to a folder."""
    photos = folder / "photos"
    photos.mkdir(parents=True)
    scene = room_scene()
    for number, pose in enumerate(arc_poses(_NUM_IMAGES, 10.0)):
        cv2.imwrite(str(photos / f"{number}.png"), scene.render(_CAMERA, pose).rgb[..., ::-1])
    (folder / "intrinsics.yaml").write_text(_INTRINSICS, encoding="utf-8")


def _extract(
    folder: Path,
    runtime: RuntimeOptions,
    events: NullExtractionEvents | None = None,
    depth: str = "flat",
) -> Extraction:
    """Extract features, matches and priors of the rendered images with an executor."""
    config = Config(
        features=ProviderConfig(use="sift"),
        matcher=ProviderConfig(use="mutual-nearest"),
        depth=ProviderConfig(use=depth),
        normals=ProviderConfig(use="from-depth"),
        runtime=runtime,
    )
    images = load_images(folder / "photos", folder / "intrinsics.yaml", None, config.inputs)
    return extract(images, config, Registry.discover(), events)


def _read_cache(cache: Path) -> dict[str, bytes]:
    """Read the arrays that an extraction wrote to its cache, without the records of runs."""
    root = cache / "extraction"
    kinds = ("features", "matcher", "normals", "depth", "two-view")
    return {
        str(path.relative_to(root)): path.read_bytes()
        for kind in kinds
        for path in (root / kind).rglob("*.npz")
    }


def check_options(executor: Any) -> None:
    """Require that ``executor(options)`` rejects unknown options and names their path."""
    try:
        executor({"adress": "here"})
    except ConfigError as error:
        assert "runtime.executor_options.adress" in str(error) and "address" in str(error)
    else:
        raise AssertionError("the executor accepted an unknown option")
