"""Providers whose faults need certain views: wide, tall, rotated, masked, or of mixed sizes."""

from __future__ import annotations

import logging
import os
import tempfile
import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
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
    Options,
    PairMatches,
    ProviderContext,
    ProviderSpec,
    SparseMatches,
    View,
)
from mpsfm_core.data import Float64, PairDepth, PinholeCamera
from mpsfm_core.providers import WeightsFile
from mpsfm_core.providers.registry import Registry
from mpsfm_core.testing import ContractSetup, run_checks
from mpsfm_core.testing.painted_views import read_depth, read_normals
from tests.support import reference_providers as ref
from tests.support.reference_providers import (
    PaintedDepth,
    PaintedMask,
    PaintedNormals,
    Thumbnail,
    ToldGroup,
    ToldMatcher,
    Wrapper,
    depth_prior,
    normal_prior,
)
from tests.support.sparse_providers import DenseSift, NearestMatcher, SiftDetector
from tests.testing.test_mutants_multiview import EVERYTHING, told

PAINTED = ContractSetup(truth_source="painted")


class RotatesAgain(PaintedDepth):
    """Fault: rotates the map of photos that were upside down, although the view is upright."""

    def predict(self, view: View) -> DepthPrior:
        depth = read_depth(view.image)
        return depth_prior(
            np.ascontiguousarray(depth[::-1, ::-1] if view.orientation == 3 else depth)
        )


class AlignedCorners(PaintedDepth):
    """Fault: reduces photos above 1024 pixels and enlarges their map with aligned corners."""

    def predict(self, view: View) -> DepthPrior:
        depth = read_depth(view.image)
        height, width = depth.shape
        if max(height, width) <= 1024:
            return depth_prior(depth)
        factor = 518 / max(height, width)
        size = max(2, round(factor * width)), max(2, round(factor * height))
        small = cv2.resize(depth, size, interpolation=cv2.INTER_AREA)
        x, y = (np.linspace(0, s - 1, n) for s, n in zip(size, (width, height), strict=True))
        grid = np.meshgrid(x.astype(np.float32), y.astype(np.float32))
        return depth_prior(cv2.remap(small, *grid, cv2.INTER_LINEAR))


class CropsPanoramas(PaintedDepth):
    """Fault: crops views with an aspect ratio above 2."""

    def predict(self, view: View) -> DepthPrior:
        depth = read_depth(view.image)
        height, width = depth.shape
        return depth_prior(depth[: 2 * width, : 2 * height])


class CachedBySample(PaintedDepth):
    """Fault: the key of a cache contains one of 16 rows and columns."""

    def __init__(self, options: Any, context: ProviderContext) -> None:
        super().__init__(options, context)
        self.known: dict[Any, DepthPrior] = {}

    def predict(self, view: View) -> DepthPrior:
        key = view.image.shape, view.image[::16, ::16].tobytes()
        if key not in self.known:
            self.known[key] = super().predict(view)
        return self.known[key]


class LeavesFiles(PaintedDepth):
    def predict(self, view: View) -> DepthPrior:
        os.close(tempfile.mkstemp()[0])
        return super().predict(view)


class SilencesCore(PaintedDepth):
    def __init__(self, options: Any, context: ProviderContext) -> None:
        super().__init__(options, context)
        logging.getLogger("mpsfm_core").setLevel(logging.ERROR)


class FiltersWarnings(PaintedDepth):
    def predict(self, view: View) -> DepthPrior:
        warnings.filterwarnings("ignore", category=UserWarning, module="torch")
        return super().predict(view)


class CachedBySum(PaintedDepth):
    """Fault: the key of a cache is the sum of all pixels, which a mirrored view shares."""

    def __init__(self, options: Any, context: ProviderContext) -> None:
        super().__init__(options, context)
        self.known: dict[Any, DepthPrior] = {}

    def predict(self, view: View) -> DepthPrior:
        key = view.image.shape, int(view.image.sum())
        if key not in self.known:
            self.known[key] = super().predict(view)
        return self.known[key]


