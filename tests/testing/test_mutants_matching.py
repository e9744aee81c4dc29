"""Features, matchers, retrieval and mask providers with one fault each."""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mpsfm_core import (
    DenseMatches,
    Features,
    PairDepth,
    PairMatches,
    ProviderContext,
    SparseMatches,
    View,
)
from mpsfm_core.geometry import pixel_centers
from mpsfm_core.geometry import rays as view_rays
from mpsfm_core.providers.builtin.options import SiftOptions
from mpsfm_core.testing import ContractSetup
from mpsfm_core.testing.examples import Example
from tests.support.reference_providers import (
    PaintedMask,
    Thumbnail,
    ToldMatcher,
    ToldOptions,
    tell,
)
from tests.support.sparse_providers import NearestMatcher, SiftDetector

PAINTED = ContractSetup(truth_source="painted")


class Detector(SiftDetector):
    sift_options = SiftOptions(max_keypoints=400)


class RowsFirst(Detector):
    def extract(self, view: View) -> Features:
        found = super().extract(view)
        inside = np.minimum(found.keypoints[:, ::-1], view.camera.size)
        return replace(found, keypoints=inside)


class IntegerCentres(Detector):
    def extract(self, view: View) -> Features:
        found = super().extract(view)
        return replace(found, keypoints=np.maximum(found.keypoints - 0.5, 0))


class Outside(Detector):
    def extract(self, view: View) -> Features:
        found = super().extract(view)
        return replace(found, keypoints=found.keypoints + view.camera.width / 2)


class SortedAgain(Detector):
    """Fault: sorts keypoints by position without sorting the descriptors."""

    def extract(self, view: View) -> Features:
        found = super().extract(view)
        return replace(found, keypoints=found.keypoints[np.argsort(found.keypoints[:, 0])])


class EmptyIsFlat(Detector):
    def extract(self, view: View) -> Features:
        found = super().extract(view)
        return found if len(found) else replace(found, descriptors=np.empty((0, 1), np.float32))


class NotFinite(Detector):
    def extract(self, view: View) -> Features:
        found = super().extract(view)
        descriptors = found.descriptors.copy()
        broken = replace(found, descriptors=descriptors)
        descriptors[:1] = np.nan
        return broken


@pytest.mark.parametrize(
    ("factory", "check", "message"),
    [
        (RowsFirst, "features-axes", "x and y are swapped"),
        (IntegerCentres, "features-pixel-convention", r"shifted by .-0.4., -0.4.. px"),
        (Outside, "output-rules", "keypoints: points must lie inside of the 192x144 image"),
        (SortedAgain, "features-descriptors", "of the nearest descriptors are the same point"),
        (EmptyIsFlat, "features-dimension", "1 and 128 values"),
        (NotFinite, "output-rules", "descriptors: must be finite"),
    ],
)
def test_faulty_features_provider_fails_its_check(
    caught: Callable[..., None], factory: type, check: str, message: str
) -> None:
    caught("features", factory, check, message)


class Nearest(NearestMatcher):
    def match(self, *arguments: Any) -> PairMatches:
        matches = super().match(*arguments)
        assert matches.sparse is not None
        return PairMatches(self.change(matches.sparse, *arguments))

    def change(self, found: SparseMatches, *arguments: Any) -> SparseMatches:
        raise NotImplementedError


class ColumnsSwapped(Nearest):
    def change(self, found: SparseMatches, a: View, b: View, fa: Features, fb: Features) -> Any:
        inside = (found.indices < min(len(fa), len(fb))).all(axis=1)
        return SparseMatches(found.indices[inside][:, ::-1], found.scores[inside])


class SortsViews(Nearest):
    """Fault: swaps the views by name without swapping the columns of the matches."""

    def match(self, a: View, b: View, fa: Features, fb: Features) -> PairMatches:
        return super().match(*((b, a, fb, fa) if a.name > b.name else (a, b, fa, fb)))

    def change(self, found: SparseMatches, a: View, b: View, fa: Features, fb: Features) -> Any:
        inside = (found.indices < min(len(fa), len(fb))).all(axis=1)
        return SparseMatches(found.indices[inside], found.scores[inside])


class OutOfRange(Nearest):
    def change(self, found: SparseMatches, *arguments: Any) -> SparseMatches:
        return SparseMatches(found.indices + 5000, found.scores)


