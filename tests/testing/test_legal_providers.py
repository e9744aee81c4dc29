"""Tests that legal but unusual providers pass all contract checks of their kind."""

from __future__ import annotations

import threading
import time
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import cv2
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
    ProviderSpec,
    SparseMatches,
    View,
)
from mpsfm_core.data import PinholeCamera
from mpsfm_core.geometry import resize_map
from mpsfm_core.providers import Capability, Kind
from mpsfm_core.providers.builtin.mutual_nearest import mutual_nearest
from mpsfm_core.providers.builtin.options import SiftOptions
from mpsfm_core.providers.builtin.plugin import mpsfm_providers as builtin_providers
from mpsfm_core.providers.registry import Registry
from mpsfm_core.testing import ContractSetup, run_checks
from mpsfm_core.testing.contract import schedule_checks
from mpsfm_core.testing.painted_views import read_depth, read_normals
from tests.support.reference_providers import (
    PaintedDepth,
    PaintedMask,
    Thumbnail,
    Wrapper,
    depth_prior,
)
from tests.support.sparse_providers import CellMatcher, DenseSift, SiftDetector

SLOW_CHECKS = {"second-process", "memory-released", "offline", "speed"}
"""Checks of the process, which are omitted because other tests cover them."""


class RelativeDepth(PaintedDepth):
    """Depth with its own unit per map and without variance."""

    def predict(self, view: View) -> DepthPrior:
        depth = read_depth(view.image)
        median = np.median(depth[depth > 0]) if (depth > 0).any() else 1.0
        return DepthPrior.from_arrays(depth / median, metric=False)


class DepthWithoutVariance(PaintedDepth):
    def predict(self, view: View) -> DepthPrior:
        return DepthPrior.from_arrays(read_depth(view.image))


class NearestDepth(PaintedDepth):
    """Depth map of another size, which :meth:`size` returns, from the nearest pixels."""

    def predict(self, view: View) -> DepthPrior:
        return depth_prior(resize_map(read_depth(view.image), *self.size(view), linear=False))

    def size(self, view: View) -> tuple[int, int]:
        raise NotImplementedError


