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
KEPT = [(0, 1), (19, 20)]
ACROSS = [(5, 25), (6, 26)]
"""Image pairs with one frame before and one frame after the jump of the camera."""


class Images(list[SimpleNamespace]):
    """Images whose cameras do not change."""

    names = NAMES


def build_problem(num_matches: tuple[int, int]) -> MappingProblem:
    """Build a problem with the given numbers of matches of the two pairs across the jump."""
    normals = np.zeros((6, 8, 3), np.float32)
    normals[..., 2] = -1
    flat = NormalPrior.from_arrays(normals, np.ones((6, 8), np.float32))
    images = [MappingImage(name, CAMERA, np.zeros((40, 2)), DEPTH, flat) for name in NAMES]

    def build_pair(a: int, b: int, number: int) -> VerifiedPair:
        matches = np.tile(np.arange(number)[:, None], 2)
        scores = np.ones(number, np.float32)
        return VerifiedPair(a, b, matches, scores, np.eye(3), np.array([1.0, 0, 0]))

    numbers = dict.fromkeys(KEPT, 20) | dict(zip(ACROSS, num_matches, strict=True))
    pairs = (build_pair(a, b, number) for (a, b), number in sorted(numbers.items()))
    return MappingProblem(tuple(images), tuple(pairs))


@pytest.mark.parametrize(
    ("results", "num_matches", "restored", "final"),
    [
        pytest.param([JUMPING, STEADY], (14, 14), [], STEADY, id="false-matches"),
        pytest.param([JUMPING, JUMPING], (14, 14), [], JUMPING, id="jump-remains"),
        pytest.param([JUMPING, STEADY, STEADY], (15, 14), ACROSS[:1], STEADY, id="some-right"),
        pytest.param([JUMPING, STEADY], (15, 15), ACROSS, JUMPING, id="first-result-was-right"),
    ],
)
def test_pairs_across_a_jump_are_removed_unless_the_model_without_them_confirms_them(
    monkeypatch: pytest.MonkeyPatch,
    results: list[Reconstruction],
    num_matches: tuple[int, int],
    restored: list[tuple[int, int]],
    final: Reconstruction,
) -> None:
    """If all removed pairs are right, the first result is used without another mapping."""
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
    used = sorted(KEPT + restored)
    assert mapped == [sorted(KEPT + ACROSS), KEPT, used][: len(results)]
    assert [(pair.image_a, pair.image_b) for pair in extraction.problem.pairs] == used
    assert mapping.reconstructions == (final,)
    assert passes.jumps == ([Jump(NAMES[19], NAMES[20])] if final is JUMPING else [])
