"""Tests of the record of times and memory of stages."""

from __future__ import annotations

from mpsfm_core.pipeline.stages import StageRecord, Stages
from mpsfm_core.providers.registry import Registry


def test_stage_that_runs_twice_has_one_record() -> None:
    first = StageRecord(2.0, 300.0)
    assert StageRecord(3.0, 200.0).after(first) == StageRecord(5.0, 300.0)
    assert StageRecord(3.0, None).after(first) == StageRecord(5.0, 300.0)
    assert first.after(None) is first
    stages = Stages(Registry())
    taken = []
    for _ in range(2):
        with stages.stage("mapping"):
            pass
        taken.append(stages.report()["mapping"].seconds)
    assert 0 < taken[0] < taken[1] and list(stages.report()) == ["mapping"]