class CoarseDepth(NearestDepth):
    def size(self, view: View) -> tuple[int, int]:
        return max(4, view.camera.width // 6), max(4, view.camera.height // 6)


class SquareDepth(NearestDepth):
    def size(self, view: View) -> tuple[int, int]:
        return 128, 128


class FineDepth(NearestDepth):
    def size(self, view: View) -> tuple[int, int]:
        return 2 * view.camera.width, 2 * view.camera.height


class EnlargedDepth(NearestDepth):
    """Provider that passes all checks, with nearest-neighbor upsampling of its map by 1.5."""

    def size(self, view: View) -> tuple[int, int]:
        return 3 * view.camera.width // 2 + 1, 3 * view.camera.height // 2 + 1


class CautiousDepth(PaintedDepth):
    """Depth that is invalid beyond 6 m and near edges."""

    def predict(self, view: View) -> DepthPrior:
        prior = super().predict(view)
        step = cv2.morphologyEx(prior.depth, cv2.MORPH_GRADIENT, np.ones((3, 3)))
        near_edge = cv2.dilate((step > 0.5).astype(np.uint8), np.ones((3, 3))) > 0
        return replace(prior, valid=prior.valid & (prior.depth < 6) & ~near_edge)


class CachedDepth(PaintedDepth):
    """Depth from a cache whose key contains all inputs of the network."""

    def __init__(self, options: Any, context: ProviderContext) -> None:
        super().__init__(options, context)
        self.lock = threading.Lock()
        self.known: dict[Any, DepthPrior] = {}

    def predict(self, view: View) -> DepthPrior:
        key = view.image.shape, view.image.tobytes()
        with self.lock:
            if key not in self.known:
                self.known[key] = super().predict(view)
            return self.known[key]


class CanonicalDepth(PaintedDepth):
    """Depth of a network with a canonical camera, which grows with the focal length."""

    def predict(self, view: View) -> DepthPrior:
        focal = (view.camera.fx + view.camera.fy) / 2
        return depth_prior(read_depth(view.image) * focal / (0.75 * max(view.camera.size)))


class UnsureFocal(PaintedDepth):
    def estimate_focal(self, view: View) -> Any:
        return None


class SlowConstructor(PaintedDepth):
    """Depth of a network whose construction takes long, as of a network that is compiled."""

    def __init__(self, options: Any, context: ProviderContext) -> None:
        super().__init__(options, context)
        time.sleep(0.1)


class CoarseNormals:
    """Normals of half the size without variance."""

    def __init__(self, options: Any, context: ProviderContext) -> None:
        self.options = options

    def predict(self, view: View, depth: DepthPrior | None = None) -> NormalPrior:
        width, height = (max(1, side // 2) for side in view.camera.size)
        normals = resize_map(read_normals(view.image), width, height)
        return NormalPrior.from_arrays(normals, camera=view.camera)


class Detector(SiftDetector):
    sift_options = SiftOptions(max_keypoints=2000)


class UprightPatches:
    """Corners of one scale with normalized patches, and few or none in a smooth image."""

    def __init__(self, options: Any, context: ProviderContext) -> None:
        self.options = options

    def extract(self, view: View) -> Features:
        gray = cv2.GaussianBlur(cv2.cvtColor(view.image, cv2.COLOR_RGB2GRAY), (0, 0), 1.0)
        corners = cv2.goodFeaturesToTrack(gray, 1500, 0.005, 3)
        xy = np.zeros((0, 2)) if corners is None else corners.reshape(-1, 2).astype(np.float64)
        xy = xy[((xy >= 8) & (xy < np.array(view.camera.size) - 8)).all(axis=1)]
        dx, dy = (offset.ravel() for offset in np.meshgrid(*2 * [np.arange(-7, 8, 2)]))
        columns, rows = np.rint(xy).astype(int).reshape(-1, 2).T
        smooth = cv2.GaussianBlur(gray, (0, 0), 1.5).astype(np.float32)
        patches = smooth[rows[:, None] + dy, columns[:, None] + dx]
        patches -= patches.mean(axis=1, keepdims=True)
        patches /= np.maximum(np.linalg.norm(patches, axis=1, keepdims=True), np.float32(1e-6))
        return Features(xy + 0.5, patches)


class FewFeatures(Detector):
    def extract(self, view: View) -> Features:
        found = super().extract(view)
        assert found.scales is not None
        keep = np.argsort(-found.scales, kind="stable")[:150]
        arrays = found.keypoints[keep], found.descriptors[keep], None, found.scales[keep]
        return Features(*arrays, std_px=found.std_px)


class LongDescriptors(Detector):
    """Descriptors with 256 values and a norm of 141."""

    def extract(self, view: View) -> Features:
        found = super().extract(view)
        twice = np.concatenate([found.descriptors, found.descriptors], axis=1)
        return replace(found, descriptors=np.float32(100) * twice)


class ReducedImage(Detector):
    """Features of a reduced image, scaled back to pixels of the view."""

    def extract(self, view: View) -> Features:
        width, height = (max(1, round(0.8 * side)) for side in view.camera.size)
        image = cv2.resize(view.image, (width, height), interpolation=cv2.INTER_AREA)
        small = View(view.name, image, view.camera.resized(width, height))
        found, factor = super().extract(small), np.array(view.camera.size) / (width, height)
        assert found.scales is not None
        scales = found.scales * np.float32(factor.mean())
        points = np.clip(found.keypoints * factor, 0, view.camera.size)
        return Features(points, found.descriptors, None, scales, 1.25 * found.std_px)


class OneWayMatcher:
    """Nearest neighbors of the first view's features, which differ from those of the second's."""

    def __init__(self, options: Any, context: ProviderContext) -> None:
        self.options = options

    def match(self, a: View, b: View, fa: Any = None, fb: Any = None) -> PairMatches:
        if not (len(fa) and len(fb)):
            return PairMatches(SparseMatches(np.empty((0, 2), np.int64), np.empty(0, np.float32)))
        similarity = fa.descriptors @ fb.descriptors.T
        nearest = similarity.argmax(axis=1)
        best = similarity[np.arange(len(fa)), nearest]
        keep = np.flatnonzero(best > 0.9)
        indices = np.stack([keep, nearest[keep]], axis=1)
        return PairMatches(SparseMatches.from_best_scores(indices, best[keep]))


class BestMatches(DenseSift):
    """Dense matcher that returns its 100 best matches, which leave out a side of a large view."""

    def match(self, a: View, b: View, fa: Any = None, fb: Any = None) -> PairMatches:
        dense = super().match(a, b, fa, fb).dense
        assert dense is not None
        best = np.argsort(-dense.scores, kind="stable")[:100]
        points = dense.points_a[best], dense.points_b[best]
        return PairMatches(dense=DenseMatches(*points, dense.scores[best], dense.std_px))


class ScaleVariantMatcher(UprightPatches):
    """Dense matcher that finds matches between views of about the same scale only."""

    def match(self, a: View, b: View, fa: Any = None, fb: Any = None) -> PairMatches:
        first, second = self.extract(a), self.extract(b)
        indices, _, ratio = mutual_nearest(first.descriptors, second.descriptors)
        indices, ratio = indices[ratio < 0.85], ratio[ratio < 0.85]
        points = first.keypoints[indices[:, 0]], second.keypoints[indices[:, 1]]
        return PairMatches(dense=DenseMatches(*points, (1 - ratio).astype(np.float32)))


class RelativeGroup:
    """Multi-view depth in a unit that differs between groups, without poses."""

    def __init__(self, options: Any, context: ProviderContext) -> None:
        self.options = options

    def predict_group(self, views: Sequence[View]) -> MultiViewPrior:
        maps = [read_depth(view.image) for view in views]
        values = np.concatenate([depth[depth > 0] for depth in maps])
        unit = np.median(values) if len(values) else 1.0
        priors = [depth_prior(depth / unit) for depth in maps]
        return MultiViewPrior(tuple(replace(prior, metric=False) for prior in priors))


class ShortDescriptor(Thumbnail):
    """Color histogram with 27 values."""

    def describe(self, view: View) -> Any:
        bins = np.minimum(view.image.reshape(-1, 3) // 86, 2) @ np.array([9, 3, 1])
        counts = np.sqrt(np.bincount(bins, minlength=27).astype(np.float32))
        return counts / np.linalg.norm(counts)


class CautiousMask(PaintedMask):
    """Mask that also excludes two pixels around the sky."""

    def mask(self, view: View) -> Any:
        whole = super().mask(view).astype(np.uint8)
        return cv2.erode(whole, np.ones((5, 5), np.uint8), borderValue=1) > 0


class RotatesPortrait(Wrapper):
    """Correct wrapper that rotates portrait views to landscape format and the map back."""

    def predict(self, view: View, depth: DepthPrior | None = None) -> Any:
        camera = view.camera
        if camera.height <= camera.width:
            return super().predict(view, depth)
        size, focal = (camera.height, camera.width), (camera.fy, camera.fx)
        turned = PinholeCamera(*size, *focal, camera.cy, camera.width - camera.cx)
        prior = super().predict(View(view.name, np.ascontiguousarray(np.rot90(view.image)), turned))
        maps = ((None if m is None else np.rot90(m, -1)) for m in (prior.depth, prior.variance))
        return DepthPrior.from_arrays(*maps, np.rot90(prior.valid, -1), metric=prior.metric)


DEPTH: tuple[Capability, ...] = ("metric", "variance")


@pytest.mark.parametrize(
    ("kind", "factory", "capabilities"),
    [
        ("depth", RelativeDepth, ()),
        ("depth", DepthWithoutVariance, ("metric",)),
        ("depth", CoarseDepth, DEPTH),
        ("depth", SquareDepth, DEPTH),
        ("depth", FineDepth, DEPTH),
        ("depth", EnlargedDepth, DEPTH),
        ("depth", CautiousDepth, DEPTH),
        ("depth", CachedDepth, DEPTH),
        ("depth", CanonicalDepth, (*DEPTH, "intrinsics-aware")),
        ("depth", UnsureFocal, (*DEPTH, "estimates-focal")),
        ("depth", SlowConstructor, DEPTH),
        ("normals", CoarseNormals, ()),
        ("features", UprightPatches, ()),
        ("features", FewFeatures, ()),
        ("features", LongDescriptors, ()),
        ("features", ReducedImage, ()),
        ("matcher", OneWayMatcher, ("sparse",)),
        ("matcher", ScaleVariantMatcher, ("dense",)),
        ("matcher", CellMatcher, ("dense",)),
        ("matcher", BestMatches, ("dense",)),
        ("multiview", RelativeGroup, ("variance",)),
        ("retrieval", ShortDescriptor, ()),
        ("mask", CautiousMask, ()),
        ("wrapper", RotatesPortrait, ("wraps-depth",)),
    ],
)
def test_legal_provider_passes_all_checks(
    kind: Kind, factory: type, capabilities: tuple[Capability, ...]
) -> None:
    registry = Registry()
    spec = ProviderSpec(kind, "legal", factory, capabilities=frozenset(capabilities))
    registry.add(*builtin_providers(), spec)
    sees_image = kind in ("features", "matcher", "retrieval")
    setup = ContractSetup(truth_source="image" if sees_image else "painted")
    only = {task.id for task in schedule_checks(spec)} - SLOW_CHECKS
    results = run_checks(registry, kind, "legal", setup, only=only)
    assert {r.id: r.message for r in results if r.status == "fail"} == {}
    assert sum(r.status == "pass" for r in results) > len(results) / 2


def test_threads_that_a_library_starts_once_are_no_leak() -> None:
    stop = threading.Event()

    class StartsPool(PaintedDepth):
        """Depth provider whose calls take 0.15 s; one call starts three threads."""

        def predict(self, view: View) -> DepthPrior:
            if view.name == "memory/1.png":
                for _ in range(3):
                    threading.Thread(target=stop.wait, daemon=True).start()
            started = time.process_time()
            while time.process_time() - started < 0.15:
                pass
            return super().predict(view)

    registry = Registry()
    registry.add(*builtin_providers(), ProviderSpec("depth", "legal", StartsPool))
    setup = ContractSetup(truth_source="painted")
    before = threading.active_count()
    try:
        (result,) = run_checks(registry, "depth", "legal", setup, only={"memory-released"})
        assert threading.active_count() == before + 3
    finally:
        stop.set()
    assert result.status == "pass", result.message
