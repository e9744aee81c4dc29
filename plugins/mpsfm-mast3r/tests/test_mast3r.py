"""Tests of the matchers with small ONNX networks whose output is known."""

from __future__ import annotations

import numpy as np
import pytest
from mpsfm_mast3r.matcher import DenseMatcher, SparseMatcher
from mpsfm_mast3r.neighbors import find_mutual, find_nearest, find_reciprocal
from mpsfm_mast3r.options import DenseOptions, SparseOptions

from mpsfm_core import Features, PinholeCamera, View
from mpsfm_core.data.errors import ConfigError, ProviderError
from mpsfm_core.providers.provider_config import ProviderConfig
from mpsfm_core.providers.registry import Registry
from mpsfm_core.providers.uncertainty.calibration import DepthCalibration

SIZE = (80, 60)  # size of test views, resized to 64 x 48

# The network returns the red channel as z and green as certainty for its first input. For the
# second input, the network returns 90 for z and certainty. Descriptors are the unit vectors of
# (red, green, blue).
STAND_IN = """
mast3r (float[b,3,h1,w1] img1, float[b,3,h2,w2] img2) => (
    float[b,h1,w1,3] pts3d_1, float[b,h1,w1] conf_1, float[b,h1,w1,3] desc_1,
    float[b,h1,w1] desc_conf_1, float[b,h2,w2,3] pts3d_2, float[b,h2,w2] conf_2,
    float[b,h2,w2,3] desc_2, float[b,h2,w2] desc_conf_2) {
    one = Mul (img1, half)
    rgb1 = Add (one, half)
    last1 = Transpose <perm = [0, 2, 3, 1]> (rgb1)
    two = Mul (img2, half)
    rgb2 = Add (two, half)
    last2 = Transpose <perm = [0, 2, 3, 1]> (rgb2)
    pts3d_1 = Gather <axis = 3> (last1, turned)
    conf_1 = Gather <axis = 3> (last1, green)
    pts3d_2 = Mul (last2, wrong)
    conf_2 = ReduceSum <keepdims = 0> (pts3d_2, axis)
    norm1 = ReduceL2 <axes = [3]> (last1)
    norm2 = ReduceL2 <axes = [3]> (last2)
    desc_1 = Div (last1, norm1)
    desc_2 = Div (last2, norm2)
    desc_conf_1 = Gather <axis = 3> (last1, blue)
    desc_conf_2 = Gather <axis = 3> (last2, blue)
}
"""


@pytest.fixture
def model(write_onnx):
    path = write_onnx(
        STAND_IN,
        half=[0.5],
        turned=np.array([2, 1, 0]),
        green=np.array(1),
        blue=np.array(2),
        wrong=[90.0],
        axis=np.array([3]),
    )
    return {"model": str(path), "size": 64}


def view_of(image, name="a.png"):
    height, width = image.shape[:2]
    return View(name, image, PinholeCamera(width, height, 70.0, 70.0, width / 2, height / 2))


@pytest.fixture
def scattered():
    """Create two views with 12 blocks of distinct colors in different places, and block centers."""
    rng = np.random.default_rng(1)
    colours = rng.permutation(np.mgrid[5:255:80, 5:255:80, 5:255:80].reshape(3, -1).T)
    directions = colours / np.linalg.norm(colours, axis=1, keepdims=True)
    distinct = [0]
    for row in range(len(colours)):
        if (directions[distinct] @ directions[row]).max() < 0.97:
            distinct.append(row)
    chosen = colours[distinct[:12]]
    views, centres = [], []
    for name in ("a.png", "b.png"):
        image = np.full((SIZE[1], SIZE[0], 3), 40, dtype=np.uint8)
        places = rng.permutation(np.mgrid[0:4, 0:3].reshape(2, -1).T) * 20
        for colour, (x, y) in zip(chosen, places, strict=True):
            image[y + 5 : y + 15, x + 5 : x + 15] = colour
        views.append(view_of(image, name))
        centres.append(places + 10.0)
    return views, centres


def features_at(keypoints):
    return Features(np.asarray(keypoints, dtype=np.float64), np.zeros((len(keypoints), 1), "f4"))