class JointIgnoresMask(PaintedDepth):
    """Fault: the joint prediction ignores the mask of the view."""

    def predict(self, view: View) -> DepthPrior:
        depth = read_depth(view.image)
        return depth_prior(depth if view.mask is None else np.where(view.mask, depth, 0))

    def predict_joint(self, view: View) -> tuple[DepthPrior, NormalPrior]:
        return super().predict(view), normal_prior(read_normals(view.image), view)


class FocalOfArea(PaintedDepth):
    """Fault: the focal length is proportional to the root of the area of the view."""

    def estimate_focal(self, view: View) -> float:
        return float(0.866 * np.sqrt(view.camera.width * view.camera.height))


class NegatesPositiveZ(PaintedNormals):
    def predict(self, view: View, depth: DepthPrior | None = None) -> NormalPrior:
        normals = read_normals(view.image)
        normals[..., 2] = -np.abs(normals[..., 2])
        return normal_prior(normals, view)


class DropsPositiveZ(PaintedNormals):
    def predict(self, view: View, depth: DepthPrior | None = None) -> NormalPrior:
        normals = read_normals(view.image)
        normals[normals[..., 2] >= 0] = np.nan
        return normal_prior(normals, view)


class SizeInModule(PaintedDepth):
    """Fault: all instances share the size of the last view, so that a race cuts the map."""

    size = (0, 0)

    def predict(self, view: View) -> DepthPrior:
        SizeInModule.size = view.image.shape[:2]
        time.sleep(0.02)  # the network runs
        depth = read_depth(view.image)
        return depth_prior(depth[: self.size[0], : self.size[1]])


class EverySecondPixel(PaintedDepth):
    """Fault: uses the second pixel of each two pixels of a view above one megapixel."""

    def predict(self, view: View) -> DepthPrior:
        depth = read_depth(view.image)
        if depth.size > 1_000_000:
            depth = depth[1::2, 1::2].repeat(2, axis=0).repeat(2, axis=1)
        return depth_prior(depth)


class StretchesColors(PaintedDepth):
    """Fault: normalizes an image by its own minimum and maximum."""

    def predict(self, view: View) -> DepthPrior:
        low, high = float(view.image.min()), float(view.image.max())
        return depth_prior(read_depth((view.image - low) * (255 / max(high - low, 1))))


class MeaninglessDepth(PaintedNormals):
    """Fault: normals next to holes depend on the meaningless depth in the holes."""

    def predict(self, view: View, depth: DepthPrior | None = None) -> NormalPrior:
        assert depth is not None
        normals = read_normals(view.image)
        if depth.shape == normals.shape[:2]:
            mean = cv2.blur(depth.depth, (5, 5))
            normals[depth.valid & (mean > 1.3 * depth.depth)] *= (-1, 1, 1)
        return normal_prior(normals, view)


class ExcludesVisible(PaintedMask):
    """Fault: takes the mask of the view for the pixels to exclude."""

    def mask(self, view: View) -> Any:
        mask = super().mask(view)
        return mask if view.mask is None else mask & ~view.mask


