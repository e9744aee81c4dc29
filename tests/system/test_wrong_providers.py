"""Tests of runs whose features provider or matcher is wrong for all photos."""

from __future__ import annotations

import contextlib
import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

import mpsfm_core
from mpsfm_core import Features, PairMatches, ProviderSpec, SparseMatches, View
from mpsfm_core.data import Float32
from mpsfm_core.data.errors import ProviderRunError, ReconstructionError
from mpsfm_core.providers.builtin.mutual_nearest import MutualNearest
from mpsfm_core.providers.builtin.options import MutualNearestOptions, SiftOptions
from mpsfm_core.providers.builtin.sift import Sift
from mpsfm_core.providers.registry import Registry
from mpsfm_core.report.findings import findings
from mpsfm_core.report.verdict import judge

BUFFER_SIZE = 2100


class Reduced(Sift):
    """Features provider that returns keypoints in pixels of the reduced photo."""

    def __init__(self, options: Any, context: Any) -> None:
        super().__init__(SiftOptions(), context)

    def extract(self, view: View) -> Features:
        image = cv2.resize(view.image, None, fx=0.6, fy=0.6, interpolation=cv2.INTER_AREA)
        size = image.shape[1], image.shape[0]
        return super().extract(View(view.name, image, view.camera.resized(*size)))


class Limited(MutualNearest):
    """Matcher that raises an exception if a photo has more keypoints than its buffer."""

    def __init__(self, options: Any, context: Any) -> None:
        super().__init__(MutualNearestOptions(), context)

    def match(self, view_a: View, view_b: View, a: Any = None, b: Any = None) -> PairMatches:
        if max(len(a), len(b)) > BUFFER_SIZE:
            raise RuntimeError(f"shape mismatch: {max(len(a), len(b))} > {BUFFER_SIZE}")
        return super().match(view_a, view_b, a, b)


class Inverted(MutualNearest):
    """Matcher whose scores are distances."""

    def __init__(self, options: Any, context: Any) -> None:
        super().__init__(MutualNearestOptions(ratio=None), context)

    def match(self, view_a: View, view_b: View, a: Any = None, b: Any = None) -> PairMatches:
        sparse = super().match(view_a, view_b, a, b).sparse
        assert sparse is not None
        return PairMatches(sparse=SparseMatches(sparse.indices, self._change(sparse.scores)))

    def _change(self, scores: Float32) -> Float32:
        return 1 - scores


class Shuffled(Inverted):
    """Matcher whose scores belong to other matches of the pair."""

    def _change(self, scores: Float32) -> Float32:
        return np.random.default_rng(len(scores)).permutation(scores)


class Constant(Inverted):
    """Matcher without confidences."""

    def _change(self, scores: Float32) -> Float32:
        return np.ones_like(scores)


class AllSift(Sift):
    """Features of another provider than those of the fast pass."""

    def __init__(self, options: Any, context: Any) -> None:
        super().__init__(SiftOptions(), context)


def run(photo_scene, output: Path, *settings: str, **providers: str) -> dict[str, Any]:
    """Reconstruct the photos with wrong providers, and return the summary."""
    registry = Registry.discover()
    sparse = frozenset({"sparse"})
    registry.add(
        ProviderSpec("features", "reduced", Reduced),
        ProviderSpec("matcher", "limited", Limited, capabilities=sparse),
        ProviderSpec("features", "all-sift", AllSift),
        ProviderSpec("matcher", "inverted", Inverted, capabilities=sparse),
        ProviderSpec("matcher", "shuffled", Shuffled, capabilities=sparse),
        ProviderSpec("matcher", "constant", Constant, capabilities=sparse),
    )
    overrides = ["dense.enabled=false", "results.report=false", *settings]
    overrides.append(f"runtime.cache_dir={output.parent / 'cache'}")
    with contextlib.suppress(ReconstructionError):
        mpsfm_core.reconstruct(
            photo_scene.images,
            output,
            photo_scene.config,
            intrinsics=photo_scene.intrinsics,
            registry=registry,
            overrides=overrides,
            **providers,
        )
    summary: dict[str, Any] = json.loads((output / "summary.json").read_text())
    return summary


@pytest.mark.parametrize(
    ("kind", "provider", "code"),
    [
        ("features", "reduced", "partial-coverage"),
        ("matcher", "inverted", "meaningless-scores"),
        ("matcher", "shuffled", "meaningless-scores"),
    ],
)
def test_run_with_wrong_provider_is_not_good_and_names_the_provider(
    kind: str, provider: str, code: str, photo_scene, tmp_path: Path
) -> None:
    summary = run(photo_scene, tmp_path / "out", **{kind: provider})
    verdict = judge(summary)
    assert verdict.level in ("doubtful", "failed")
    assert [doubt.reason.code.value for doubt in verdict.doubts] == [code]
    assert any(f"mpsfm plugins check {provider}" in text for text in summary["warnings"])
    assert any(provider in finding.text for finding in findings(summary))


def test_run_with_constant_scores_is_good(photo_scene, tmp_path: Path) -> None:
    assert judge(run(photo_scene, tmp_path / "out", matcher="constant")).level == "good"


def test_run_with_wrong_matcher_in_second_pass_names_the_matcher(
    photo_scene, tmp_path: Path
) -> None:
    sift = "{use: sift, options: {max_keypoints: 30}}"
    fast_pass = f"fast_pass={{features: {sift}, matcher: {{use: mutual-nearest}}}}"
    output = tmp_path / "out"
    summary = run(photo_scene, output, fast_pass, features="all-sift", matcher="shuffled")
    (doubt,) = summary["doubts"]
    assert (doubt["code"], doubt["provider"]) == ("meaningless-scores", "shuffled")


def test_run_with_matcher_of_limited_size_names_the_matcher_or_leaves_out_its_pairs(
    photo_scene, tmp_path: Path
) -> None:
    with pytest.raises(ProviderRunError, match=r"'limited', image '.*shape mismatch: 2\d\d\d >"):
        run(photo_scene, tmp_path / "out", matcher="limited")
    summary = run(photo_scene, tmp_path / "out", "runtime.on_error=skip", matcher="limited")
    failed = [text for text in summary["warnings"] if "provider 'limited'" in text]
    assert 0 < len(failed) < 5
    assert len(summary["images"]["registered"]) >= 4
