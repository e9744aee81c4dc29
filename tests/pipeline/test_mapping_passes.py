"""Tests of the mapper runs of one reconstruction."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from mpsfm_core.config import load_config
from mpsfm_core.data import MappingImage, MappingProblem, NormalPrior, VerifiedPair
from mpsfm_core.extraction.runner import Extraction
from mpsfm_core.mapping.parts import part_mapping
from mpsfm_core.mapping.scene.reconstruction import MappingReport, MappingResult
from mpsfm_core.pipeline.checkpoints import RunCheckpoints
from mpsfm_core.pipeline.mapping_passes import MappingPasses
from mpsfm_core.pipeline.stages import Stages
from mpsfm_core.providers.registry import Registry
from tests.mapping.test_camera_jumps import CAMERA, DEPTH, NAMES, SHOT, build_walk, walk

STEADY = build_walk(walk())
JUMPING = build_walk(walk(), slice(20, None))
PAIR_ENDS = [(0, 1), (5, 25), (19, 20)]


class Images(list[SimpleNamespace]):
    """Images whose cameras do not change."""

    names = NAMES


def build_problem() -> MappingProblem:
    normals = np.zeros((6, 8, 3), np.float32)
    normals[..., 2] = -1
    flat = NormalPrior.from_arrays(normals, np.ones((6, 8), np.float32))
    images = [MappingImage(name, CAMERA, np.zeros((0, 2)), DEPTH, flat) for name in NAMES]
    none = np.zeros((0, 2), np.int64)
    pairs = [
        VerifiedPair(a, b, none, np.zeros(0, np.float32), np.eye(3), np.array([1.0, 0, 0]))
        for a, b in PAIR_ENDS
    ]
    return MappingProblem(tuple(images), tuple(pairs))


@pytest.mark.parametrize("repaired", [True, False])
def test_only_jumps_of_the_last_mapper_run_remain(
    monkeypatch: pytest.MonkeyPatch, repaired: bool
) -> None:
    """The pair across the jump is removed for the second run of the mapper."""
    mapped: list[list[tuple[int, int]]] = []

    def reconstruct(problem: MappingProblem, *_: object) -> MappingResult:
        mapped.append([(pair.image_a, pair.image_b) for pair in problem.pairs])
        walked = STEADY if repaired and len(mapped) == 2 else JUMPING
        return MappingResult((walked,), MappingReport())

    monkeypatch.setattr(part_mapping, "reconstruct", reconstruct)
    registry = Registry()
    config = load_config("default", ["fast_pass=null", "runtime.checkpoint_s=null"])
    inputs: Any = SimpleNamespace(known_poses={}, shots=[SHOT])
    images: Any = Images(SimpleNamespace(name=name) for name in NAMES)
    checkpoints = RunCheckpoints(fresh=False)
    passes = MappingPasses(config, registry, Stages(registry), inputs, checkpoints)
    extraction, mapping, _ = passes.run(images, Extraction(build_problem(), {}))
    kept = [PAIR_ENDS[0], PAIR_ENDS[2]]
    assert mapped == [PAIR_ENDS, kept]
    assert [(pair.image_a, pair.image_b) for pair in extraction.problem.pairs] == kept
    assert mapping.reconstructions == (STEADY if repaired else JUMPING,)
    assert passes.jumps == ([] if repaired else [(NAMES[19], NAMES[20])])
