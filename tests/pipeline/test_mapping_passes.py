"""Tests of the mapper runs of one reconstruction."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from mpsfm_core.config import load_config
from mpsfm_core.data import MappingImage, MappingProblem, NormalPrior, VerifiedPair
from mpsfm_core.extraction.runner import Extraction
from mpsfm_core.mapping.camera_jumps import Jump
from mpsfm_core.mapping.parts import part_mapping
from mpsfm_core.mapping.scene.reconstruction import (
    MappingReport,
    MappingResult,
    Reconstruction,
)
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


def build_problem(num_matches: int) -> MappingProblem:
    normals = np.zeros((6, 8, 3), np.float32)
    normals[..., 2] = -1
    flat = NormalPrior.from_arrays(normals, np.ones((6, 8), np.float32))
    images = [MappingImage(name, CAMERA, np.zeros((40, 2)), DEPTH, flat) for name in NAMES]
    matches = np.tile(np.arange(num_matches)[:, None], 2)
    scores = np.ones(num_matches, np.float32)
    pairs = [
        VerifiedPair(a, b, matches, scores, np.eye(3), np.array([1.0, 0, 0])) for a, b in PAIR_ENDS
    ]
    return MappingProblem(tuple(images), tuple(pairs))


@pytest.mark.parametrize(
    ("results", "num_matches", "is_restored"),
    [
        pytest.param([JUMPING, STEADY], 14, False, id="false-match"),
        pytest.param([JUMPING, JUMPING], 14, False, id="jump-remains"),
        pytest.param([JUMPING, STEADY, STEADY], 15, True, id="true-loop"),
    ],
)
def test_pairs_across_a_jump_are_removed_unless_the_model_without_them_confirms_them(
    monkeypatch: pytest.MonkeyPatch,
    results: list[Reconstruction],
    num_matches: int,
    is_restored: bool,
) -> None:
    """The remaining jumps are those in the result of the last mapper run."""
    mapped: list[list[tuple[int, int]]] = []

    def reconstruct(problem: MappingProblem, *_: object) -> MappingResult:
        mapped.append([(pair.image_a, pair.image_b) for pair in problem.pairs])
        return MappingResult((results[len(mapped) - 1],), MappingReport())

    monkeypatch.setattr(part_mapping, "reconstruct", reconstruct)
    registry = Registry()
    config = load_config("default", ["fast_pass=null", "runtime.checkpoint_s=null"])
    inputs: Any = SimpleNamespace(known_poses={}, shots=[SHOT])
    images: Any = Images(SimpleNamespace(name=name) for name in NAMES)
    checkpoints = RunCheckpoints(fresh=False)
    passes = MappingPasses(config, registry, Stages(registry), inputs, checkpoints)
    extraction, mapping, _ = passes.run(images, Extraction(build_problem(num_matches), {}))
    kept = [PAIR_ENDS[0], PAIR_ENDS[2]]
    used = PAIR_ENDS if is_restored else kept
    assert mapped == ([PAIR_ENDS, kept, PAIR_ENDS] if is_restored else [PAIR_ENDS, kept])
    assert [(pair.image_a, pair.image_b) for pair in extraction.problem.pairs] == used
    assert mapping.reconstructions == (results[-1],)
    assert passes.jumps == ([Jump(NAMES[19], NAMES[20])] if results[-1] is JUMPING else [])