class TestDense:
    def test_matches_are_the_same_blocks(self, model, scattered, context):
        (a, b), centres = scattered
        found = DenseMatcher(DenseOptions(**model, subsample=4), context).match(a, b).dense
        block = [
            np.abs(xy[:, None] - c[None]).max(axis=2)
            for xy, c in zip((found.points_a, found.points_b), centres, strict=True)
        ]
        nearest_block = [distance.argmin(axis=1) for distance in block]
        on_block = (block[0].min(axis=1) < 5) & (block[1].min(axis=1) < 5)
        assert len(set(nearest_block[0][on_block])) == 12
        np.testing.assert_array_equal(nearest_block[0][on_block], nearest_block[1][on_block])
        assert found.std_px == 1.0

    def test_scores_are_the_mean_of_both_certainties(self, model, context):
        colours = ((30, 60, 255), (30, 60, 64))
        a, b = (view_of(np.full((60, 80, 3), c, dtype=np.uint8)) for c in colours)
        found = DenseMatcher(DenseOptions(**model), context).match(a, b).dense
        certainty = np.sqrt(255 / 255 * 64 / 255)
        np.testing.assert_allclose(found.scores, certainty / (1 + certainty), rtol=1e-5)

    def test_positions_lie_at_pixel_centres_of_the_cropped_view(self, model, context):
        """Check depth and matches of an image that is resized to 64 x 39 and cropped to 64 x 32."""
        rng = np.random.default_rng(0)
        image = rng.integers(30, 225, (61, 100, 3), dtype=np.uint8)
        view = view_of(image)
        found = DenseMatcher(DenseOptions(**model, subsample=1), context).match(view, view).dense
        np.testing.assert_array_equal(found.points_a, found.points_b)
        columns = np.unique(found.points_a[:, 0])
        rows = np.unique(found.points_a[:, 1])
        np.testing.assert_allclose(columns, (np.arange(64) + 0.5) * 100 / 64)
        np.testing.assert_allclose(rows, (np.arange(32) + 0.5 + 3) * 61 / 39)


class TestSparse:
    def test_keypoints_are_matched_by_their_descriptors(self, model, scattered, context):
        (a, b), centres = scattered
        order = np.random.default_rng(2).permutation(12)
        features = features_at(centres[0]), features_at(centres[1][order])
        found = SparseMatcher(SparseOptions(**model), context).match(a, b, *features).sparse
        np.testing.assert_array_equal(found.indices[:, 0], np.arange(12))
        np.testing.assert_array_equal(order[found.indices[:, 1]], np.arange(12))

    def test_too_different_and_cut_off_keypoints_have_no_match(self, model, context):
        a = view_of(np.full((60, 100, 3), (250, 5, 5), dtype=np.uint8))
        b = view_of(np.full((60, 100, 3), (5, 250, 5), dtype=np.uint8))
        keypoints = features_at([(50.0, 30.0), (50.0, 1.0)])
        matcher = SparseMatcher(SparseOptions(**model), context)
        assert len(matcher.match(a, b, keypoints, keypoints).sparse) == 0
        same = matcher.match(a, a, keypoints, keypoints).sparse
        np.testing.assert_array_equal(same.indices, [[0, 0]])

    def test_sparse_matcher_without_features_raises(self, model, scattered, context):
        with pytest.raises(ProviderError, match="choose a features provider"):
            SparseMatcher(SparseOptions(**model), context).match(*scattered[0])


def test_depth_of_each_view_comes_from_the_pass_where_it_is_first(model, context):
    image = np.zeros((61, 100, 3), dtype=np.uint8)
    image[..., 0] = np.linspace(40, 240, 100)
    image[..., 1] = 51
    image[..., 2] = 100
    a, b = view_of(image), view_of(np.ascontiguousarray(image[:, ::-1]))
    depth = DenseMatcher(DenseOptions(**model), context).match(a, b).depth
    for prior, view in ((depth.depth_a, a), (depth.depth_b, b)):
        assert prior.shape == (39, 64) and prior.metric
        inside = np.zeros(39, dtype=bool)
        inside[3:35] = True  # the network input crops 39 image rows to 32
        np.testing.assert_array_equal(prior.valid, np.broadcast_to(inside[:, None], (39, 64)))
        columns = (np.arange(64) + 0.5) * 100 / 64 - 0.5
        expected = np.interp(columns, np.arange(100), view.image[0, :, 0]) / 255
        np.testing.assert_allclose(prior.depth[10], expected, atol=0.006)
        np.testing.assert_allclose(prior.variance[prior.valid], (255 / 51) ** 2, rtol=1e-4)


def test_reciprocal_search_finds_what_brute_force_finds():
    rng = np.random.default_rng(0)
    a, b = (x / np.linalg.norm(x, axis=1, keepdims=True) for x in rng.normal(size=(2, 300, 8)))
    similarity = a @ b.T
    there, back = similarity.argmax(axis=1), similarity.argmax(axis=0)
    expected = [(i, there[i]) for i in range(300) if back[there[i]] == i]
    np.testing.assert_array_equal(find_reciprocal(a, b, np.arange(300)), expected)
    np.testing.assert_array_equal(find_mutual(similarity), expected)
    np.testing.assert_array_equal(find_nearest(a, b), there)
    some = find_reciprocal(a, b, np.arange(0, 300, 7))
    assert 0 < len(some) < len(expected) and set(map(tuple, some)) <= set(map(tuple, expected))
    assert find_mutual(np.empty((0, 5))).shape == (0, 2)


def test_model_with_other_tensors_raises(write_onnx, context):
    text = "one (float[1,3,h,w] image) => (float[1,3,h,w] out) { out = Identity (image) }"
    with pytest.raises(ConfigError, match="MASt3R needs inputs"):
        DenseMatcher(DenseOptions(model=str(write_onnx(text))), context)


def test_calibration_of_its_depth_is_the_references():
    calibration = Registry.discover().calibration("depth", ProviderConfig(use="matcher"))
    assert calibration == DepthCalibration(std_scale=0.862, relative_std=0, std_floor=0.02)
