"""Tests that a run killed or failed at any write call loses no results."""

from __future__ import annotations

import errno
from itertools import pairwise

import numpy as np
import pytest

from mpsfm_core.data.result_layout import REPORT

from .conftest import Scene, content

KILLS, FAULTS = 120, 120
QUICK = 3
ERRORS = (errno.ENOSPC, errno.EIO, errno.EACCES, errno.EROFS, errno.EMFILE)


def points(scene: Scene, count: int, seed: int) -> list[int]:
    """Return reproducible system call numbers, spread over a whole run, for injected faults."""
    rng = np.random.default_rng(seed)
    edges = np.linspace(0, scene.calls, count + 1).astype(int)
    return [int(rng.integers(first, max(first + 1, end))) for first, end in pairwise(edges)]


def check_intact(scene: Scene, what: object) -> None:
    """Check that results are old or new, never mixed, or that a partial replacement is marked."""
    found = content(scene.output)
    scratch = {name for name in found if name.startswith(".mpsfm-")}
    visible = {name: value for name, value in found.items() if name not in scratch}
    assert "notes.txt" in visible
    if any(name.endswith("ready.json") for name in scratch):
        return  # The next run finishes an interrupted replacement.
    assert visible == scene.earlier or is_whole(scene, visible), what


def is_whole(scene: Scene, visible: dict[str, str]) -> bool:
    """Check that all results exist; the report page may be missing and can be written again."""
    results = {name: value for name, value in scene.whole.items() if name != REPORT}
    return visible in (scene.whole, results)


def check_next_run(scene: Scene, what: object) -> None:
    scene.age()
    ended = scene.run()
    assert ended.get("error", "killed") is None, (what, ended)
    assert content(scene.output) == scene.whole, what
    assert scene.leftovers() == [], what


def killed(scene: Scene, number: int) -> None:
    scene.reset()
    ended = scene.run(number=number)
    assert ended.get("signal") == 9 or ended["calls"] <= number, ended
    check_intact(scene, number)
    check_next_run(scene, number)


def failed(scene: Scene, number: int, error: int, lasting: bool) -> None:
    what = number, errno.errorcode[error], lasting
    scene.reset()
    ended = scene.run(number=number, errno=error, lasting=int(lasting))
    assert ended.get("expected"), (what, ended)
    check_intact(scene, what)
    if ended["error"] is None:
        visible = {k: v for k, v in content(scene.output).items() if not k.startswith(".mpsfm")}
        assert is_whole(scene, visible), what
    check_next_run(scene, what)


def test_kill_at_few_calls_leaves_readable_results(scene: Scene) -> None:
    for number in points(scene, QUICK, 0):
        killed(scene, number)


@pytest.mark.slow
def test_kill_at_many_calls_leaves_readable_results(scene: Scene) -> None:
    for number in points(scene, KILLS, 1):
        killed(scene, number)


def test_few_failing_calls_are_reported(scene: Scene) -> None:
    for number, error in zip(points(scene, QUICK, 2), ERRORS * 2, strict=False):
        failed(scene, number, error, error == errno.ENOSPC)


@pytest.mark.slow
@pytest.mark.parametrize("error", ERRORS, ids=errno.errorcode.get)
def test_many_failing_calls_are_reported(scene: Scene, error: int) -> None:
    for turn, number in enumerate(points(scene, FAULTS // len(ERRORS), 3 + error)):
        failed(scene, number, error, turn % 2 == 0)
