"""Tests that no run keeps more threads busy than the thread limit, in any library."""

from __future__ import annotations

import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np
import pytest
from threadpoolctl import threadpool_info

from mpsfm_core import ProviderSpec
from mpsfm_core.config import Config, RuntimeOptions
from mpsfm_core.data import DepthPrior, PinholeCamera, View
from mpsfm_core.pipeline.run import reconstruct
from mpsfm_core.providers import ProviderContext
from mpsfm_core.providers.provider_config import ProviderConfig
from mpsfm_core.providers.registry import Registry
from mpsfm_core.support.threads import (
    count_cores,
    limit_threads,
    opencv_threads,
    parallel_map,
    thread_limit,
)
from mpsfm_core.testing.synthetic.scenes import arc_poses, room_scene

CAMERA = PinholeCamera(160, 120, 140.0, 140.0, 80.0, 60.0)
TASKS = Path("/proc/self/task")


class Busy:
    """Counter of threads that compute or wait for a core, sampled every few milliseconds.

    The count does not depend on the load of the machine.
    """

    def __init__(self) -> None:
        self.counts: list[int] = []
        self._ended = threading.Event()

    @contextmanager
    def watching(self) -> Iterator[None]:
        thread = threading.Thread(target=self._watch)
        thread.start()
        try:
            yield
        finally:
            self._ended.set()
            thread.join()

    def _watch(self) -> None:
        own = str(threading.get_native_id())
        while not self._ended.wait(0.003):
            states = [self._state(task) for task in TASKS.iterdir() if task.name != own]
            self.counts.append(states.count("R"))

    @staticmethod
    def _state(task: Path) -> str:
        try:
            return (task / "stat").read_text().rpartition(") ")[2][0]
        except OSError:  # it has ended
            return ""

    def share_above(self, count: int) -> float:
        """Return the ratio of samples with more than ``count`` busy threads."""
        return float(np.mean(np.array(self.counts) > count))


@pytest.fixture(scope="module")
def photos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("photos")
    for number, pose in enumerate(arc_poses(3, 10.0)):
        cv2.imwrite(str(folder / f"{number}.png"), room_scene().render(CAMERA, pose).rgb[..., ::-1])
    return folder


class Watcher:
    """Depth provider that records the thread limit of libraries in its process."""

    def __init__(self) -> None:
        self.seen: list[set[int]] = []

    def __call__(self, options: object, context: ProviderContext) -> Watcher:
        assert context.threads == 1
        return self

    def predict(self, view: View) -> DepthPrior:
        pools = {pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"}
        self.seen.append({cv2.getNumThreads(), *pools})
        return DepthPrior.from_arrays(np.full(view.image.shape[:2], 3.0, np.float32))


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="threads are read from /proc")
@pytest.mark.parametrize("workers", [1, 2])
def test_run_has_at_most_as_many_busy_threads_as_allowed(
    photos: Path, tmp_path: Path, workers: int
) -> None:
    busy, watcher, registry = Busy(), Watcher(), Registry.discover()
    registry.add(ProviderSpec(kind="depth", name="watcher", factory=watcher))
    config = Config(
        features=ProviderConfig(use="sift"),
        matcher=ProviderConfig(use="mutual-nearest"),
        depth=ProviderConfig(use="watcher"),
        normals=ProviderConfig(use="from-depth"),
        runtime=RuntimeOptions(cache_dir=tmp_path, workers=workers),
    )
    with busy.watching():
        reconstruct(photos, None, config, registry=registry)
    # Two threads are awake during a hand-over, for long if the machine is busy.
    assert busy.share_above(workers) < 0.2 and max(busy.counts) > 0
    assert watcher.seen == [{1}] * 3


def test_thread_limit_applies_to_all_libraries_and_is_restored() -> None:
    def pools() -> set[int]:
        return {pool["num_threads"] for pool in threadpool_info()}

    before = pools(), cv2.getNumThreads()
    with limit_threads(1):
        assert (thread_limit(), cv2.getNumThreads(), pools()) == (1, 1, {1})
        with limit_threads(3):
            assert thread_limit() == 3
        assert thread_limit() == 1
    assert (pools(), cv2.getNumThreads()) == before
    assert thread_limit() == count_cores()


def test_opencv_has_all_threads_of_the_run_only_inside_the_block() -> None:
    with limit_threads(2):
        with opencv_threads(thread_limit()):
            assert cv2.getNumThreads() == 2
        assert cv2.getNumThreads() == 1


def test_each_gives_results_in_order_from_as_many_threads_as_are_allowed() -> None:
    together = threading.Barrier(2, timeout=10)

    def halved(number: int) -> tuple[float, int]:
        together.wait()  # The barrier opens only if both threads work.
        return number / 2, threading.get_ident()

    with limit_threads(2):
        found = parallel_map(halved, range(4))
    assert [half for half, _ in found] == [0, 0.5, 1, 1.5]
    assert len({thread for _, thread in found} - {threading.get_ident()}) == 2
    with pytest.raises(ZeroDivisionError):
        parallel_map(lambda number: 1 / number, [1, 0, 2])


def test_torch_computes_with_the_threads_of_the_context_in_every_thread() -> None:
    torch = pytest.importorskip("torch")
    from mpsfm_core.providers.torch_runtime import use_threads

    before, seen = torch.get_num_threads(), []
    try:
        for count in (1, 2):
            context = ProviderContext(resolve_weights=None, device="cpu", threads=count, seed=0)
            use_threads(context)
            thread = threading.Thread(target=lambda: seen.append(torch.get_num_threads()))
            thread.start()
            thread.join()
    finally:
        torch.set_num_threads(before)
    assert seen == [1, 2]
