"""Tests of SIFT against COLMAP's extractor and of the matcher against brute force."""

from __future__ import annotations

import cv2
import numpy as np
import pycolmap
import pytest

from mpsfm_core.data import Features, PinholeCamera, View
from mpsfm_core.data.errors import ProviderError
from mpsfm_core.providers import ProviderContext
from mpsfm_core.providers.builtin import mutual_nearest
from mpsfm_core.providers.builtin.mutual_nearest import MutualNearest
from mpsfm_core.providers.builtin.options import MutualNearestOptions, SiftOptions
from mpsfm_core.providers.builtin.sift import Sift
from mpsfm_core.testing.synthetic.scenes import arc_poses, room_scene

CAMERA = PinholeCamera(320, 240, 280.0, 280.0, 160.0, 120.0)


def as_view(image: np.ndarray, name: str = "a") -> View:
    height, width = image.shape[:2]
    return View(name, image, PinholeCamera(width, height, 280.0, 280.0, width / 2, height / 2))


@pytest.fixture(scope="module")
def views() -> tuple[View, View]:
    """Return two views of the analytic room scene, 8 degrees apart."""
    poses = arc_poses(2, 8.0)
    images = [room_scene().render(CAMERA, pose).rgb for pose in poses]
    return View("a", images[0], CAMERA), View("b", images[1], CAMERA)


def test_sift_equals_colmap(views, context: ProviderContext) -> None:
    found = Sift(SiftOptions(), context).extract(views[0])
    settings = pycolmap.FeatureExtractionOptions()
    settings.use_gpu = False
    extractor = pycolmap.FeatureExtractor.create(settings, pycolmap.Device.cpu)
    gray = cv2.cvtColor(views[0].image, cv2.COLOR_RGB2GRAY)
    keypoints, descriptors = extractor.extract(pycolmap.Bitmap.from_array(gray))
    assert len(found) == len(keypoints) > 100
    assert np.array_equal(found.keypoints, [(k.x, k.y) for k in keypoints])
    assert np.allclose(found.scales, [k.compute_scale() for k in keypoints], atol=1e-4)
    expected = np.asarray(descriptors.data, dtype=np.float64)
    expected /= np.linalg.norm(expected, axis=1, keepdims=True)
    assert np.allclose(found.descriptors, expected, atol=1e-6)


def test_sift_pixel_convention(context: ProviderContext) -> None:
    """Check that a blob at the center of pixel (row 40, column 70) is detected at (70.5, 40.5)."""
    rows, columns = np.mgrid[0:100, 0:140]
    blob = np.exp(-((rows - 40) ** 2 + (columns - 70) ** 2) / (2 * 4.0**2))
    gray = np.round(40 + 180 * blob).astype(np.uint8)
    found = Sift(SiftOptions(), context).extract(as_view(np.repeat(gray[..., None], 3, axis=2)))
    distance = np.linalg.norm(found.keypoints - [70.5, 40.5], axis=1)
    assert distance.min() < 0.1


def test_sift_options_limit_and_orient_keypoints(views, context: ProviderContext) -> None:
    full = Sift(SiftOptions(), context).extract(views[0])
    few = Sift(SiftOptions(max_keypoints=50), context).extract(views[0])
    # Several orientations may add keypoints at the same position.
    assert 50 <= len(few) < 70 < len(full)
    upright = Sift(SiftOptions(upright=True), context).extract(views[0])
    assert len(upright) < len(full)
    plain = Sift(SiftOptions(root=False), context).extract(views[0])
    assert np.array_equal(plain.keypoints, full.keypoints)
    assert not np.allclose(plain.descriptors, full.descriptors, atol=0.05)


def test_resized_sift_returns_pixels_of_the_view(views, context: ProviderContext) -> None:
    """Check that SIFT at half the size returns keypoints and scales in pixels of the view."""
    found = Sift(SiftOptions(resize=160), context).extract(views[0])
    assert found.std_px == 2.0
    assert found.keypoints[:, 0].max() > 200 and found.keypoints[:, 1].max() > 150
    full = Sift(SiftOptions(), context).extract(views[0])
    assert full.std_px == 1.0
    assert found.scales.min() > 1.5 * full.scales.min()


def test_sift_of_blank_view_finds_no_keypoints(context: ProviderContext) -> None:
    found = Sift(SiftOptions(), context).extract(as_view(np.zeros((40, 60, 3), np.uint8)))
    assert len(found) == 0 and found.descriptors.shape == (0, 128)


