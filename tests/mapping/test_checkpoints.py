"""A mapper that ends early goes on to the very same result."""

from __future__ import annotations

import threading
from dataclasses import replace

import numpy as np
import pytest

from mpsfm_core.data import DepthPrior, MappingProblem, PinholeCamera
from mpsfm_core.data.errors import DataError
from mpsfm_core.mapping.events import NullMappingEvents
from mpsfm_core.mapping.mapper import Mapper, reconstruct
from mpsfm_core.mapping.options import MapperOptions
from mpsfm_core.mapping.scene.reconstruction import MappingResult
from mpsfm_core.mapping.serialization import (
    CheckpointArrays,
    canonicalize,
    deserialize,
    fingerprint,
    serialize,
)
from mpsfm_core.testing.synthetic.problems import SyntheticNoise, make_mapping_problem
from mpsfm_core.testing.synthetic.scenes import arc_poses, room_scene

CAMERA = PinholeCamera(160, 120, 130.0, 130.0, 80.0, 60.0)


class Killed(Exception):
    """The end, at any moment."""


class Memory:
    """Keeps every state and ends the mapper after the ``last``."""

    def __init__(self, states: list[CheckpointArrays], last: int) -> None:
        self.states, self.reasons = states, []
        self._last = last

    def load(self) -> CheckpointArrays | None:
        return self.states[-1] if self.states else None

    def unreadable(self, reason: str) -> None:
        self.reasons.append(reason)

    def due(self) -> bool:
        return True

    def save(self, state: CheckpointArrays, registered: int) -> None:
        self.states.append({name: array.copy() for name, array in state.items()})
        if len(self.states) == self._last:
            raise Killed


def same(a: CheckpointArrays, b: CheckpointArrays) -> bool:
    return a.keys() == b.keys() and all(
        a[name].dtype == b[name].dtype and a[name].tobytes() == b[name].tobytes() for name in a
    )


def content(result: MappingResult, problem: MappingProblem) -> CheckpointArrays:
    """All of a result but the seconds that it took."""
    report = replace(result.report, seconds={})
    return serialize(replace(result, report=report), problem)


def thawed_poses(state: CheckpointArrays, problem: MappingProblem) -> CheckpointArrays:
    _, mapper = deserialize(state, (problem, NullMappingEvents()))
    return serialize(mapper.component.scene.snapshot())


@pytest.fixture(scope="module")
def problem() -> MappingProblem:
    """Two groups that share no matches, with noise: several runs."""
    noise = SyntheticNoise(keypoints_px=1.0, depth=0.05)
    whole = make_mapping_problem(
        room_scene(), CAMERA, arc_poses(6, 14.0), noise=noise, points_per_view=80, map_width=48
    )
    apart = tuple(p for p in whole.pairs if (p.image_a < 3) == (p.image_b < 3))
    return canonicalize(MappingProblem(whole.images, apart))


OPTIONS = MapperOptions(max_runs=2, enough_explained=1.0)


@pytest.fixture(scope="module")
def undisturbed(problem: MappingProblem) -> tuple[MappingResult, list[CheckpointArrays]]:
    memory = Memory([], -1)
    return reconstruct(problem, OPTIONS, checkpoints=memory), memory.states


def test_every_attribute_comes_back(problem: MappingProblem, undisturbed) -> None:
    _, states = undisturbed
    shared = (problem, NullMappingEvents())
    for state in states:
        assert same(serialize(deserialize(state, shared), shared), state)


