"""Tests of each rule of the validator and of the errors of providers that fail."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from mpsfm_core import (
    DenseMatches,
    DepthPrior,
    Features,
    NormalPrior,
    PairDepth,
    PairMatches,
    PinholeCamera,
    ProviderSpec,
    SparseMatches,
    View,
)
from mpsfm_core.data.errors import (
    DataError,
    MpsfmError,
    ProviderOutputError,
    ProviderRunError,
    WeightsError,
)
from mpsfm_core.providers.kinds.depth import run_depth, run_focal, run_joint
from mpsfm_core.providers.kinds.features import run_features
from mpsfm_core.providers.kinds.mask import run_mask
from mpsfm_core.providers.kinds.matcher import run_matcher
from mpsfm_core.providers.kinds.normals import run_normals
from mpsfm_core.providers.kinds.retrieval import run_retrieval

VIEW = View("a.jpg", np.zeros((4, 6, 3), np.uint8), PinholeCamera(6, 4, 5.0, 5.0, 3.0, 2.0))
OTHER = View("b.jpg", np.zeros((8, 8, 3), np.uint8), PinholeCamera(8, 8, 5.0, 5.0, 4.0, 4.0))


def spec(kind: str, *capabilities: str) -> ProviderSpec:
    return ProviderSpec(kind, "odd", "a:A", capabilities=frozenset(capabilities))


def depth(**changes: Any) -> DepthPrior:
    values: dict[str, Any] = {
        "depth": np.ones((2, 3), np.float32),
        "variance": None,
        "valid": np.ones((2, 3), bool),
    }
    return DepthPrior(**(values | changes))


def normals(variance: float | None = None) -> NormalPrior:
    facing = np.tile(np.float32([0, 0, -1]), (2, 3, 1))
    given = None if variance is None else np.full((2, 3), variance, np.float32)
    return NormalPrior(facing, given, np.ones((2, 3), bool))


def turned(n_x: float, n_z: float) -> NormalPrior:
    """Return normals (n_x, 0, n_z) at two of six pixels, in the last column; the rest face the
    optical axis."""
    values = np.tile(np.array([0, 0, -1], np.float32), (2, 3, 1))
    values[:, 2] = n_x, 0, n_z
    return NormalPrior(values, None, np.ones((2, 3), bool))


def features(*points: tuple[float, float]) -> Features:
    return Features(np.array(points, float).reshape(-1, 2), np.ones((len(points), 4), np.float32))


def sparse(*indices: tuple[int, int]) -> PairMatches:
    scores = np.ones(len(indices), np.float32)
    return PairMatches(SparseMatches(np.array(indices, np.int64).reshape(-1, 2), scores))


def dense(a: tuple[float, float], b: tuple[float, float]) -> PairMatches:
    return PairMatches(
        dense=DenseMatches(np.array([a], float), np.array([b], float), np.ones(1, np.float32))
    )


class Provider:
    """Provider that answers every call with the return value of a given function."""

    def __init__(self, make: Callable[[], Any]) -> None:
        self.make = make
        self.arguments: tuple[Any, ...] = ()

    def _answer(self, *arguments: Any) -> Any:
        self.arguments = arguments
        return self.make()

    predict = predict_joint = estimate_focal = extract = match = describe = mask = _answer


def written_to_later() -> DepthPrior:
    values = np.ones((2, 3), np.float32)
    prior = depth(depth=values)
    values[0, 0] = np.nan
    return prior


@pytest.mark.parametrize(
    ("run", "capabilities", "make", "field", "rule"),
    [
        (run_depth, (), lambda: np.ones((2, 3)), "depth", "must be a DepthPrior, got ndarray"),
        (run_depth, (), lambda: None, "depth", "got NoneType"),
        (run_depth, (), lambda: depth(depth=np.full((2, 3), np.nan, "f4")), "depth", "finite"),
        (run_depth, (), lambda: depth(depth=np.ones((2, 3))), "depth", "dtype float32"),
        (run_depth, (), lambda: depth(depth=-np.ones((2, 3), "f4")), "depth", "positive"),
        (run_depth, (), written_to_later, "depth", "finite"),
        (
            run_depth,
            (),
            lambda: depth(depth=np.ones((0, 3), "f4"), valid=np.ones((0, 3), bool)),
            "depth",
            "must not be empty",
        ),
        (
            run_depth,
            ("metric",),
            lambda: depth(metric=False),
            "depth",
            "declared capability 'metric'",
        ),
        (run_depth, ("variance",), depth, "variance", "declared capability 'variance'"),
        (run_joint, (), depth, "output", r"must be a pair \(depth, normals\), got DepthPrior"),
        (run_joint, (), lambda: (depth(), depth()), "normals", "must be a NormalPrior"),
        (run_focal, (), lambda: 0.0, "focal", "positive number of pixels, got 0.0"),
        (run_focal, (), lambda: float("nan"), "focal", "positive number of pixels, got nan"),
        (run_focal, (), lambda: "wide", "focal", "positive number of pixels, got 'wide'"),
        (run_normals, (), depth, "normals", "must be a NormalPrior, got DepthPrior"),
        (run_normals, ("variance",), normals, "variance", "declared capability 'variance'"),
        (run_normals, (), lambda: normals(25.0), "variance", r"rad\^2, but its median is 25"),
        (run_normals, (), lambda: turned(0, 1), "normals", r"n \. ray < 0.*33.3 % of the valid"),
        (run_features, (), lambda: features((1, 1), (6.5, 1)), "keypoints", r"6x4.*\(6.50, 1.00\)"),
        (run_features, (), lambda: features((np.nan, 1)), "keypoints", "finite"),
        (run_retrieval, (), lambda: [1.0], "descriptor", "numpy array, got list"),
        (run_retrieval, (), lambda: np.ones(3), "descriptor", "1-dimensional float32"),
        (run_retrieval, (), lambda: np.ones(0, np.float32), "descriptor", "not be empty"),
        (run_retrieval, (), lambda: np.full(3, np.inf, np.float32), "descriptor", "finite"),
        (run_mask, (), lambda: np.ones((4, 6), np.uint8), "mask", "2-dimensional bool"),
        (run_mask, (), lambda: np.ones((6, 4), bool), "mask", r"shape \(4, 6\), got \(6, 4\)"),
    ],
)
def test_output_that_violates_a_rule_raises(
    run: Callable[..., Any],
    capabilities: tuple[str, ...],
    make: Callable[[], Any],
    field: str,
    rule: str,
) -> None:
    kind = run.__name__.removeprefix("run_").replace("joint", "depth").replace("focal", "depth")
    with pytest.raises(ProviderOutputError, match=rule) as caught:
        run(spec(kind, *capabilities), Provider(make), VIEW)
    assert (caught.value.provider, caught.value.image) == ("odd", "a.jpg")
    assert caught.value.field == field


@pytest.mark.parametrize(
    ("capabilities", "answer", "field", "rule"),
    [
        (("sparse",), "matches", "matches", "must be a PairMatches"),
        (("sparse",), dense((1, 1), (1, 1)), "sparse", "declared capability 'sparse'"),
        (("dense",), sparse((0, 0)), "dense", "declared capability 'dense'"),
        (("sparse", "pair-depth"), sparse((0, 0)), "depth", "declared capability 'pair-depth'"),
        (("sparse",), sparse((0, 0), (2, 1)), "indices", "below 2, the features of view a, got 2"),
        (("sparse",), sparse((0, 0), (1, 3)), "indices", "below 3, the features of view b, got 3"),
        (("dense",), dense((7, 1), (7, 7)), "points_a", "6x4 image"),
        (("dense",), dense((5, 3), (-0.1, 7)), "points_b", "8x8 image"),
        (
            ("metric", "sparse"),
            PairMatches(sparse().sparse, depth=PairDepth(depth(), depth(metric=False))),
            "depth_b",
            "declared capability 'metric'",
        ),
    ],
)
def test_matches_that_break_a_rule(
    capabilities: tuple[str, ...], answer: Any, field: str, rule: str
) -> None:
    pair = features((1, 1), (2, 2)), features((1, 1), (2, 2), (3, 3))
    with pytest.raises(ProviderOutputError, match=rule) as caught:
        run_matcher(spec("matcher", *capabilities), Provider(lambda: answer), (VIEW, OTHER), pair)
    assert caught.value.image == "a.jpg - b.jpg"
    assert caught.value.field == field


def test_sparse_matches_without_features() -> None:
    with pytest.raises(ProviderOutputError, match="no features"):
        run_matcher(spec("matcher"), Provider(lambda: sparse((0, 0))), (VIEW, OTHER))


def test_right_answers_pass_unchanged() -> None:
    """Check that a provider may return more fields than its capabilities promise, but not fewer."""
    prior = run_depth(spec("depth"), Provider(lambda: depth(metric=True)), VIEW)
    assert prior.metric and np.array_equal(prior.depth, np.ones((2, 3)))
    joint = run_joint(spec("depth", "variance"), Provider(_joint), VIEW)
    assert joint[0].variance is not None and joint[1].variance is None
    assert (
        len(run_features(spec("features"), Provider(lambda: features((0, 0), (6, 4))), VIEW)) == 2
    )
    assert run_retrieval(spec("retrieval"), Provider(lambda: np.ones(3, "f4")), VIEW).shape == (3,)
    assert run_mask(spec("mask"), Provider(lambda: np.zeros((4, 6), bool)), VIEW).sum() == 0
    both = PairMatches(
        sparse((0, 1)).sparse, dense((6, 4), (8, 8)).dense, PairDepth(depth(), depth())
    )
    pair = features((1, 1)), features((1, 1), (2, 2))
    declared = spec("matcher", "sparse", "dense", "pair-depth")
    found = run_matcher(declared, Provider(lambda: both), (VIEW, OTHER), pair)
    assert found.sparse is not None and len(found.sparse) == 1
    assert found.depth is not None and found.depth.depth_a.metric


def _joint() -> tuple[DepthPrior, NormalPrior]:
    return depth(variance=np.ones((2, 3), np.float32)), normals()


def test_normal_must_face_the_camera_along_its_ray() -> None:
    """Check normals at the last column, whose ray is (0.4, 0, 1): the sign of n_z alone does not
    decide."""
    assert run_normals(spec("normals"), Provider(lambda: turned(-0.96, 0.28)), VIEW).valid.all()
    with pytest.raises(ProviderOutputError, match="face the camera"):
        run_normals(spec("normals"), Provider(lambda: turned(0.96, -0.28)), VIEW)
    marked = NormalPrior.from_arrays(turned(0.96, -0.28).normals, camera=VIEW.camera)
    assert marked.valid.tolist() == [[True, True, False]] * 2


def test_features_and_depth_are_given_only_when_declared() -> None:
    pair = features((1, 1)), features((1, 1))
    provider = Provider(lambda: dense((1, 1), (1, 1)))
    run_matcher(spec("matcher", "dense"), provider, (VIEW, OTHER), pair)
    assert provider.arguments[2:] == (None, None)
    provider = Provider(lambda: sparse((0, 0)))
    run_matcher(spec("matcher", "sparse"), provider, (VIEW, OTHER), pair)
    assert provider.arguments[2:] == pair

    prior = depth()
    provider = Provider(normals)
    run_normals(spec("normals"), provider, VIEW, prior)
    assert provider.arguments[1] is None
    run_normals(spec("normals", "needs-depth"), provider, VIEW, prior)
    assert provider.arguments[1] is prior


@pytest.mark.parametrize(
    ("error", "expected", "message"),
    [
        (RuntimeError("CUDA error"), ProviderRunError, "RuntimeError: CUDA error"),
        (SystemExit(3), ProviderRunError, "SystemExit: 3"),
        (MemoryError(), ProviderRunError, "out of memory; reduce"),
        (DataError("depth", "must be finite"), ProviderOutputError, "depth: must be finite"),
    ],
)
def test_exception_of_provider_names_provider_and_image(
    error: BaseException, expected: type[MpsfmError], message: str
) -> None:
    with pytest.raises(expected, match=message) as caught:
        run_depth(spec("depth"), Provider(_raising(error)), VIEW)
    assert "'odd'" in str(caught.value) and "'a.jpg'" in str(caught.value)
    assert caught.value.__cause__ is error


@pytest.mark.parametrize("error", [WeightsError("no model.onnx"), KeyboardInterrupt()])
def test_our_errors_and_interrupts_pass(error: BaseException) -> None:
    with pytest.raises(type(error)) as caught:
        run_depth(spec("depth"), Provider(_raising(error)), VIEW)
    assert caught.value is error


def _raising(error: BaseException) -> Callable[[], Any]:
    def make() -> Any:
        raise error

    return make