def test_matches_are_correct(views, context: ProviderContext) -> None:
    sift = Sift(SiftOptions(), context)
    a, b = (sift.extract(view) for view in views)
    sparse = MutualNearest(MutualNearestOptions(), context).match(*views, a, b).sparse
    poses = arc_poses(2, 8.0)
    xy_a = a.keypoints[sparse.indices[:, 0]]
    truth = room_scene().correspondences(CAMERA, poses[0], CAMERA, poses[1], xy_a)
    error = np.linalg.norm(b.keypoints[sparse.indices[:, 1]] - truth.xy_b, axis=1)
    right = truth.visible & (error < 2)
    assert len(sparse) > 50 and right.mean() > 0.9
    assert sparse.scores[right].mean() > sparse.scores[~right].mean()


def random_features(count: int, seed: int, dimension: int = 8) -> Features:
    rng = np.random.default_rng(seed)
    descriptors = rng.normal(size=(count, dimension)).astype(np.float32)
    return Features(rng.uniform(0, 200, (count, 2)), descriptors)


def brute_force(a: np.ndarray, b: np.ndarray, limit: float) -> dict[tuple[int, int], float]:
    distances = np.linalg.norm(a[:, None] - b[None], axis=2)
    found = {}
    for i in range(len(a)):
        j = int(distances[i].argmin())
        if distances[:, j].argmin() == i:
            rest = min(np.delete(distances[i], j).min(), np.delete(distances[:, j], i).min())
            ratio = distances[i, j] / rest
            if ratio <= limit:
                found[i, j] = 1 - ratio
    return found


@pytest.mark.parametrize("ratio", [None, 0.8])
@pytest.mark.parametrize("sizes", [(300, 280), (3, 40), (40, 3)])
def test_matches_equal_brute_force(
    ratio, sizes, context, views, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(mutual_nearest, "_BLOCK", 64)
    a, b = random_features(sizes[0], 1), random_features(sizes[1], 2)
    options = MutualNearestOptions(ratio=ratio)
    sparse = MutualNearest(options, context).match(*views, a, b).sparse
    expected = brute_force(a.descriptors, b.descriptors, ratio or 1.0)
    assert set(map(tuple, sparse.indices.tolist())) == set(expected)
    scores = [expected[tuple(pair)] for pair in sparse.indices.tolist()]
    assert np.allclose(sparse.scores, scores, atol=2e-3)


def test_matching_is_symmetric(context: ProviderContext, views) -> None:
    a, b = random_features(200, 1), random_features(150, 2)
    matcher = MutualNearest(MutualNearestOptions(), context)
    forward = matcher.match(*views, a, b).sparse.indices.tolist()
    backward = matcher.match(*views[::-1], b, a).sparse.indices[:, ::-1].tolist()
    assert sorted(forward) == sorted(backward)


def test_equal_descriptors_match_once(context: ProviderContext, views) -> None:
    a, b = random_features(20, 1), random_features(20, 1)
    doubled = Features(np.repeat(a.keypoints, 2, axis=0), np.repeat(a.descriptors, 2, axis=0))
    options = MutualNearestOptions(ratio=None)
    sparse = MutualNearest(options, context).match(*views, doubled, b).sparse
    assert len(np.unique(sparse.indices[:, 1])) == len(sparse) <= 20
    tested = MutualNearest(MutualNearestOptions(), context).match(*views, doubled, b).sparse
    # If the nearest and second nearest distances are equal, there is no distinctive match.
    assert len(tested) == 0


def test_max_distance(context: ProviderContext, views) -> None:
    a, b = random_features(200, 1), random_features(150, 2)
    options = MutualNearestOptions(ratio=None, max_distance=1.5)
    sparse = MutualNearest(options, context).match(*views, a, b).sparse
    rows = sparse.indices
    distances = np.linalg.norm(a.descriptors[rows[:, 0]] - b.descriptors[rows[:, 1]], axis=1)
    everything = brute_force(a.descriptors, b.descriptors, 1.0)
    assert 0 < len(sparse) < len(everything) and distances.max() <= 1.5


@pytest.mark.parametrize("sizes", [(0, 0), (0, 5), (5, 0), (1, 1)])
def test_few_features_give_no_matches(sizes, context: ProviderContext, views) -> None:
    a, b = random_features(sizes[0], 1), random_features(sizes[1], 2)
    sparse = MutualNearest(MutualNearestOptions(), context).match(*views, a, b).sparse
    assert len(sparse) == min(sizes)


def test_match_of_wrong_features_raises(context: ProviderContext, views) -> None:
    matcher = MutualNearest(MutualNearestOptions(), context)
    with pytest.raises(ProviderError, match="choose a features provider"):
        matcher.match(*views)
    with pytest.raises(ProviderError, match="differ in dimension"):
        matcher.match(*views, random_features(5, 1), random_features(5, 1, dimension=9))
