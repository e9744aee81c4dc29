"""Providers whose faults depend on the size, order, unit or neighborhood of their input."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest

from mpsfm_core import (
    DenseMatches,
    DepthPrior,
    Features,
    NormalPrior,
    PairMatches,
    ProviderContext,
    SparseMatches,
    View,
)
from mpsfm_core.providers.builtin.options import SiftOptions
from mpsfm_core.testing import ContractSetup
from mpsfm_core.testing.painted_views import read_depth, read_normals
from tests.support.reference_providers import (
    PaintedDepth,
    PaintedMask,
    Thumbnail,
    Wrapper,
    depth_prior,
    normal_prior,
)
from tests.support.sparse_providers import CellMatcher, DenseSift, NearestMatcher, SiftDetector

PAINTED = ContractSetup(truth_source="painted")


class Millimeters16(PaintedDepth):
    """Fault: stores depth in millimeters with 16 bits, which overflow at 65.5 m."""

    def predict(self, view: View) -> DepthPrior:
        depth = (1000 * read_depth(view.image)).astype(np.int64).astype(np.uint16)
        return depth_prior(depth / 1000)


class BorderOfTiles(PaintedDepth):
    """Fault: adds up the depth of two tiles in the columns where the tiles overlap."""

    def predict(self, view: View) -> DepthPrior:
        depth = read_depth(view.image)
        middle = depth.shape[1] // 2
        depth[:, middle - 4 : middle + 4] *= 2
        return depth_prior(depth)


class RotatesAgain(PaintedDepth):
    """Fault: rotates the map by the EXIF orientation, although the view is upright."""

    def predict(self, view: View) -> DepthPrior:
        turned = np.rot90(read_depth(view.image), 1 if view.orientation == 6 else 0)
        return depth_prior(np.ascontiguousarray(turned))


class CachedByCorners(PaintedDepth):
    """Fault: compares size and two pixels of a view to find it in a cache."""

    def __init__(self, options: Any, context: ProviderContext) -> None:
        super().__init__(options, context)
        self.known: dict[Any, DepthPrior] = {}

    def predict(self, view: View) -> DepthPrior:
        key = view.image.shape, view.image[0, 0].tobytes(), view.image[-1, -1].tobytes()
        if key not in self.known:
            self.known[key] = super().predict(view)
        return self.known[key]


class SkyIsMinority(PaintedMask):
    """Fault: inverts a mask that excludes more than half of the view."""

    def mask(self, view: View) -> Any:
        mask = super().mask(view)
        return mask if mask.mean() > 0.5 else ~mask


class Faint(Thumbnail):
    """Fault: the length of descriptors grows with the contrast."""

    def describe(self, view: View) -> Any:
        return super().describe(view) * np.float32(1 + view.image.std())


class MeanWithZeros(Wrapper):
    """Fault: averages depth of view and mirrored view where one of both is valid."""

    def predict(self, view: View, depth: DepthPrior | None = None) -> Any:
        camera = replace(view.camera, cx=view.camera.width - view.camera.cx)
        image = np.ascontiguousarray(view.image[:, ::-1])
        first, second = self.inner.predict(view), self.inner.predict(View("m", image, camera))
        mean = (first.depth + second.depth[:, ::-1]) / 2
        valid = first.valid | second.valid[:, ::-1]
        return DepthPrior.from_arrays(mean, (0.1 * mean) ** 2, valid, metric=first.metric)


class NormalsOfMeters:
    """Fault: uses input depth without regard to its unit and to the size of its map."""

    def __init__(self, options: Any, context: ProviderContext) -> None:
        self.options = options

    def predict(self, view: View, depth: DepthPrior | None = None) -> NormalPrior:
        assert depth is not None
        normals = read_normals(view.image)
        if np.median(depth.depth) > 15:
            normals[..., :2] = 0
        return normal_prior(normals, view)


class BlursOverHoles(Wrapper):
    """Fault: smooths depth together with the zeros of invalid pixels."""

    def predict(self, view: View, depth: DepthPrior | None = None) -> Any:
        prior = self.inner.predict(view)
        blurred = np.maximum(cv2.blur(prior.depth, (3, 3)), 1e-3)
        return replace(prior, depth=np.where(prior.valid, blurred, 0).astype(np.float32))


class NeedsItsName(Wrapper):
    """Fault: works only if the wrapped provider has the attribute of a certain class."""

    def predict(self, view: View, depth: DepthPrior | None = None) -> Any:
        prior = self.inner.predict(view)
        if type(self.inner) is type(self):
            return replace(prior, depth=1.2 * prior.depth)
        return prior


@pytest.mark.parametrize(
    ("kind", "factory", "check", "message", "setup", "capabilities"),
    [
        ("depth", Millimeters16, "depth-range", "9 times as far", PAINTED, ("metric",)),
        ("depth", BorderOfTiles, "depth-edges", "no surface near has", PAINTED, ("metric",)),
        ("depth", RotatesAgain, "name-does-not-matter", "renamed view", PAINTED, ("metric",)),
        ("depth", CachedByCorners, "no-state", "differs|some equal pixels", PAINTED, ("metric",)),
        ("mask", SkyIsMinority, "mask-place", "wrong value", PAINTED, ()),
        ("retrieval", Faint, "retrieval-self-similarity", "lengths of descriptors", None, ()),
        ("wrapper", MeanWithZeros, "wrapper-validity", "no surface near", None, ("wraps-depth",)),
        (
            "normals",
            NormalsOfMeters,
            "normals-depth-input",
            "off for depth of ten times the size",
            PAINTED,
            ("needs-depth",),
        ),
        ("wrapper", BlursOverHoles, "depth-edges", "no surface near", None, ("wraps-depth",)),
        ("wrapper", NeedsItsName, "wrapper-stacked", "relative error", None, ("wraps-depth",)),
    ],
)
def test_faulty_map_provider_fails_its_check(
    caught: Callable[..., None],
    kind: str,
    factory: type,
    check: str,
    message: str,
    setup: ContractSetup | None,
    capabilities: tuple[str, ...],
) -> None:
    caught(kind, factory, check, message, setup, *capabilities)


class Reduced(SiftDetector):
    """Detector that reduces the longer side of a view to 320 pixels."""

    sift_options = SiftOptions(max_keypoints=2000)

    def extract(self, view: View) -> Features:
        scale = 320 / max(view.camera.size)
        if scale >= 1:
            return super().extract(view)
        size = tuple(max(1, round(scale * side)) for side in view.camera.size)
        image = cv2.resize(view.image, size, interpolation=cv2.INTER_AREA)
        found = super().extract(View(view.name, image, view.camera.resized(*size)))
        xy = self.enlarge(found.keypoints, np.array(view.camera.size) / size)
        return Features(np.clip(xy, 0, view.camera.size), found.descriptors)

    def enlarge(self, xy: Any, factor: Any) -> Any:
        raise NotImplementedError


class IntegerCenters(Reduced):
    """Fault: multiplies keypoints whose first pixel has the center (0, 0)."""

    def enlarge(self, xy: Any, factor: Any) -> Any:
        return (xy - 0.5) * factor + 0.5


class KeepsTheWeakest(SiftDetector):
    """Fault: a limit keeps the keypoints with the lowest contrast."""

    sift_options = SiftOptions(max_keypoints=3000)

    def extract(self, view: View) -> Features:
        found = super().extract(view)
        gray = view.image.mean(axis=2)
        columns, rows = (found.keypoints.astype(int).T + 0).clip(0)
        near = [
            gray[np.maximum(y - 4, 0) : y + 5, np.maximum(x - 4, 0) : x + 5]
            for x, y in zip(columns, rows, strict=True)
        ]
        keep = np.argsort([part.std() for part in near], kind="stable")[:300]
        return Features(found.keypoints[keep], found.descriptors[keep])


class SortsManyDescriptors(SiftDetector):
    """Fault: sorts keypoints but no descriptors if there are more than 1500 keypoints."""

    sift_options = SiftOptions(max_keypoints=3000)

    def extract(self, view: View) -> Features:
        found = super().extract(view)
        if len(found) <= 1500:
            return found
        order = np.argsort(found.keypoints[:, 1], kind="stable")
        return Features(found.keypoints[order], found.descriptors)


@pytest.mark.parametrize(
    ("factory", "check", "message"),
    [
        (IntegerCenters, "features-other-sizes", r"768 x 576 view are shifted by \(-0.70, -0.70"),
        (KeepsTheWeakest, "features-scores", "a limit has to keep the best keypoints"),
        (SortsManyDescriptors, "features-other-sizes", "descriptors of a 768 x 576 view"),
    ],
)
def test_faulty_features_provider_fails_its_check(
    caught: Callable[..., None], factory: type, check: str, message: str
) -> None:
    caught("features", factory, check, message)


class DummyMatch(NearestMatcher):
    """Fault: clips the index of a missing match to the last feature, with a score of 1."""

    def match(self, a: View, b: View, fa: Any = None, fb: Any = None) -> PairMatches:
        found = super().match(a, b, fa, fb).sparse
        assert found is not None
        free = np.setdiff1d(np.arange(len(fa)), found.indices[:, 0])
        if not len(free) or len(fb) - 1 in found.indices[:, 1]:
            return PairMatches(found)
        indices = np.concatenate([found.indices, [[free[0], len(fb) - 1]]])
        return PairMatches(SparseMatches(indices, np.append(found.scores, np.float32(1))))


class SortedScores(NearestMatcher):
    """Fault: sorts the scores without the matches."""

    def match(self, a: View, b: View, fa: Any = None, fb: Any = None) -> PairMatches:
        found = super().match(a, b, fa, fb).sparse
        assert found is not None
        return PairMatches(SparseMatches(found.indices, np.sort(found.scores)[::-1].copy()))


class Coordinates8(NearestMatcher):
    """Fault: drops matches whose coordinates exceed 1024 pixels."""

    def match(self, a: View, b: View, fa: Any = None, fb: Any = None) -> PairMatches:
        found = super().match(a, b, fa, fb).sparse
        assert found is not None
        inside = fa.keypoints[found.indices[:, 0]].max(axis=1) < 1024
        return PairMatches(SparseMatches(found.indices[inside], found.scores[inside]))


class FullBuffer(DenseSift):
    """Fault: returns only the first matches of more than fit into a buffer, from top to bottom."""

    def match(self, a: View, b: View, fa: Any = None, fb: Any = None) -> PairMatches:
        dense = super().match(a, b, fa, fb).dense
        assert dense is not None
        first = np.argsort(dense.points_a[:, 1], kind="stable")[:500]
        points = dense.points_a[first], dense.points_b[first]
        return PairMatches(dense=DenseMatches(*points, dense.scores[first], dense.std_px))


class LeftOfLarge(DenseSift):
    """Fault: returns no matches right of column 640."""

    def match(self, a: View, b: View, fa: Any = None, fb: Any = None) -> PairMatches:
        dense = super().match(a, b, fa, fb).dense
        assert dense is not None
        left = dense.points_a[:, 0] < 640
        points = dense.points_a[left], dense.points_b[left]
        return PairMatches(dense=DenseMatches(*points, dense.scores[left], dense.std_px))


class TinyStd(CellMatcher):
    """Fault: rounds matches to cells of 4 pixels, but declares a std_px of 0.1 pixels."""

    std_px = 0.1


@pytest.mark.parametrize(
    ("factory", "check", "message", "capability"),
    [
        (DummyMatch, "matcher-feature-order", "wrong and have high scores", "sparse"),
        (SortedScores, "matcher-feature-order", "scores of the same matches", "sparse"),
        (Coordinates8, "matcher-large-view", "4032 x 3024", "sparse"),
        (FullBuffer, "matcher-large-view", "in the outer quarter of one side", "dense"),
        (LeftOfLarge, "matcher-large-view", "in the outer quarter of one side", "dense"),
        (TinyStd, "matcher-std", "times the declared std_px", "dense"),
    ],
)
def test_faulty_matcher_fails_its_check(
    caught: Callable[..., None], factory: type, check: str, message: str, capability: str
) -> None:
    caught("matcher", factory, check, message, None, capability)
