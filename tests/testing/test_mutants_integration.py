"""Providers with the faults that integrators make around a network, one for each newer check."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mpsfm_core import (
    DenseMatches,
    DepthPrior,
    Features,
    MultiViewPrior,
    NormalPrior,
    PairMatches,
    ProviderContext,
    SparseMatches,
    View,
)
from mpsfm_core.data import Float64
from mpsfm_core.providers.builtin.options import SiftOptions
from mpsfm_core.testing import ContractSetup
from mpsfm_core.testing.contract import check_id, list_checks
from mpsfm_core.testing.painted_views import RELATIVE_STD, read_depth
from tests.support import reference_providers as ref
from tests.support.reference_providers import (
    PaintedDepth,
    PaintedMask,
    Thumbnail,
    Wrapper,
)
from tests.support.sparse_providers import (
    CellMatcher,
    DenseSift,
    NearestMatcher,
    SiftDetector,
)
from tests.testing import (
    test_mutants_any_kind,
    test_mutants_camera,
    test_mutants_maps,
    test_mutants_matching,
    test_mutants_multiview,
    test_mutants_sizes,
    test_mutants_views,
)

PAINTED = ContractSetup(truth_source="painted")
SPECIAL = {"specification", "construction", "light-import", "speed", "camera-mirror"}
"""Checks with tests of their own, and ``speed``, whose limit of 20 s no quick test exceeds."""


class HashSeed(PaintedDepth):
    """Fault: a random number depends on the hash of a text, which differs between processes."""

    def predict(self, view: View) -> DepthPrior:
        factor = 1 + hash("network") % 1000 * 1e-4
        return ref.depth_prior(factor * read_depth(view.image))


class SeedsNumpy(PaintedDepth):
    def predict(self, view: View) -> DepthPrior:
        np.random.seed(0)
        return super().predict(view)


class HidesGpu(PaintedDepth):
    def __init__(self, options: Any, context: ProviderContext) -> None:
        super().__init__(options, context)
        os.environ["MPSFM_TEST_DEVICES"] = ""

    def predict(self, view: View) -> DepthPrior:
        os.environ.pop("MPSFM_TEST_DEVICES", None)
        return super().predict(view)


class DebugImage(PaintedDepth):
    def predict(self, view: View) -> DepthPrior:
        Path("debug.png").touch()
        return super().predict(view)


class NativeOutput(PaintedDepth):
    def predict(self, view: View) -> DepthPrior:
        os.write(1, b"loading the network\n")
        return super().predict(view)


class OpenFiles(PaintedDepth):
    def __init__(self, options: Any, context: ProviderContext) -> None:
        super().__init__(options, context)
        self.files: list[int] = []

    def __del__(self) -> None:
        for file in self.files:
            os.close(file)

    def predict(self, view: View) -> DepthPrior:
        self.files.append(os.open(os.devnull, os.O_RDONLY))
        return super().predict(view)


class ReusedBuffer(PaintedDepth):
    """Fault: returns a view of a buffer that the next call overwrites."""

    buffer: np.ndarray | None = None

    def predict(self, view: View) -> DepthPrior:
        prior = super().predict(view)
        if self.buffer is None or self.buffer.shape != prior.shape:
            self.buffer = np.empty_like(prior.depth)
        self.buffer[:] = prior.depth
        return DepthPrior(self.buffer, prior.variance, prior.valid)


class ReducesLargeViews(PaintedDepth):
    """Fault: large views are cropped to the input of the network."""

    def predict(self, view: View) -> DepthPrior:
        return ref.depth_prior(read_depth(view.image[:1024, :1024]))


class MirroredVariance(PaintedDepth):
    def predict(self, view: View) -> DepthPrior:
        depth = read_depth(view.image)
        variance = (RELATIVE_STD * np.where(depth > 0, depth, 4)) ** 2
        return DepthPrior.from_arrays(depth, variance[:, ::-1])


class StdWithoutFocal(PaintedDepth):
    """Fault: the focal length scales depth, but not its std."""

    def predict(self, view: View) -> DepthPrior:
        depth = read_depth(view.image)
        factor = (view.camera.fx + view.camera.fy) / 1.5 / max(view.camera.size)
        return DepthPrior.from_arrays(factor * depth, (RELATIVE_STD * depth) ** 2)


class ShiftedMask(PaintedMask):
    def mask(self, view: View) -> np.ndarray:
        return np.roll(super().mask(view), 2, axis=0)


class StretchedMask(PaintedMask):
    """Fault: the probability of sky is stretched to 0 to 1, as if each image had sky."""

    def mask(self, view: View) -> np.ndarray:
        depth = read_depth(view.image)
        sky = (depth.max() - depth) / max(float(np.ptp(depth)), 1e-6)
        return np.asarray(sky <= 0.5)


class UpperLeft(Thumbnail):
    """Fault: describes 100 x 100 pixels instead of the whole view."""

    def describe(self, view: View) -> np.ndarray:
        image = np.ascontiguousarray(view.image[:100, :100])
        digest = hashlib.sha256(str(view.image.shape).encode()).digest()
        noise = np.frombuffer(digest, np.uint8).astype(np.float32) - 127.5
        vector = super().describe(replace(view, image=image, camera=_camera_of(view, image)))
        joined = np.concatenate([vector, noise / np.linalg.norm(noise)]).astype(np.float32)
        return joined / np.linalg.norm(joined)


def _camera_of(view: View, image: np.ndarray) -> Any:
    return replace(view.camera, width=image.shape[1], height=image.shape[0])


@pytest.mark.parametrize(
    ("kind", "check", "message", "factory", "capabilities"),
    [
        ("depth", "second-process", "output in a second process differs", HashSeed, ()),
        ("depth", "global-state", "call .* changes the random numbers of numpy", SeedsNumpy, ()),
        ("depth", "global-state", "constructing .* MPSFM_TEST_DEVICES", HidesGpu, ()),
        ("depth", "global-state", "files of the working directory", DebugImage, ()),
        ("depth", "standard-output", "prints .*loading the network", NativeOutput, ()),
        ("depth", "memory-released", "calls leave .* files open", OpenFiles, ()),
        ("depth", "no-state", "or of an earlier call", ReusedBuffer, ()),
        ("depth", "large-view", "relative error|shifted", ReducesLargeViews, ()),
        ("depth", "depth-variance", "belongs to other pixels", MirroredVariance, ()),
        ("depth", "depth-intrinsics", "but its std 1.00", StdWithoutFocal, ("intrinsics-aware",)),
        ("mask", "mask-place", r"shifted by \(\+0, \+2\) px", ShiftedMask, ()),
        ("mask", "mask-polarity", "pixels of a room are usable", StretchedMask, ()),
        ("retrieval", "retrieval-sizes", "but .* to another scene", UpperLeft, ()),
    ],
)
def test_faulty_map_provider_fails_its_check(
    caught: Callable[..., None],
    kind: Any,
    check: str,
    message: str,
    factory: type,
    capabilities: tuple[str, ...],
) -> None:
    setup = None if kind == "retrieval" else PAINTED
    caught(kind, factory, check, message, setup, *capabilities)


class Detector(SiftDetector):
    sift_options = SiftOptions(max_keypoints=800)

    def select(self, features: Features, keep: np.ndarray) -> Features:
        assert features.scales is not None
        return Features(
            features.keypoints[keep],
            features.descriptors[keep],
            scales=features.scales[keep],
            std_px=features.std_px,
        )


class FirstRows(Detector):
    def extract(self, view: View) -> Features:
        features = super().extract(view)
        return self.select(features, features.keypoints[:, 1] < view.camera.height / 2)


class FirstTile(Detector):
    def extract(self, view: View) -> Features:
        features = super().extract(view)
        return self.select(features, (features.keypoints < 1600).all(axis=1))


class LowIsStrong(Detector):
    """Fault: scores are inverted, so that the limit of features keeps the weakest."""

    def extract(self, view: View) -> Features:
        features = super().extract(view)
        deviation = np.abs(view.image.mean(axis=-1) - 128)
        columns, rows = (features.keypoints - 0.5).astype(int).T
        return replace(features, scores=-deviation[rows, columns].astype(np.float32))


class ScalesOfNetwork(Detector):
    def extract(self, view: View) -> Features:
        features = super().extract(view)
        assert features.scales is not None
        return replace(features, scales=features.scales * np.float32(192 / view.camera.width))


class StdOfNetwork(Detector):
    """Fault: keypoints have an error of 2 pixels, and the std of a detector without error."""

    def extract(self, view: View) -> Features:
        features = super().extract(view)
        noise = np.random.default_rng(len(features)).normal(0, 2.0, features.keypoints.shape)
        inside = np.clip(features.keypoints + noise, 0, view.camera.size)
        return replace(features, keypoints=inside, std_px=0.25)


class Triplicates(Detector):
    """Fault: returns each feature once per pyramid level."""

    def extract(self, view: View) -> Features:
        features = super().extract(view)
        return features.select(np.repeat(np.arange(len(features)), 3))


@pytest.mark.parametrize(
    ("factory", "check", "message"),
    [
        (Triplicates, "features-descriptors", "only 33% of the features are different"),
        (FirstRows, "features-coverage", "keypoints cover . of 9 parts"),
        (FirstTile, "features-large-view", "and 0% of the keypoints"),
        (LowIsStrong, "features-scores", "without contrast have higher scores"),
        (ScalesOfNetwork, "features-scales", "scales are .* times"),
        (StdOfNetwork, "features-std", "times the declared std_px"),
    ],
)
def test_faulty_features_provider_fails_its_check(
    caught: Callable[..., None], factory: type, check: str, message: str
) -> None:
    caught("features", factory, check, message)


class Nearest(NearestMatcher):
    def match(self, a: View, b: View, fa: Any = None, fb: Any = None) -> PairMatches:
        sparse = super().match(a, b, fa, fb).sparse
        assert sparse is not None
        keep, scores = self.change(sparse, (a, b), (fa, fb))
        return PairMatches(SparseMatches(sparse.indices[keep], scores[keep]))

    def change(self, found: SparseMatches, views: Any, features: Any) -> tuple[Any, Any]:
        raise NotImplementedError


class SizeOfFirst(Nearest):
    """Fault: both images are normalized by the size of the first."""

    def change(self, found: SparseMatches, views: Any, features: Any) -> tuple[Any, Any]:
        points = [f.keypoints[found.indices[:, i]] for i, f in enumerate(features)]
        offset = np.abs(points[0] - points[1]) / views[0].camera.size
        return (offset < 0.6).all(axis=1), found.scores


class LeftOnly(Nearest):
    def change(self, found: SparseMatches, views: Any, features: Any) -> tuple[Any, Any]:
        x = features[0].keypoints[found.indices[:, 0], 0]
        return x < views[0].camera.width / 3, found.scores


class FirstThousand(Nearest):
    def change(self, found: SparseMatches, views: Any, features: Any) -> tuple[Any, Any]:
        return (found.indices < 1024).all(axis=1), found.scores


class LogScores(Nearest):
    """Fault: log probabilities are clipped to 0."""

    def change(self, found: SparseMatches, views: Any, features: Any) -> tuple[Any, Any]:
        return slice(None), np.clip(np.log(found.scores), 0, 1)


class FiltersByMask(Nearest):
    """Fault: the indices belong to the keypoints inside of the mask."""

    def match(self, a: View, b: View, fa: Any = None, fb: Any = None) -> PairMatches:
        if a.mask is not None:
            columns, rows = fa.keypoints.astype(int).T.clip(0, 143)
            inside = a.mask[rows, columns]
            fa = Features(fa.keypoints[inside], fa.descriptors[inside])
        return super().match(a, b, fa, fb)

    def change(self, found: SparseMatches, views: Any, features: Any) -> tuple[Any, Any]:
        return slice(None), found.scores


class DistanceScores(Nearest):
    def change(self, found: SparseMatches, views: Any, features: Any) -> tuple[Any, Any]:
        return slice(None), 1 - found.scores


class InventsMatches(DenseSift):
    """Fault: matches the same pixels of both images if too few matches are found."""

    def match(self, a: View, b: View, fa: Any = None, fb: Any = None) -> PairMatches:
        found = super().match(a, b)
        if found.dense is not None and len(found.dense) >= 30:
            return found
        grid = np.random.default_rng(0).uniform(0, 100, (50, 2))
        return PairMatches(dense=DenseMatches(grid, grid, np.ones(50, np.float32)))


class OverlappingWindows(DenseSift):
    """Fault: returns each match once per window that contains it."""

    def match(self, a: View, b: View, fa: Any = None, fb: Any = None) -> PairMatches:
        matches = super().match(a, b).dense
        assert matches is not None
        parts = (matches.points_a, matches.points_b, matches.scores)
        return PairMatches(dense=DenseMatches(*(np.repeat(part, 5, axis=0) for part in parts)))


class CellCorners(CellMatcher):
    """Fault: returns the upper left corners of cells instead of their centers."""

    offset_px = 0.0


class IntegerPositions(DenseSift):
    """Fault: rounds positions down to integers."""

    def move(self, xy: Float64) -> Float64:
        return np.floor(xy)


class CropsToStride(DenseSift):
    """Fault: crops both images to multiples of 32 and does not add the offset of the crop."""

    def match(self, a: View, b: View, fa: Any = None, fb: Any = None) -> PairMatches:
        return super().match(self.crop(a), self.crop(b))

    def crop(self, view: View) -> View:
        height, width = (max(1, side // 32 * 32) for side in view.image.shape[:2])
        top, left = (view.camera.height - height) // 2, (view.camera.width - width) // 2
        image = np.ascontiguousarray(view.image[top : top + height, left : left + width])
        return View(view.name, image, _camera_of(view, image))


@pytest.mark.parametrize(
    ("factory", "check", "message"),
    [
        (InventsMatches, "matcher-scores", "50 matches with a view without texture score 1.00"),
        (OverlappingWindows, "matcher-coverage", "only .*% of the matches are different"),
        (CellCorners, "matcher-pixel-convention", "shifted by"),
        (IntegerPositions, "matcher-pixel-convention", "shifted by"),
        (CropsToStride, "matcher-pixel-convention", r"3/4 of the size are shifted by \(\+10"),
    ],
)
def test_faulty_dense_matcher_fails_its_check(
    caught: Callable[..., None], factory: type, check: str, message: str
) -> None:
    caught("matcher", factory, check, message, None, "dense")


@pytest.mark.parametrize(
    ("factory", "check", "message"),
    [
        (SizeOfFirst, "matcher-sizes", "only 0 matches|of the overlap"),
        (LeftOnly, "matcher-coverage", "cover only 3 of 9"),
        (FirstThousand, "matcher-many-features", "use only the first 2.%"),
        (DistanceScores, "matcher-scores", "reliable matches score"),
        (LogScores, "matcher-scores", "all matches have the score 0.00"),
        (FiltersByMask, "masked", "matches are wrong"),
    ],
)
def test_faulty_matcher_fails_its_check(
    caught: Callable[..., None], factory: type, check: str, message: str
) -> None:
    caught("matcher", factory, check, message, None, "sparse")


class UnitOfLateViews(ref.ToldGroup):
    """Fault: the depth of the fifth and later views of a group has another unit."""

    def predict_group(self, views: Sequence[View]) -> MultiViewPrior:
        group = super().predict_group(views)
        depth = [
            ref.depth_prior(p.depth * (1.3 if i > 3 else 1)) for i, p in enumerate(group.depth)
        ]
        return replace(group, depth=tuple(depth))


def test_faulty_multiview_provider_fails_its_check(caught: Callable[..., None]) -> None:
    caught(
        "multiview",
        UnitOfLateViews,
        *("multiview-group-sizes", "units of the maps in a group of 5 differ"),
        test_mutants_multiview.told,
        *("metric", "variance", "proposes-poses", "proposes-intrinsics"),
        options=ref.ToldOptions,
    )


class Clipped(Wrapper):
    def predict(self, view: View, depth: DepthPrior | None = None) -> Any:
        prior = super().predict(view, depth)
        return replace(prior, depth=np.minimum(prior.depth, np.float32(30)))


class MeanVariance(Wrapper):
    def predict(self, view: View, depth: DepthPrior | None = None) -> Any:
        prior = super().predict(view, depth)
        mean = prior.variance[prior.valid].mean() if prior.valid.any() else 1.0
        return replace(prior, variance=np.full_like(prior.variance, mean))


class SizeOfView(Wrapper):
    def predict(self, view: View, depth: DepthPrior | None = None) -> Any:
        prior = super().predict(view, depth)
        return replace(prior, valid=prior.valid & (view.image[..., 0] > 0))


class FilledHoles(Wrapper):
    def predict(self, view: View, depth: DepthPrior | None = None) -> Any:
        prior = super().predict(view, depth)
        filled = np.where(prior.valid, prior.depth, np.float32(5))
        return DepthPrior.from_arrays(filled, (0.05 * filled) ** 2, metric=prior.metric)


class FillsHolesWithoutVariance(Wrapper):
    """Fault: rebuilds the depth prior with small positive depth at invalid pixels."""

    def predict(self, view: View, depth: DepthPrior | None = None) -> Any:
        prior = super().predict(view, depth)
        filled = np.maximum(prior.depth, np.float32(1e-3))
        return DepthPrior.from_arrays(filled, prior.variance, metric=prior.metric)


class CenteredMirror(Wrapper):
    """Fault: mirrors the image, but not the principal point."""

    def predict(self, view: View, depth: DepthPrior | None = None) -> Any:
        image = np.ascontiguousarray(view.image[:, ::-1])
        self.inner.predict(replace(view, image=image, mask=None))
        return super().predict(view, depth)


class DepthNotMirrored(Wrapper):
    def predict(self, view: View, depth: DepthPrior | None = None) -> Any:
        camera = replace(view.camera, cx=view.camera.width - view.camera.cx)
        image = np.ascontiguousarray(view.image[:, ::-1])
        self.inner.predict(View(view.name, image, camera), depth)
        prior = super().predict(view, depth)
        assert isinstance(prior, NormalPrior)
        return prior


@pytest.mark.parametrize(
    ("factory", "check", "message", "wraps"),
    [
        (Clipped, "depth-range", "relative error of distant depth", "depth"),
        (MeanVariance, "wrapper-variance", "belongs to other pixels or is averaged", "depth"),
        (SizeOfView, "wrapper-low-resolution", "broadcast", "depth"),
        (FilledHoles, "wrapper-validity", "invalid pixels .* are valid", "depth"),
        (FillsHolesWithoutVariance, "wrapper-without-variance", "pixels .* are valid", "depth"),
        (CenteredMirror, "wrapper-inputs", "the camera of 'mirrored/", "depth"),
        (DepthNotMirrored, "wrapper-inputs", "the depth of another view", "normals"),
    ],
)
def test_faulty_wrapper_fails_its_check(
    caught: Callable[..., None], factory: type, check: str, message: str, wraps: str
) -> None:
    caught("wrapper", factory, check, message, None, f"wraps-{wraps}")


def test_every_check_has_a_mutant(named: Callable[..., set[str]]) -> None:
    modules = (
        test_mutants_any_kind,
        test_mutants_camera,
        test_mutants_maps,
        test_mutants_matching,
        test_mutants_multiview,
        test_mutants_sizes,
        test_mutants_views,
    )
    tests = [
        test
        for module in modules
        for name, test in vars(module).items()
        if name.startswith("test_") and hasattr(test, "pytestmark")
    ]
    tests += [
        test_faulty_map_provider_fails_its_check,
        test_faulty_features_provider_fails_its_check,
        test_faulty_matcher_fails_its_check,
        test_faulty_wrapper_fails_its_check,
    ]
    caught = named(*tests) | SPECIAL | {"multiview-group-sizes"}
    assert {check_id(check) for check in list_checks()} - caught == set()
