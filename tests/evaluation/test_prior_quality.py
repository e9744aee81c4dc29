"""Tests of depth priors of known quality."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from mpsfm_core.evaluation.prior_quality import parse_error_seed, prior_overrides, read_depth
from mpsfm_core.evaluation.scene_folder import read_scene


@pytest.mark.parametrize(
    ("quality", "seed"),
    [
        ("degraded", 0),
        ("degraded-0", 0),
        ("degraded-12", 12),
        ("sensor", None),
        ("degraded-", None),
    ],
)
def test_parse_error_seed_reads_name(quality: str, seed: int | None) -> None:
    assert parse_error_seed(quality) == seed


def test_degraded_seeds_give_different_errors_of_equal_std(
    scene_folder: Path, tmp_path: Path
) -> None:
    scene = read_scene(scene_folder)
    assert scene.depth is not None
    image = sorted(scene.truth)[0]
    stem = Path(image).stem
    truth = read_depth(scene.depth / f"{stem}.png")
    errors = []
    for quality in ("degraded", "degraded-0", "degraded-1"):
        folder = tmp_path / quality
        settings = prior_overrides(quality, scene, [image], folder)
        assert "depth.options.relative_std=0.05" in settings
        known = truth > 0
        errors.append(np.log(read_depth(folder / f"{stem}.png")[known] / truth[known]))
    first, same, other = errors
    np.testing.assert_array_equal(first, same)
    assert np.corrcoef(first, other)[0, 1] < 0.9
    for error in (first, other):
        assert 0.01 < error.std() < 0.1
