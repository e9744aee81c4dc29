"""Tests of parallel stages and of the number of workers and threads."""

from __future__ import annotations

import threading
import time

import pytest

from mpsfm_core.config import RuntimeOptions
from mpsfm_core.extraction import active_provider as backends
from mpsfm_core.extraction.active_provider import thread_count, worker_count
from mpsfm_core.extraction.events import NullExtractionEvents
from mpsfm_core.extraction.parallel import run_stage
from mpsfm_core.providers import ProviderSpec


def test_run_stage_returns_results_in_order() -> None:
    def work(item: int) -> int:
        time.sleep(0.02 * (3 - item % 4))
        return item * item

    assert run_stage(NullExtractionEvents(), "stage", range(8), work, 4) == [
        i * i for i in range(8)
    ]
    assert run_stage(NullExtractionEvents(), "stage", [], work, 4) == []


def test_run_stage_runs_items_in_parallel() -> None:
    meeting = threading.Barrier(3, timeout=10)
    run_stage(NullExtractionEvents(), "stage", range(3), lambda _: meeting.wait(), 3)


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt])
def test_run_stage_error_cancels_remaining_items(error: type[BaseException]) -> None:
    done: list[int] = []

    def work(item: int) -> None:
        if item == 2:
            raise error("here")
        done.append(item)
        time.sleep(0.01)

    class Watch(NullExtractionEvents):
        finished = False

        def stage_finished(self, stage: str, seconds: float) -> None:
            self.finished = True

    watch = Watch()
    with pytest.raises(error, match="here"):
        run_stage(watch, "stage", range(1000), work, 1)
    assert len(done) < 20 and watch.finished


def test_run_stage_sends_events_in_calling_thread() -> None:
    seen: set[int] = set()

    class Watch(NullExtractionEvents):
        def stage_progress(self, stage: str, done: int, total: int) -> None:
            seen.add(threading.get_ident())

    run_stage(Watch(), "stage", range(20), lambda item: item, 3)
    assert seen == {threading.get_ident()}


@pytest.mark.parametrize(("cores", "workers", "threads"), [(1, 1, 1), (2, 2, 1), (16, 4, 4)])
def test_worker_and_thread_counts_follow_cores(
    cores, workers, threads, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(backends, "count_cores", lambda: cores)
    runtime = RuntimeOptions()
    assert (worker_count(runtime), thread_count(runtime)) == (workers, threads)


def test_worker_and_thread_counts_follow_options() -> None:
    runtime = RuntimeOptions(workers=7, threads=3)
    assert (worker_count(runtime), thread_count(runtime)) == (7, 3)


def test_device_auto_uses_gpu_if_library_of_provider_can(monkeypatch: pytest.MonkeyPatch) -> None:
    network = ProviderSpec(kind="depth", name="n", factory="a:B", requires=("torch",))
    plain = ProviderSpec(kind="depth", name="p", factory="a:B")
    assert backends._device(RuntimeOptions(device="cuda"), network) == "cuda"
    assert backends._device(RuntimeOptions(device="cpu"), network) == "cpu"
    monkeypatch.setattr(backends, "_may_have_gpu", lambda: True)
    assert backends._device(RuntimeOptions(), plain) == "cpu"
    asked: list[str] = []

    class FakeTorch:
        class cuda:
            @staticmethod
            def is_available() -> bool:
                return True

    monkeypatch.setattr(
        backends.importlib, "import_module", lambda name: asked.append(name) or FakeTorch
    )
    assert backends._device(RuntimeOptions(), network) == "cuda" and asked == ["torch"]
    monkeypatch.setattr(backends, "_may_have_gpu", lambda: False)
    assert backends._device(RuntimeOptions(), network) == "cpu" and asked == ["torch"]