@pytest.mark.parametrize(
    ("kind", "check", "message", "factory", "capabilities"),
    [
        ("depth", "name-does-not-matter", "of a renamed view differs", RotatesAgain, ()),
        ("depth", "large-view", "of the map is shifted", AlignedCorners, ()),
        ("depth", "panorama", "relative error", CropsPanoramas, ()),
        ("depth", "no-state", "another view with some equal pixels", CachedBySample, ()),
        ("depth", "global-state", "changes the temporary files", LeavesFiles, ()),
        ("depth", "global-state", "logger of mpsfm_core", SilencesCore, ()),
        ("depth", "global-state", "call .* changes the warning filters", FiltersWarnings, ()),
        ("depth", "no-state", "for the mirrored view", CachedBySum, ()),
        ("depth", "depth-joint", "for a view with a mask", JointIgnoresMask, ("joint-normals",)),
        ("depth", "depth-focal", "192 x 72 view is", FocalOfArea, ("estimates-focal",)),
        ("depth", "large-view", "of the map is shifted", EverySecondPixel, ()),
        ("depth", "few-colors", "relative error", StretchesColors, ()),
        ("normals", "normals-depth-input", "meaningless", MeaninglessDepth, ("needs-depth",)),
        ("normals", "normals-away-from-axis", "z are .* off", NegatesPositiveZ, ()),
        ("normals", "normals-away-from-axis", "only 0 of", DropsPositiveZ, ()),
        ("mask", "masked", "most values are invalid", ExcludesVisible, ()),
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
    level = logging.getLogger("mpsfm_core").level
    caught(kind, factory, check, message, PAINTED, *capabilities)
    logging.getLogger("mpsfm_core").setLevel(level)


class StretchesContrast(SiftDetector):
    """Fault: makes the image of a view writable, and stretches its contrast in place."""

    def extract(self, view: View) -> Features:
        image = view.image
        if image.max() < 200:
            image.flags.writeable = True
            image[:] = cv2.normalize(image, None, 0, 255, cv2.NORM_MINMAX)  # type: ignore[call-overload]
        return super().extract(view)


class HalfPrecision(SiftDetector):
    """Fault: keypoints in half precision are rounded to 2 pixels beyond 2048 pixels."""

    def extract(self, view: View) -> Features:
        features = super().extract(view)
        rounded = features.keypoints.astype(np.float16).astype(np.float64)
        return replace(features, keypoints=np.minimum(rounded, view.camera.size))


class TilesWithoutOverlap(SiftDetector):
    """Fault: the offset of tiles of 512 pixels ignores that they overlap by 32 pixels."""

    def extract(self, view: View) -> Features:
        tiles = []
        for index, left in enumerate(range(0, max(view.camera.width - 32, 1), 480)):
            image = np.ascontiguousarray(view.image[:, left : left + 512])
            camera = replace(view.camera, width=image.shape[1])
            features = super().extract(View(view.name, image, camera))
            features = replace(features, keypoints=features.keypoints + np.array([512 * index, 0]))
            tiles.append(features.select(features.keypoints[:, 0] <= view.camera.width))
        names = "keypoints", "descriptors", "scales"
        keypoints, descriptors, scales = (
            np.concatenate([getattr(tile, name) for tile in tiles]) for name in names
        )
        return Features(keypoints, descriptors, scales=scales)


def reduced(view: View, limit: int) -> tuple[View, Float64]:
    """Return a view with a limited longer side, and the factors (x, y) of the reduction."""
    size = np.maximum(
        1, np.round(np.array(view.camera.size) * min(1, limit / max(view.camera.size)))
    )
    small = cv2.resize(view.image, size.astype(int).tolist(), interpolation=cv2.INTER_AREA)
    camera = view.camera.resized(small.shape[1], small.shape[0])
    return View(view.name, small, camera), view.camera.size / size


class ConstantScales(SiftDetector):
    """Fault: the scale of all keypoints is in pixels of the reduced image."""

    def extract(self, view: View) -> Features:
        small, factors = reduced(view, 800)
        features = super().extract(small)
        scales = np.full(len(features), 4, np.float32)
        return replace(features, keypoints=features.keypoints * factors, scales=scales)


class OneFactor(SiftDetector):
    """Fault: rounds the reduced sides to multiples of 32, and scales both by one factor."""

    def extract(self, view: View) -> Features:
        factor = min(1.0, 640 / max(view.camera.size))
        if factor == 1:
            return super().extract(view)
        size = [max(32, round(factor * side) // 32 * 32) for side in view.camera.size]
        small = cv2.resize(view.image, size, interpolation=cv2.INTER_AREA)
        features = super().extract(View(view.name, small, view.camera.resized(*size)))
        features = replace(features, keypoints=features.keypoints / factor)
        return features.select((features.keypoints <= view.camera.size).all(axis=1))


class SwapsTall(SiftDetector):
    def extract(self, view: View) -> Features:
        features = super().extract(view)
        if view.camera.height < 1.8 * view.camera.width:
            return features
        return replace(
            features, keypoints=np.minimum(features.keypoints[:, ::-1], view.camera.size)
        )


class DropsVisible(SiftDetector):
    """Fault: drops the keypoints where the mask of the view is True."""

    def extract(self, view: View) -> Features:
        features = super().extract(view)
        if view.mask is None:
            return features
        columns, rows = np.minimum(features.keypoints.astype(int).T, np.array([[191], [143]]))
        return features.select(~view.mask[rows, columns])


@pytest.mark.parametrize(
    ("factory", "check", "message"),
    [
        (StretchesContrast, "inputs-unchanged", "modifies its input image"),
        (HalfPrecision, "features-large-view", "is rounded to 2 px"),
        (TilesWithoutOverlap, "features-large-view", r"differ by \(\+224.0, \+0.0\) px"),
        (ConstantScales, "features-large-view", "is 1 times as large|are 1 times as large"),
        (OneFactor, "features-large-view", "parts of a large view differ by"),
        (SwapsTall, "features-axes", "textured part of a 96 x 288 view"),
        (DropsVisible, "masked", "only 0 of"),
    ],
)
def test_faulty_features_provider_fails_its_check(
    caught: Callable[..., None], factory: type, check: str, message: str
) -> None:
    caught("features", factory, check, message)


class ReducingMatcher(DenseSift):
    """Dense matcher that reduces both views to 1024 pixels."""

    def match(self, a: View, b: View, fa: Any = None, fb: Any = None) -> PairMatches:
        (small_a, factors_a), (small_b, factors_b) = (reduced(view, 1024) for view in (a, b))
        dense = super().match(small_a, small_b).dense
        assert dense is not None
        points = dense.points_a, dense.points_b
        first, second = self.enlarge(points, (factors_a, factors_b))
        inside = (first <= a.camera.size).all(axis=1) & (second <= b.camera.size).all(axis=1)
        return PairMatches(dense=DenseMatches(first[inside], second[inside], dense.scores[inside]))

    def enlarge(self, points: Any, factors: Any) -> tuple[Float64, Float64]:
        raise NotImplementedError


class FactorOfFirst(ReducingMatcher):
    def enlarge(self, points: Any, factors: Any) -> tuple[Float64, Float64]:
        return points[0] * factors[0], points[1] * factors[0]


class KeepsBorder(DenseSift):
    """Fault: points of portrait photos keep the border of the square input of the network."""

    def match(self, a: View, b: View, fa: Any = None, fb: Any = None) -> PairMatches:
        found = super().match(a, b).dense
        assert found is not None
        points = []
        for xy, view in ((found.points_a, a), (found.points_b, b)):
            width, height = view.camera.size
            border = np.array([max(0, height - width) / 2, 0.0])
            points.append((xy + border) * (min(1, width / height), 1))
        return PairMatches(dense=DenseMatches(*points, found.scores))


class LargerFirst(ReducingMatcher):
    """Fault: matches the larger view first, and does not swap the points back."""

    def match(self, a: View, b: View, fa: Any = None, fb: Any = None) -> PairMatches:
        first, second = (b, a) if b.image.size > a.image.size else (a, b)
        dense = super().match(first, second).dense
        assert dense is not None
        points = (
            np.minimum(p, v.camera.size) for p, v in ((dense.points_a, a), (dense.points_b, b))
        )
        return PairMatches(dense=DenseMatches(*points, dense.scores))

    def enlarge(self, points: Any, factors: Any) -> tuple[Float64, Float64]:
        return points[0] * factors[0], points[1] * factors[1]


class IntegerCenters(ReducingMatcher):
    def enlarge(self, points: Any, factors: Any) -> tuple[Float64, Float64]:
        first, second = ((p - 0.5) * f + 0.5 for p, f in zip(points, factors, strict=True))
        return first, second


@pytest.mark.parametrize(
    ("factory", "check", "message"),
    [
        (FactorOfFirst, "matcher-mixed-sizes", "have a scale of 0.5 and 0.5 in x and y"),
        (LargerFirst, "matcher-mixed-sizes", "have a scale of 1 and 1 in x and y"),
        (KeepsBorder, "matcher-mixed-sizes", "have a scale of 0.75 and 1 in x and y"),
        (IntegerCenters, "matcher-mixed-sizes", r"shifted by \(-0\.[45]"),
    ],
)
def test_faulty_dense_matcher_fails_its_check(
    caught: Callable[..., None], factory: type, check: str, message: str
) -> None:
    caught("matcher", factory, check, message, None, "dense")


class DropsBeyondFirst(NearestMatcher):
    """Fault: drops matches whose position in the second view is beyond the size of the first."""

    def match(self, a: View, b: View, fa: Any = None, fb: Any = None) -> PairMatches:
        found = super().match(a, b, fa, fb).sparse
        assert found is not None
        inside = (fb.keypoints[found.indices[:, 1]] < a.camera.size).all(axis=1)
        return PairMatches(SparseMatches(found.indices[inside], found.scores[inside]))


class Crop224(Thumbnail):
    """Fault: describes the central 224 x 224 pixels, and not a resized view."""

    def describe(self, view: View) -> Any:
        top, left = (max(0, (side - 224) // 2) for side in view.image.shape[:2])
        image = np.ascontiguousarray(view.image[top : top + 224, left : left + 224])
        camera = replace(view.camera, width=image.shape[1], height=image.shape[0])
        return super().describe(View(view.name, image, camera))


@pytest.mark.parametrize(
    ("kind", "factory", "check", "message", "capabilities"),
    [
        ("matcher", DropsBeyondFirst, "matcher-sizes", "outer quarter of the overlap", ("sparse",)),
        ("retrieval", Crop224, "retrieval-sizes", "copy of the view, but .* three steps", ()),
    ],
)
def test_provider_with_fault_for_large_views_fails_its_check(
    caught: Callable[..., None],
    kind: Any,
    factory: type,
    check: str,
    message: str,
    capabilities: tuple[str, ...],
) -> None:
    caught(kind, factory, check, message, None, *capabilities)


def test_instances_that_share_the_size_of_a_view_fail_in_threads(
    caught: Callable[..., None],
) -> None:
    caught("depth", SizeInModule, "threads", "in two parallel threads", PAINTED)


def test_provider_that_opens_its_weights_itself_fails(tmp_path: Path) -> None:
    path = tmp_path / "tiny.npz"
    np.savez(path, weights=np.zeros(1))
    registry = Registry()
    weights = (WeightsFile(str(path)),)
    registry.add(ProviderSpec("depth", "opens-weights", PaintedDepth, weights=weights))
    (result,) = run_checks(registry, "depth", "opens-weights", PAINTED, only={"construction"})
    assert result.status == "fail" and "without context.resolve_weights" in result.message


class RandomWithoutWeights(PaintedDepth):
    """Fault: uses random weights if the weights file is missing."""

    def __init__(self, options: Any, context: ProviderContext) -> None:
        super().__init__(options, context)
        try:
            self.factor = float(np.load(context.resolve_weights(options.weights))["weights"])
        except Exception:
            self.factor = 0.9

    def predict(self, view: View) -> DepthPrior:
        return depth_prior(self.factor * read_depth(view.image))


class HidesMissingWeights(RandomWithoutWeights):
    """Fault: the error for a missing weights file does not contain the name of the file."""

    def __init__(self, options: Any, context: ProviderContext) -> None:
        super().__init__(options, context)
        if self.factor != 1:
            raise RuntimeError("the network has no weights")


class FileOptions(Options):
    weights: str


@pytest.mark.parametrize(
    ("factory", "check", "message"),
    [
        (RandomWithoutWeights, "missing-file", "an output without the file of 'weights'"),
        (HidesMissingWeights, "missing-file", "does not name the missing file .*'weights'"),
    ],
)
def test_provider_without_weights_fails_its_check(
    caught: Callable[..., None], factory: type, check: str, message: str
) -> None:
    def setup(folder: Path) -> ContractSetup:
        np.savez(folder / "tiny.npz", weights=1.0)
        return ContractSetup({"weights": str(folder / "tiny.npz")}, "painted")

    caught("depth", factory, check, message, setup, options=FileOptions)


class DepthOfLargerFirst(ToldMatcher):
    """Fault: returns the depth of the larger view first."""

    def match(self, a: View, b: View, fa: Any = None, fb: Any = None) -> PairMatches:
        found = super().match(a, b)
        if b.image.size <= a.image.size or found.depth is None:
            return found
        return replace(found, depth=PairDepth(found.depth.depth_b, found.depth.depth_a))


def test_matcher_with_depth_in_order_of_size_fails_its_check(caught: Callable[..., None]) -> None:
    def told_pair(folder: Any) -> ContractSetup:
        return ContractSetup(
            options={"folder": folder},
            truth_source="prepared",
            prepare=lambda example: ref.tell(folder, example),
        )

    capabilities = "dense", "pair-depth"
    check = "matcher-pair-depth"
    caught(
        *("matcher", DepthOfLargerFirst, check, "depth_a and depth_b are swapped", told_pair),
        *capabilities,
        options=ref.ToldOptions,
    )


class IntrinsicsOfFirst(ToldGroup):
    """Fault: all views of a large group get the intrinsics of the first view."""

    def predict_group(self, views: Sequence[View]) -> MultiViewPrior:
        group = super().predict_group(views)
        assert group.intrinsics is not None
        first = np.repeat(group.intrinsics[:1], len(views), axis=0)
        return replace(group, intrinsics=first if len(views) > 3 else group.intrinsics)


class ReversesPoses(ToldGroup):
    """Fault: the poses of a large group are in the reverse order."""

    def predict_group(self, views: Sequence[View]) -> MultiViewPrior:
        group = super().predict_group(views)
        assert group.poses is not None
        return replace(group, poses=group.poses[::-1].copy() if len(views) > 3 else group.poses)


@pytest.mark.parametrize(
    ("factory", "message"),
    [
        (IntrinsicsOfFirst, "intrinsics of view . of a group"),
        (ReversesPoses, "rotation of view 2 of a group"),
    ],
)
def test_multiview_provider_with_wrong_cameras_of_large_groups_fails_its_check(
    caught: Callable[..., None], factory: type, message: str
) -> None:
    check = "multiview-group-sizes"
    caught("multiview", factory, check, message, told, *EVERYTHING, options=ref.ToldOptions)


class CallsTwice(Wrapper):
    """Calls the wrapped provider with a changed view first, and returns the output of the view."""

    def predict(self, view: View, depth: DepthPrior | None = None) -> Any:
        if min(view.camera.size) > 20:
            self.inner.predict(self.change(view))
        return super().predict(view, depth)

    def change(self, view: View) -> View:
        raise NotImplementedError


class RotatesImageOnly(CallsTwice):
    """Fault: rotates portrait views without their intrinsics."""

    def change(self, view: View) -> View:
        camera = view.camera
        if camera.height <= camera.width:
            return view
        size, focal = (camera.height, camera.width), (camera.fx, camera.fy)
        turned = PinholeCamera(*size, *focal, camera.cx, camera.cy)
        return View(view.name, np.ascontiguousarray(np.rot90(view.image)), turned)


class MirrorsWithoutMask(CallsTwice):
    """Fault: mirrors image and principal point, but not the mask."""

    def change(self, view: View) -> View:
        camera = replace(view.camera, cx=view.camera.width - view.camera.cx)
        return replace(view, image=np.ascontiguousarray(view.image[:, ::-1]), camera=camera)


class ReducesImageOnly(CallsTwice):
    def change(self, view: View) -> View:
        image = np.ascontiguousarray(view.image[::2, ::2])
        camera = replace(view.camera, width=image.shape[1], height=image.shape[0])
        return View(view.name, image, camera)


class ChangesPrior(Wrapper):
    """Fault: doubles the std in the arrays of the wrapped provider, instead of a copy."""

    def predict(self, view: View, depth: DepthPrior | None = None) -> Any:
        prior = super().predict(view, depth)
        if prior.variance is not None:
            prior.variance.flags.writeable = True
            prior.variance[:] *= 4
        return prior


class CropsImageOnly(CallsTwice):
    def change(self, view: View) -> View:
        image = np.ascontiguousarray(view.image[8:-8, 8:-8])
        camera = replace(view.camera, width=image.shape[1], height=image.shape[0])
        return View(view.name, image, camera)


@pytest.mark.parametrize(
    ("factory", "check", "message"),
    [
        (RotatesImageOnly, "wrapper-inputs", "the camera of .*, rotated by 90 degrees"),
        (MirrorsWithoutMask, "wrapper-inputs", "the mask of another view for 'mirrored"),
        (ReducesImageOnly, "wrapper-inputs", "the camera of a resized copy"),
        (ChangesPrior, "wrapper-inputs", "a prior of its own that the wrapper changed"),
        (CropsImageOnly, "wrapper-inputs", "the camera of a part"),
    ],
)
def test_faulty_wrapper_fails_its_check(
    caught: Callable[..., None], factory: type, check: str, message: str
) -> None:
    caught("wrapper", factory, check, message, None, "wraps-depth")
