"""Tests of runs whose features provider or matcher is wrong for all photos."""

from __future__ import annotations

import contextlib
import json
from pathlib import Path
from typing import Any

import cv2
import pytest

import mpsfm_core
from mpsfm_core import Features, PairMatches, ProviderSpec, SparseMatches, View
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
        return PairMatches(sparse=SparseMatches(sparse.indices, 1 - sparse.scores))


def run(photo_scene, output: Path, *settings: str, **providers: str) -> dict[str, Any]:
    """Reconstruct the photos with wrong providers, and return the summary."""
    registry = Registry.discover()
    sparse = frozenset({"sparse"})
    registry.add(
        ProviderSpec("features", "reduced", Reduced),
        ProviderSpec("matcher", "limited", Limited, capabilities=sparse),
        ProviderSpec("matcher", "inverted", Inverted, capabilities=sparse),
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


def test_run_with_matcher_of_limited_size_names_the_matcher_or_leaves_out_its_pairs(
    photo_scene, tmp_path: Path
) -> None:
    with pytest.raises(ProviderRunError, match=r"'limited', image '.*shape mismatch: 2\d\d\d >"):
        run(photo_scene, tmp_path / "out", matcher="limited")
    summary = run(photo_scene, tmp_path / "out", "runtime.on_error=skip", matcher="limited")
    failed = [text for text in summary["warnings"] if "provider 'limited'" in text]
    assert 0 < len(failed) < 5
    assert len(summary["images"]["registered"]) >= 4
