"""Tests of mapping checkpoints: validity, damage, full and slow disks."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mpsfm_core.data import MappingProblem, PinholeCamera
from mpsfm_core.mapping.options import MapperOptions
from mpsfm_core.mapping.state import CheckpointArrays, flatten_state, unflatten_state
from mpsfm_core.pipeline import checkpoints as module
from mpsfm_core.pipeline.checkpoints import MappingCheckpoints
from mpsfm_core.pipeline.stages import Stages
from mpsfm_core.providers.registry import Registry
from mpsfm_core.testing.synthetic.problems import make_mapping_problem
from mpsfm_core.testing.synthetic.scenes import arc_poses, room_scene

STATE = {"a": np.arange(3), "b": "text"}


class Notices(Stages):
    """Records the messages to the user."""

    def __init__(self) -> None:
        super().__init__(Registry())
        self.texts: list[str] = []

    def notice(self, text: str) -> None:
        self.texts.append(text)


@pytest.fixture(scope="module")
def problem() -> MappingProblem:
    camera = PinholeCamera(160, 120, 130.0, 130.0, 80.0, 60.0)
    poses = arc_poses(2, 10.0)
    return make_mapping_problem(room_scene(), camera, poses, points_per_view=20, map_width=24)


def collect() -> CheckpointArrays:
    return flatten_state(STATE)


def opened(folder: Path, problem: MappingProblem, every_s: float = 0.0, **options: Any) -> Any:
    checkpoints = MappingCheckpoints(
        folder, problem, MapperOptions(**options), notices := Notices(), every_s
    )
    return checkpoints, notices.texts


def test_checkpoint_is_loaded_for_the_same_problem_only(tmp_path: Path, problem) -> None:
    checkpoints, _ = opened(tmp_path, problem)
    assert checkpoints.load() is None
    checkpoints.save(collect, 1)
    again, told = opened(tmp_path, problem)
    assert unflatten_state(again.load())["b"] == "text"
    assert "continues from a checkpoint" in told[0] and "1 of 2 images" in told[0]
    assert opened(tmp_path, problem, seed=1)[0].load() is None
    fewer = MappingProblem(problem.images, ())
    assert opened(tmp_path, fewer)[0].load() is None
    again.forget()
    assert opened(tmp_path, problem)[0].load() is None
    assert not [path for path in tmp_path.rglob("*") if path.is_file()]


def test_checkpoint_of_other_code_is_not_used(
    tmp_path: Path, problem, monkeypatch: pytest.MonkeyPatch
) -> None:
    opened(tmp_path, problem)[0].save(collect, 1)
    monkeypatch.setattr(module, "code_key", lambda: "another")
    checkpoints, told = opened(tmp_path, problem)
    assert checkpoints.load() is None
    assert "other code" in told[0] and "mapping starts again" in told[0]


@pytest.mark.parametrize("keep", [0, 10, 0.5, -1])
def test_damaged_checkpoint_is_not_used(tmp_path: Path, problem, keep: float) -> None:
    opened(tmp_path, problem)[0].save(collect, 1)
    (path,) = tmp_path.rglob("*.npz")
    data = path.read_bytes()
    path.write_bytes(data[: int(keep * len(data)) if 0 < keep < 1 else int(keep)])
    checkpoints, told = opened(tmp_path, problem)
    assert checkpoints.load() is None
    assert "damaged" in told[0]


def test_checkpoint_on_full_disk_warns_once(
    tmp_path: Path, problem, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def full(*arguments: object) -> None:
        raise OSError(28, "No space left on device")

    checkpoints, _ = opened(tmp_path, problem)
    assert checkpoints.due()
    monkeypatch.setattr(module, "write_file", full)
    checkpoints.save(collect, 1)
    assert "no checkpoints from now on" in caplog.text and "No space" in caplog.text
    assert not checkpoints.due()


def test_checkpoint_interval_grows_with_the_time_for_saving(
    tmp_path: Path, problem, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = [0.0]

    def wait(seconds: float) -> None:
        clock[0] += seconds

    def collect_slowly() -> CheckpointArrays:
        wait(7)
        return collect()

    monkeypatch.setattr(module.time, "monotonic", lambda: clock[0])
    monkeypatch.setattr(module, "write_file", lambda *_: wait(3))
    checkpoints, _ = opened(tmp_path, problem, every_s=60.0)
    clock[0] = 59.0
    assert not checkpoints.due()
    clock[0] = 60.0
    assert checkpoints.due()
    checkpoints.save(collect_slowly, 1)
    clock[0] = 70.0 + 499
    assert not checkpoints.due()
    clock[0] = 70.0 + 500
    assert checkpoints.due()
