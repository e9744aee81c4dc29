"""Tests of the providers with small ONNX networks whose output is known."""

from __future__ import annotations

import numpy as np
import pytest
from mpsfm_lightglue_onnx.features import Disk, SuperPoint
from mpsfm_lightglue_onnx.matcher import LightGlue
from mpsfm_lightglue_onnx.options import DiskOptions, LightGlueOptions, SuperPointOptions

from mpsfm_core import Features, PinholeCamera, View
from mpsfm_core.data.errors import ConfigError, ProviderError
from mpsfm_core.providers.registry import Registry

# Detector network with keypoints at given pixels of its input. Every keypoint descriptor is the
# color of the first keypoint.
DETECTOR = """
detector (float[b,CHANNELS,h,w] image) => (
    int64[b,n,2] keypoints, float[b,n] scores, float[b,n,CHANNELS] descriptors) {
    keypoints = Identity (places)
    scores = Identity (strengths)
    pixel = Slice (image, start, stop, rows_columns)
    colour = Reshape (pixel, flat)
    descriptors = Expand (colour, all)
}
"""
MATCHER = """
lightglue (float[b,n,2] kpts0, float[b,m,2] kpts1, float[b,n,d] desc0, float[b,m,d] desc1) => (
    int64[OUT] matches0, float[SCORES] mscores0) {
    matches0 = Identity (known)
    mscores0 = Identity (certain)
}
"""
ECHO = """
lightglue (float[1,n,2] kpts0, float[1,n,2] kpts1, float[b,n,d] desc0, float[b,m,d] desc1) => (
    int64[m,2] matches0, float[m] mscores0) {
    matches0 = Identity (known)
    flat = Reshape (kpts0, all)
    first = Slice (flat, zero, two)
    mscores0 = Add (first, half)
}
"""
PLACES = np.array([[[0, 0], [10, 4], [24, 15], [31, 23], [40, 5]]])
STRENGTHS = np.array([[0.5, 0.9, 0.1, 0.7, 0.8]])


def view_of(width, height, colour=(255, 0, 0), mask=None):
    image = np.full((height, width, 3), colour, dtype=np.uint8)
    camera = PinholeCamera(width, height, 90.0, 90.0, width / 2, height / 2)
    return View("a.png", image, camera, mask)


@pytest.fixture
def detector(write_onnx):
    def make(channels):
        arrays = {"start": [0, 0], "stop": [1, 1], "rows_columns": [2, 3]}
        arrays |= {"flat": [1, 1, channels], "all": [1, 5, channels]}
        return str(
            write_onnx(
                DETECTOR.replace("CHANNELS", str(channels)),
                places=PLACES,
                strengths=STRENGTHS,
                **{name: np.array(value) for name, value in arrays.items()},
            )
        )

    return make


def test_keypoints_become_pixels_of_the_view(detector, context):
    """Check keypoints in an image shrunk to 32 x 24 pixels, without those outside of the image."""
    options = SuperPointOptions(model=detector(1), resize=32)
    found = SuperPoint(options, context).extract(view_of(128, 96))
    order = [1, 3, 0, 2]  # by score, without the keypoint (40, 5) outside of the view
    np.testing.assert_allclose(found.keypoints, (PLACES[0][order] + 0.5) * 4)
    np.testing.assert_allclose(found.scores, STRENGTHS[0][order])
    assert found.std_px == 4.0
    # The descriptor is the luma of pure red.
    np.testing.assert_allclose(found.descriptors, 0.299, rtol=1e-5)


def test_disk_sees_colours_on_multiples_of_16(detector, context):
    found = Disk(DiskOptions(model=detector(3), max_keypoints=2), context).extract(
        view_of(50, 30, (255, 51, 0))
    )
    # The image of 50 x 30 pixels is resized to 48 x 32, where all five keypoints are inside.
    np.testing.assert_allclose(found.keypoints[0], (10.5 * 50 / 48, 4.5 * 30 / 32))
    np.testing.assert_allclose(found.keypoints[1], (40.5 * 50 / 48, 5.5 * 30 / 32))
    np.testing.assert_allclose(found.descriptors, [[1.0, 0.2, 0.0]] * 2, rtol=1e-5)


def test_masked_keypoints_are_left_out(detector, context):
    mask = np.ones((24, 48), dtype=np.bool_)
    mask[4, 10] = False
    options = SuperPointOptions(model=detector(1))
    found = SuperPoint(options, context).extract(view_of(48, 24, mask=mask))
    assert (10.5, 4.5) not in set(map(tuple, found.keypoints)) and len(found) == 4


def features_of(count, dimension=4):
    keypoints = np.arange(2.0 * count).reshape(count, 2)
    return Features(keypoints, np.ones((count, dimension), dtype=np.float32))


@pytest.mark.parametrize("form", ["pairs", "rows"])
def test_both_forms_of_the_matches(form, write_onnx, context):
    if form == "pairs":
        text = MATCHER.replace("OUT", "m,2").replace("SCORES", "m")
        known, certain = [[0, 2], [3, 1], [4, 4]], [0.5, 0.05, 0.9]
    else:
        text = MATCHER.replace("OUT", "b,n").replace("SCORES", "b,n")
        known, certain = [[2, -1, -1, 1, 4]], [[0.5, 0.0, 0.0, 0.05, 0.9]]
    model = write_onnx(text, known=np.array(known), certain=certain)
    matcher = LightGlue(LightGlueOptions(model=str(model)), context)
    view = view_of(64, 48)
    found = matcher.match(view, view, features_of(5), features_of(5)).sparse
    assert found.indices.tolist() == [[0, 2], [4, 4]]
    np.testing.assert_allclose(found.scores, [0.5, 0.9])


def test_keypoints_are_normalised_by_the_longer_side(write_onnx, context):
    """Check the normalization of keypoints by a network that returns x and y as match scores."""
    constants = {"known": [[0, 1], [1, 0]], "all": [-1], "zero": [0], "two": [2]}
    arrays = {name: np.array(value) for name, value in constants.items()}
    model = write_onnx(ECHO, half=[0.5], **arrays)
    view = view_of(64, 48)
    some = Features(np.array([[40.5, 20.5], [1.0, 1.0]]), np.ones((2, 4), dtype=np.float32))
    options = LightGlueOptions(model=str(model), min_score=0)
    found = LightGlue(options, context).match(view, view, some, some).sparse
    expected = np.array([(40 - 32) / 32, (20 - 24) / 32]) + 0.5
    np.testing.assert_allclose(found.scores, expected, rtol=1e-6)


def test_no_features_no_matches_and_errors(write_onnx, detector, context):
    text = MATCHER.replace("OUT", "m,2").replace("SCORES", "m")
    model = write_onnx(text, "matcher.onnx", known=np.array([[0, 0]]), certain=[0.5])
    matcher = LightGlue(LightGlueOptions(model=str(model)), context)
    view = view_of(64, 48)
    assert len(matcher.match(view, view, features_of(0), features_of(3)).sparse) == 0
    with pytest.raises(ProviderError, match="choose a features provider"):
        matcher.match(view, view)
    with pytest.raises(ConfigError, match=r"LightGlue needs inputs \['desc0'"):
        LightGlue(LightGlueOptions(model=detector(1)), context)


def test_features_and_matchers_of_a_family_share_a_tag():
    registry = Registry.discover()
    for features, matcher in (
        ("superpoint", "lightglue-superpoint"),
        ("disk-onnx", "lightglue-disk-onnx"),
    ):
        assert registry.spec("features", features).tags == registry.spec("matcher", matcher).tags