def test_a_resumed_run_ends_the_same_bit_for_bit(problem: MappingProblem, undisturbed) -> None:
    result, states = undisturbed
    assert len(states) >= 6
    assert len(result.reconstructions) == 2
    for first in (1, len(states) // 2 + 1):
        memory = Memory(states[:first], -1)
        again = reconstruct(problem, OPTIONS, checkpoints=memory)
        assert same(content(again, problem), content(result, problem))
        assert not memory.reasons


def test_killed_after_each_state(problem: MappingProblem, undisturbed) -> None:
    result, states = undisturbed
    kept: list[CheckpointArrays] = []
    for last in range(1, len(states) + 1):
        with pytest.raises(Killed):
            reconstruct(problem, OPTIONS, checkpoints=Memory(kept, last))
    # A state that is taken up is kept anew at once, so that each kill loses one step.
    again = reconstruct(problem, OPTIONS, checkpoints=Memory(kept, -1))
    assert same(content(again, problem), content(result, problem))


def test_keeping_states_changes_nothing(problem: MappingProblem, undisturbed) -> None:
    result, _ = undisturbed
    assert same(content(reconstruct(problem, OPTIONS), problem), content(result, problem))


def test_a_damaged_state_is_a_new_start(problem: MappingProblem, undisturbed) -> None:
    _, states = undisturbed
    rng = np.random.default_rng(0)
    broken = []
    tree = states[0]["tree"].copy()
    tree[rng.integers(len(tree), size=20)] = ord("x")
    broken.append({**states[0], "tree": tree})
    broken.append({"tree": states[0]["tree"]})
    broken.append({})
    broken.append({**states[0], "tree": np.frombuffer(b'{"format":0,"state":1}', np.uint8)})
    broken.append({**states[0], "tree": np.frombuffer(b'{"format":1,"state":1}', np.uint8)})
    for state in broken[:-1]:
        with pytest.raises(DataError, match="state: the checkpoint is damaged"):
            deserialize(state, (problem, NullMappingEvents()))
    memory = Memory([broken[-1]], 2)
    with pytest.raises(Killed):
        reconstruct(problem, OPTIONS, checkpoints=memory)
    assert memory.reasons
    assert same(thawed_poses(memory.states[1], problem), thawed_poses(states[0], problem))


@pytest.mark.parametrize(
    "path", ["os:system", "mpsfm_core.providers.registry:Registry", "subprocess:Popen"]
)
def test_no_other_classes_come_out_of_a_state(path: str) -> None:
    text = f'{{"format":1,"state":{{"id":0,"object":"{path}","attributes":{{}}}}}}'
    with pytest.raises(DataError, match="no class that a checkpoint may contain"):
        deserialize({"tree": np.frombuffer(text.encode(), np.uint8)})


def test_what_cannot_be_kept_is_named_with_its_place(problem: MappingProblem) -> None:
    mapper = Mapper(problem, OPTIONS, NullMappingEvents())
    mapper.event_log._seconds["lock"] = threading.Lock()
    with pytest.raises(TypeError, match=r"state\.event_log\._seconds\['lock'\]: a _thread\.lock"):
        serialize(mapper, (problem, mapper.event_log._events))


def moved(array: np.ndarray) -> np.ndarray:
    """The same values elsewhere: a view, in Fortran's order."""
    return np.asfortranarray(np.stack([array, array]))[0]


def test_how_a_problem_lies_in_memory_does_not_count(problem: MappingProblem, undisturbed) -> None:
    result, states = undisturbed
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
    assert not same(serialize(other), serialize(problem))
    assert fingerprint(other) == fingerprint(problem) == fingerprint(canonicalize(other))
    assert same(serialize(canonicalize(other)), serialize(canonicalize(problem)))
    assert canonicalize(canonicalize(other).images[0]) is not images[0]
    memory = Memory(states[: len(states) // 2], -1)
    again = reconstruct(other, OPTIONS, checkpoints=memory)
    assert same(content(again, other), content(result, problem))
    fewer = MappingProblem(problem.images, problem.pairs[1:])
    assert fingerprint(fewer) != fingerprint(problem)


def test_options_come_back(problem: MappingProblem) -> None:
    options = MapperOptions(seed=3, refinement={"global_growth": 0.5})
    assert deserialize(serialize(options)) == options != MapperOptions()
    assert not same(serialize(options), serialize(MapperOptions()))


def test_arrays_keep_layout_sharing_and_protection() -> None:
    owner = np.asfortranarray(np.arange(24.0).reshape(2, 3, 4))
    frozen_array = np.arange(5)
    frozen_array.flags.writeable = False
    state = {
        "owner": owner,
        "view": owner[1:, ::2, ::-1],
        "permuted": np.arange(24.0).reshape(2, 3, 4).transpose(1, 2, 0).copy(order="K"),
        "fixed": frozen_array,
        "empty": np.zeros((0, 3)),
        "zero": np.zeros((), np.float32),
        "scalar": np.float32(0.1),
        "random": np.random.default_rng(3),
        "bytes": b"\x00\xff",
        "odd": [float("inf"), 1e-310, 2**70, "ä", {3, 4}, (1, (2,))],
        7: owner,
    }
    came = deserialize(serialize(state))
    assert came[7] is came["owner"] and came["owner"].flags.f_contiguous
    for name in ("owner", "view", "permuted", "fixed", "empty", "zero"):
        assert np.array_equal(came[name], state[name]) and came[name].strides == state[name].strides
        assert came[name].dtype == state[name].dtype
    came["owner"][1, 0, 3] = -1
    assert came["view"][0, 0, 0] == -1
    assert not came["fixed"].flags.writeable
    assert type(came["scalar"]) is np.float32 and came["scalar"] == state["scalar"]
    assert came["bytes"] == state["bytes"] and came["odd"] == state["odd"]
    assert came["random"].random() == np.random.default_rng(3).random()