class Duplicates(Nearest):
    def change(self, found: SparseMatches, *arguments: Any) -> SparseMatches:
        return SparseMatches(found.indices.repeat(2, axis=0), found.scores.repeat(2))


class Percent(Nearest):
    def change(self, found: SparseMatches, *arguments: Any) -> SparseMatches:
        return SparseMatches(found.indices, 100 * found.scores)


class Distances(Nearest):
    """Fault: half of the matches are random, and the score is a distance instead of a
    similarity."""

    def change(self, found: SparseMatches, *arguments: Any) -> SparseMatches:
        half = len(found) // 2
        indices = found.indices.copy()
        indices[:half, 1] = np.roll(indices[:half, 1], 7)
        scores = np.where(np.arange(len(found)) < half, 0.9, 0.1).astype(np.float32)
        keep = np.ones(len(found), bool)
        keep[: half // 4] = False
        return SparseMatches(indices[keep], scores[keep])


class WantsFeatures(NearestMatcher):
    def match(self, a: View, b: View, fa: Any = None, fb: Any = None) -> PairMatches:
        if not (len(fa) and len(fb)):
            raise IndexError("index 0 is out of bounds for axis 0 with size 0")
        return super().match(a, b, fa, fb)


class WantsTwoNeighbours(NearestMatcher):
    def match(self, a: View, b: View, fa: Any = None, fb: Any = None) -> PairMatches:
        if len(fb) == 1:
            raise ValueError("kth(=1) out of bounds (1)")
        return super().match(a, b, fa, fb)


@pytest.mark.parametrize(
    ("factory", "check", "message"),
    [
        (ColumnsSwapped, "matcher-sides", "matches are correct"),
        (SortsViews, "matcher-order", "matches are correct"),
        (OutOfRange, "output-rules", "indices: must be below"),
        (Duplicates, "output-rules", "must use each feature at most once"),
        (Percent, "output-rules", r"scores: values must lie in \[0, 1\]"),
        (Distances, "matcher-scores", "reliable matches score"),
        (WantsFeatures, "matcher-no-features", "out of bounds"),
        (WantsTwoNeighbours, "matcher-few-features", "kth"),
    ],
)
def test_faulty_sparse_matcher_fails_its_check(
    caught: Callable[..., None], factory: type, check: str, message: str
) -> None:
    caught("matcher", factory, check, message, None, "sparse")


class SidesSwapped(ToldMatcher):
    def matches(self, points_a: np.ndarray, points_b: np.ndarray) -> DenseMatches:
        return super().matches(points_b, points_a)


class DenseIntegerCentres(ToldMatcher):
    def matches(self, points_a: np.ndarray, points_b: np.ndarray) -> DenseMatches:
        return super().matches(np.maximum(points_a - 0.5, 0), np.maximum(points_b - 0.5, 0))


class DepthSwapped(ToldMatcher):
    def depths(self, a: Example, b: Example) -> PairDepth:
        return super().depths(b, a)


class DepthOfRays(ToldMatcher):
    def depths(self, a: Example, b: Example) -> PairDepth:
        depth = super().depths(a, b)
        height, width = depth.depth_a.shape
        rays = np.linalg.norm(view_rays(a.camera, pixel_centers(width, height)), axis=-1)
        rays = rays.astype(np.float32)
        return replace(depth, depth_a=replace(depth.depth_a, depth=depth.depth_a.depth * rays))


class PairConfidence(ToldMatcher):
    """Fault: stores the confidence of the network as the variance of depth."""

    def depths(self, a: Example, b: Example) -> PairDepth:
        depth = super().depths(a, b)
        confidence = 1 + np.exp(-depth.depth_a.depth / 4)
        return replace(depth, depth_a=replace(depth.depth_a, variance=confidence))


@pytest.mark.parametrize(
    ("factory", "check", "message"),
    [
        (SidesSwapped, "matcher-sides", "the two sides are exchanged"),
        (DenseIntegerCentres, "matcher-pixel-convention", r"shifted by \(\+0.50, \+0.50\) px"),
        (DepthSwapped, "matcher-pair-depth", "depth_a and depth_b are swapped"),
        (PairConfidence, "matcher-pair-depth", "times the std that the test network reports"),
        (DepthOfRays, "matcher-pair-depth", r"depth is proportional to z \* \(ray length / z\)"),
    ],
)
def test_faulty_dense_matcher_fails_its_check(
    caught: Callable[..., None], factory: type, check: str, message: str
) -> None:
    def told(folder: Path) -> ContractSetup:
        return ContractSetup({"folder": folder}, "prepared", lambda example: tell(folder, example))

    caught("matcher", factory, check, message, told, "dense", "pair-depth", options=ToldOptions)


class Infinite(Thumbnail):
    def describe(self, view: View) -> np.ndarray:
        return super().describe(view) / np.float32(0)


class Rows(Thumbnail):
    """Fault: the descriptor is a profile whose length is the height of the view."""

    def describe(self, view: View) -> np.ndarray:
        profile = view.image.mean(axis=(1, 2)).astype(np.float32)
        return profile / np.linalg.norm(profile)


class Collapsed(Thumbnail):
    """Fault: the bias of the last layer dominates all descriptors."""

    def describe(self, view: View) -> np.ndarray:
        vector = 1 + np.float32(1e-6) * super().describe(view)
        return vector / np.linalg.norm(vector)


class NotNormalised(Thumbnail):
    def describe(self, view: View) -> np.ndarray:
        return view.image[:8, :8].astype(np.float32).ravel()


class Hash(Thumbnail):
    """Fault: the similarity only detects identical views, not overlap."""

    def describe(self, view: View) -> np.ndarray:
        digest = hashlib.sha512(view.image.tobytes() + b"5").digest()
        values = np.frombuffer(digest, np.uint8).astype(np.float32) - 127.5
        return values / np.linalg.norm(values)


@pytest.mark.parametrize(
    ("factory", "check", "message"),
    [
        (Infinite, "output-rules", "descriptor: must be finite"),
        (Rows, "retrieval-dimension", "descriptors have .* and .* values"),
        (NotNormalised, "retrieval-self-similarity", "lengths of descriptors are"),
        (Hash, "retrieval-overlap", "to a neighboring view"),
        (Collapsed, "retrieval-overlap", "1 to a neighboring view, but 1 to another"),
    ],
)
@pytest.mark.filterwarnings("ignore:divide by zero", "ignore:invalid value")
def test_faulty_retrieval_provider_fails_its_check(
    caught: Callable[..., None], factory: type, check: str, message: str
) -> None:
    caught("retrieval", factory, check, message)


class Inverted(PaintedMask):
    def mask(self, view: View) -> np.ndarray:
        return ~super().mask(view)


class Reduced(PaintedMask):
    def mask(self, view: View) -> np.ndarray:
        return super().mask(view)[::2, ::2] if min(view.camera.size) > 2 else super().mask(view)


class Grey(PaintedMask):
    def mask(self, view: View) -> np.ndarray:
        return 255 * super().mask(view).astype(np.uint8)


class Displaced(PaintedMask):
    def mask(self, view: View) -> np.ndarray:
        return np.roll(super().mask(view), view.camera.height // 2, axis=0)


class Backwards(PaintedMask):
    def mask(self, view: View) -> np.ndarray:
        return super().mask(replace(view, image=view.image[..., ::-1]))


class LeftHalf(PaintedMask):
    def mask(self, view: View) -> np.ndarray:
        mask = super().mask(view)
        mask[:, : mask.shape[1] // 2] = True
        return mask


@pytest.mark.parametrize(
    ("factory", "check", "message"),
    [
        (Inverted, "mask-polarity", "is inverted"),
        (Reduced, "output-rules", "must have the image's shape"),
        (Grey, "output-rules", "2-dimensional bool"),
        (Displaced, "mask-place", "of the pixels have the wrong value"),
        (Backwards, "mask-channel-order", "follows the blue channel"),
        (LeftHalf, "mask-flip", "the mask of the mirrored view differs"),
    ],
)
def test_faulty_mask_provider_fails_its_check(
    caught: Callable[..., None], factory: type, check: str, message: str
) -> None:
    caught("mask", factory, check, message, PAINTED)


class NotScaledBack(SiftDetector):
    """Fault: reduces views above 640 pixels and returns keypoints of the reduced image."""

    sift_options = SiftOptions(resize=640)

    def extract(self, view: View) -> Features:
        features = super().extract(view)
        factor = min(1.0, 640 / max(view.camera.size))
        return replace(features, keypoints=factor * features.keypoints)


class ScaledFromPixelCenters(SiftDetector):
    """Fault: scales keypoints of a reduced image back as if pixel centers were integers."""

    sift_options = SiftOptions(resize=1024)

    def extract(self, view: View) -> Features:
        features = super().extract(view)
        shift = 0.5 * (1 - max(1.0, max(view.camera.size) / 1024))
        return replace(features, keypoints=np.maximum(features.keypoints + shift, 0))


class DisablesLogging(Detector):
    def __init__(self, options: Any, context: ProviderContext) -> None:
        super().__init__(options, context)
        logging.disable(logging.WARNING)


@pytest.fixture
def enable_logging() -> Iterator[None]:
    yield
    logging.disable(logging.NOTSET)


@pytest.mark.usefixtures("enable_logging")
@pytest.mark.parametrize(
    ("factory", "check", "message"),
    [
        (NotScaledBack, "features-large-view", "of a reduced image back"),
        (ScaledFromPixelCenters, "features-large-view", r"shifted by \(-1.5, -1.5\) px"),
        (DisablesLogging, "global-state", "the disabled levels of logging"),
    ],
)
def test_features_of_large_views(
    caught: Callable[..., None], factory: type, check: str, message: str
) -> None:
    caught("features", factory, check, message)


class LimitedMatcher(NearestMatcher):
    def match(self, a: View, b: View, fa: Any = None, fb: Any = None) -> PairMatches:
        if max(len(fa), len(fb)) > 2048:
            raise ValueError("index 2048 is out of bounds")
        return super().match(a, b, fa, fb)


class UnlocksDescriptors(NearestMatcher):
    """Fault: makes the descriptors of the given features writable, and normalizes them in place."""

    def match(self, a: View, b: View, fa: Any = None, fb: Any = None) -> PairMatches:
        for descriptors in (fa.descriptors, fb.descriptors):
            descriptors.setflags(write=True)
            descriptors /= 2
        return super().match(a, b, fa, fb)


class IndexesBestFeatures(NearestMatcher):
    """Fault: returns indices into the 1024 features with the best scores."""

    def match(self, a: View, b: View, fa: Any = None, fb: Any = None) -> PairMatches:
        return super().match(a, b, _select_best(fa), _select_best(fb))


def _select_best(features: Features) -> Features:
    if len(features) <= 1024 or features.scores is None:
        return features
    rows = np.argsort(-features.scores)[:1024]
    return Features(features.keypoints[rows], features.descriptors[rows])


class ReversesScores(NearestMatcher):
    """Fault: reverses the scores if the names of the views are not in alphabetical order."""

    def match(self, a: View, b: View, fa: Any = None, fb: Any = None) -> PairMatches:
        found = super().match(a, b, fa, fb)
        assert found.sparse is not None
        scores = found.sparse.scores[::-1] if a.name > b.name else found.sparse.scores
        return PairMatches(sparse=SparseMatches(found.sparse.indices, scores.copy()))


class DropsRightSide(NearestMatcher):
    """Fault: normalizes x by the height, and drops matches outside of the unit square."""

    def match(self, a: View, b: View, fa: Any = None, fb: Any = None) -> PairMatches:
        found = super().match(a, b, fa, fb)
        assert found.sparse is not None
        inside = fa.keypoints[found.sparse.indices[:, 0], 0] < a.camera.height
        return PairMatches(
            sparse=SparseMatches(found.sparse.indices[inside], found.sparse.scores[inside])
        )


@pytest.mark.parametrize(
    ("factory", "check", "message"),
    [
        (IndexesBestFeatures, "matcher-many-features", "matches of many features are correct"),
        (ReversesScores, "name-does-not-matter", "of a renamed view differs"),
        (DropsRightSide, "matcher-coverage", "in the outer quarter of one side"),
        (LimitedMatcher, "matcher-many-features", "out of bounds"),
        (UnlocksDescriptors, "inputs-unchanged", "descriptors differs"),
    ],
)
def test_matchers_of_given_features(
    caught: Callable[..., None], factory: type, check: str, message: str
) -> None:
    caught("matcher", factory, check, message, None, "sparse")
