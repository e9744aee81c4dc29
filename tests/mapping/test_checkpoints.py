"""Tests that a run resumed from a checkpoint gives the result of an uninterrupted run."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from mpsfm_core.data import DepthPrior, MappingProblem, PinholeCamera
from mpsfm_core.data.errors import DataError
from mpsfm_core.extraction.cache import digest
from mpsfm_core.mapping.events import NullMappingEvents
from mpsfm_core.mapping.mapper import Mapper, reconstruct
from mpsfm_core.mapping.model_selection import MapperRun
from mpsfm_core.mapping.options import MapperOptions
from mpsfm_core.mapping.scene.reconstruction import MappingResult
from mpsfm_core.mapping.state import CheckpointArrays, flatten_state, unflatten_state
from mpsfm_core.testing.synthetic.problems import SyntheticNoise, make_mapping_problem
from mpsfm_core.testing.synthetic.rigs import make_rig_problem
from mpsfm_core.testing.synthetic.scenes import arc_poses, look_at, room_scene

CAMERA = PinholeCamera(160, 120, 130.0, 130.0, 80.0, 60.0)


class Killed(Exception):
    """Exception that interrupts the mapper."""


class Memory:
    """Store of checkpoints that interrupts the mapper after the ``last`` one."""

    def __init__(self, states: list[CheckpointArrays], last: int) -> None:
        self.states, self.reasons = states, []
        self._last = last

    def load(self) -> CheckpointArrays | None:
        return self.states[-1] if self.states else None

    def unreadable(self, reason: str) -> None:
        self.reasons.append(reason)

    def due(self) -> bool:
        return True

    def save(self, collect: Callable[[], CheckpointArrays], registered: int) -> None:
        self.states.append({name: array.copy() for name, array in collect().items()})
        if len(self.states) == self._last:
            raise Killed


def same(a: CheckpointArrays, b: CheckpointArrays) -> bool:
    return a.keys() == b.keys() and all(
        a[name].dtype == b[name].dtype and a[name].tobytes() == b[name].tobytes() for name in a
    )


def content(result: MappingResult) -> CheckpointArrays:
    """Return all values of a result except the run times."""
    report = replace(result.report, seconds={})
    models = [model.state_dict() for model in result.reconstructions]
    return flatten_state({"models": models, "report": report.state_dict()})


@pytest.fixture(scope="module")
def problem() -> MappingProblem:
    """Return a noisy problem of two components, which needs several mapper runs."""
    noise = SyntheticNoise(keypoints_px=1.0, depth=0.05)
    whole = make_mapping_problem(
        room_scene(), CAMERA, arc_poses(6, 14.0), noise=noise, points_per_view=80, map_width=48
    )
    apart = tuple(p for p in whole.pairs if (p.image_a < 3) == (p.image_b < 3))
    return MappingProblem(whole.images, apart)


OPTIONS = MapperOptions(max_runs=2, enough_explained=1.0)


@pytest.fixture(scope="module")
def uninterrupted(problem: MappingProblem) -> tuple[MappingResult, list[CheckpointArrays]]:
    memory = Memory([], -1)
    return reconstruct(problem, OPTIONS, checkpoints=memory), memory.states


def test_restored_mapper_has_the_state_of_the_checkpoint(
    problem: MappingProblem, uninterrupted
) -> None:
    _, states = uninterrupted
    for arrays in states[:-1]:
        state = unflatten_state(arrays)
        assert all(a.flags.c_contiguous or a.flags.f_contiguous for a in arrays.values())
        options = OPTIONS.model_copy(update={"seed": len(state["runs"])})
        mapper = Mapper(problem, options, NullMappingEvents())
        mapper.load_state_dict(state["mapper"])
        runs = [MapperRun.from_state_dict(run).state_dict() for run in state["runs"]]
        assert same(flatten_state({"runs": runs, "mapper": mapper.state_dict()}), arrays)


def test_resumed_run_gives_identical_result(problem: MappingProblem, uninterrupted) -> None:
    result, states = uninterrupted
    assert len(states) >= 6
    assert len(result.reconstructions) == 2
    for first in (1, len(states) // 2 + 1):
        memory = Memory(states[:first], -1)
        again = reconstruct(problem, OPTIONS, checkpoints=memory)
        assert same(content(again), content(result))
        assert not memory.reasons


def test_run_interrupted_after_each_checkpoint_gives_identical_result(
    problem: MappingProblem, uninterrupted
) -> None:
    result, states = uninterrupted
    kept: list[CheckpointArrays] = []
    for last in range(1, len(states) + 1):
        with pytest.raises(Killed):
            reconstruct(problem, OPTIONS, checkpoints=Memory(kept, last))
    # A resumed mapper saves a checkpoint at once, so each interruption loses one step.
    again = reconstruct(problem, OPTIONS, checkpoints=Memory(kept, -1))
    assert same(content(again), content(result))


def test_resumed_run_with_calibrated_rig_gives_identical_result() -> None:
    poses = [
        look_at([-1.2 + 0.4 * k, -0.6, 1.4], [2.0 + 0.4 * k, 0.3 * (-1) ** k, 1.2])
        for k in range(4)
    ]
    problem = make_rig_problem(room_scene(), "stereo", poses, num_points=500, map_width=40).problem
    rig = replace(problem.rigs[0], sensor_from_rig=(None, None))
    problem, memory = replace(problem, rigs=(rig,)), Memory([], -1)
    result = reconstruct(problem, checkpoints=memory)
    assert result.report.runs == 2
    assert result.reconstructions[0].rigs[0].is_estimated
    for last in (1, len(memory.states) - 1, len(memory.states)):
        again = reconstruct(problem, checkpoints=Memory(memory.states[:last], -1))
        assert same(content(again), content(result))


def test_saving_checkpoints_does_not_change_result(problem: MappingProblem, uninterrupted) -> None:
    result, _ = uninterrupted
    assert same(content(reconstruct(problem, OPTIONS)), content(result))


def test_damaged_checkpoint_restarts_the_mapper(problem: MappingProblem, uninterrupted) -> None:
    result, states = uninterrupted
    rng = np.random.default_rng(0)
    text = states[0]["state"].copy()
    text[rng.integers(len(text), size=20)] = ord("x")
    name = next(name for name in states[0] if name != "state")
    one_missing = {key: array for key, array in states[0].items() if key != name}
    not_a_state = np.frombuffer(b'{"arrays":[],"state":1}', np.uint8)
    for damaged in (
        {**states[0], "state": text},
        {"state": states[0]["state"]},
        {},
        one_missing,
        {"state": not_a_state},
    ):
        with pytest.raises(DataError, match="state: the checkpoint is damaged"):
            unflatten_state(damaged)
    memory = Memory([one_missing], -1)
    assert same(content(reconstruct(problem, OPTIONS, checkpoints=memory)), content(result))
    assert len(memory.reasons) == 1 and f"the array {name} is missing" in memory.reasons[0]


def moved(array: np.ndarray) -> np.ndarray:
    """Return the same values as a view in Fortran order."""
    return np.asfortranarray(np.stack([array, array]))[0]


def test_memory_layout_of_problem_does_not_change_result(
    problem: MappingProblem, uninterrupted
) -> None:
    result, states = uninterrupted
    images = tuple(
        replace(
            image,
            keypoints=moved(image.keypoints),
            depth=DepthPrior(
                *map(moved, (image.depth.depth, image.depth.variance, image.depth.valid)),
                metric=image.depth.metric,
            ),
        )
        for image in problem.images
    )
    other = MappingProblem(images, problem.pairs)
    assert digest(other) == digest(problem)
    assert digest(MappingProblem(problem.images, problem.pairs[1:])) != digest(problem)
    memory = Memory(states[: len(states) // 2], -1)
    assert same(content(reconstruct(other, OPTIONS, checkpoints=memory)), content(result))


def test_unflatten_state_restores_values_and_layout() -> None:
    state = {
        "fortran": np.asfortranarray(np.arange(6.0).reshape(2, 3)),
        "empty": np.zeros((0, 3)),
        "nested": [{"a/b": np.float32([1.5])}, None, [True, 2**70, float("inf"), 1e-310, "ä"]],
    }
    restored = unflatten_state(flatten_state(state))
    assert restored["fortran"].flags.f_contiguous and restored["empty"].shape == (0, 3)
    assert np.array_equal(restored["fortran"], state["fortran"])
    assert restored["nested"][0]["a/b"].dtype == np.float32
    assert restored["nested"][1:] == state["nested"][1:]


def test_flatten_state_of_unsupported_value_names_its_path() -> None:
    with pytest.raises(TypeError, match=r"mapper/locks/1: lock cannot be stored in a checkpoint"):
        flatten_state({"mapper": {"locks": [0, threading.Lock()]}})
