"""Tests of the storage of parts, and of mapping parts on the workers of an executor."""

from __future__ import annotations

import multiprocessing
import os
import signal
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mpsfm_core.config import RuntimeOptions
from mpsfm_core.data import MappingProblem
from mpsfm_core.data.errors import InputError
from mpsfm_core.extraction.cache import digest
from mpsfm_core.mapping.options import MapperOptions
from mpsfm_core.mapping.parts.part_mapping import reconstruct
from mpsfm_core.mapping.problem_state import problem_from_state, problem_to_state
from mpsfm_core.mapping.state import flatten_state, unflatten_state
from mpsfm_core.pipeline.parts import MapPart, PartMapper, choose_part_size
from mpsfm_core.pipeline.stages import Stages
from mpsfm_core.providers.registry import Registry
from mpsfm_core.support.npz import read_npz
from mpsfm_core.testing.synthetic.halls import make_hall_problem
from mpsfm_core.testing.synthetic.rigs import make_rig_problem
from mpsfm_core.testing.synthetic.scenes import arc_poses, room_scene
from tests.support.backwards_executor import Backwards

OPTIONS = MapperOptions(parts=20)


class Killed(Exception):
    """Interrupts a run."""


class Progress(Stages):
    """Counts the finished parts, and interrupts the run after some parts."""

    def __init__(self, registry: Registry, last: int | None = None) -> None:
        super().__init__(registry)
        self.done: list[tuple[int, int]] = []
        self._last = last

    def stage_progress(self, stage: str, done: int, total: int) -> None:
        assert stage == "parts"
        self.done.append((done, total))
        if done == self._last:
            raise Killed


@pytest.fixture(scope="module")
def problem() -> MappingProblem:
    return make_hall_problem(36, map_width=48, points_per_view=40).problem


@pytest.fixture(scope="module")
def expected(problem: MappingProblem) -> str:
    return digest(reconstruct(problem, OPTIONS).reconstructions[0])


def map_in_parts(
    problem: MappingProblem, runtime: RuntimeOptions, stages: Stages, registry: Registry
) -> tuple[str, PartMapper]:
    mapper = PartMapper(runtime, registry, stages)
    result = reconstruct(problem, OPTIONS, stages, None, mapper)
    return digest(result.reconstructions[0]), mapper


def list_files(folder: Path) -> list[Path]:
    return [path for path in folder.rglob("*") if path.is_file()]


def test_executor_gives_the_same_bits_and_no_file_remains(
    problem: MappingProblem, expected: str, tmp_path: Path
) -> None:
    registry, executor = Registry(), Backwards()
    registry.register(executor, name="backwards")
    stages = Progress(registry)
    runtime = RuntimeOptions(cache_dir=tmp_path, executor="backwards", checkpoint_s=None)
    result, mapper = map_in_parts(problem, runtime, stages, registry)
    assert result == expected and executor.closed
    assert len(stages.done) == stages.done[0][1] == len(mapper.records) > 1
    for record in mapper.records:
        assert 10 < record.images < 36 and record.cpu_seconds > 0
        assert record.worker.endswith(f":{os.getpid()}")
    assert list_files(tmp_path)
    mapper.forget()
    assert not list_files(tmp_path)


def test_interrupted_run_does_not_map_finished_parts_again(
    problem: MappingProblem, expected: str, tmp_path: Path
) -> None:
    registry = Registry()
    runtime = RuntimeOptions(cache_dir=tmp_path)
    with pytest.raises(Killed):
        map_in_parts(problem, runtime, Progress(registry, last=1), registry)
    (finished,) = list_files(tmp_path)
    arrays = read_npz(finished)
    assert map_in_parts(problem, runtime, Progress(registry), registry)[0] == expected
    # a mark in the stored result shows that the next run uses the file
    marked = next(name for name in arrays if name.endswith("rotation"))
    arrays[marked] = arrays[marked] + 1e-9
    np.savez(finished, **arrays)
    assert map_in_parts(problem, runtime, Progress(registry), registry)[0] != expected


def map_in_process(folder: Path) -> None:
    """Map the problem of the tests in parts, in a process that is killed."""
    problem = make_hall_problem(36, map_width=48, points_per_view=40).problem
    map_in_parts(problem, RuntimeOptions(cache_dir=folder), Stages(Registry()), Registry())


@pytest.mark.slow  # starts a process
def test_killed_main_process_resumes_with_the_same_bits(
    problem: MappingProblem, expected: str, tmp_path: Path
) -> None:
    process = multiprocessing.get_context("spawn").Process(target=map_in_process, args=(tmp_path,))
    process.start()
    while process.is_alive() and not list(tmp_path.glob("mapping/*.npz")):
        time.sleep(0.02)
    process.kill()
    process.join()
    assert process.exitcode == -signal.SIGKILL
    modified = {path: path.stat().st_mtime_ns for path in tmp_path.glob("mapping/*.npz")}
    assert modified
    registry = Registry()
    runtime = RuntimeOptions(cache_dir=tmp_path)
    result, _ = map_in_parts(problem, runtime, Progress(registry), registry)
    assert result == expected
    assert all(path.stat().st_mtime_ns == time_ns for path, time_ns in modified.items())


def test_run_without_checkpoints_writes_no_file(
    problem: MappingProblem, expected: str, tmp_path: Path
) -> None:
    registry = Registry()
    runtime = RuntimeOptions(cache_dir=tmp_path, checkpoint_s=None)
    assert map_in_parts(problem, runtime, Stages(registry), registry)[0] == expected
    assert not list_files(tmp_path)


@pytest.mark.parametrize(
    ("parts", "executor", "num_images", "expected"),
    [
        ("auto", "dask", 2001, 1000),
        ("auto", "dask", 2000, None),
        ("auto", "threads", 5000, None),
        (None, "dask", 5000, None),
        (100, "threads", 200, 100),
    ],
)
def test_part_size_is_automatic_for_many_images_on_workers(
    parts: Any, executor: str, num_images: int, expected: int | None
) -> None:
    options, runtime = MapperOptions(parts=parts), RuntimeOptions(executor=executor)
    assert choose_part_size(options, runtime, num_images).parts == expected


def test_worker_without_the_cache_folder_raises(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="set runtime"):
        MapPart(tmp_path, OPTIONS, 10.0, 1)("unknown")


def test_stored_problem_is_identical(problem: MappingProblem) -> None:
    rig_problem = make_rig_problem(room_scene(), "stereo", arc_poses(3, 10.0)).problem
    poses = {image.name: (np.eye(3), np.arange(3.0)) for image in problem.images[:2]}
    for case in (problem, problem.with_poses(poses), rig_problem):
        state = unflatten_state(flatten_state(problem_to_state(case)))
        assert digest(problem_from_state(state)) == digest(case)
