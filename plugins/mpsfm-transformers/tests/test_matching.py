"""Comparison of features and matchers with transformers' own models of equal weights."""

from __future__ import annotations

import numpy as np
import pytest
import torch
import transformers as hf
from mpsfm_transformers import stand_in
from mpsfm_transformers.features import SuperPointFeatures
from mpsfm_transformers.grid import gray_image
from mpsfm_transformers.hub import quiet
from mpsfm_transformers.loftr import EfficientLoftrMatcher
from mpsfm_transformers.options import (
    EfficientLoftrOptions,
    LightGlueOptions,
    SuperGlueOptions,
    SuperPointOptions,
)
from mpsfm_transformers.sparse import LightGlueMatcher, SuperGlueMatcher

from mpsfm_core import Features, View
from mpsfm_core.data.errors import ProviderError

MATCHERS = {
    "lightglue": (LightGlueMatcher, LightGlueOptions, hf.LightGlueForKeypointMatching),
    "superglue": (SuperGlueMatcher, SuperGlueOptions, hf.SuperGlueForKeypointMatching),
}


@pytest.fixture
def superpoint(tmp_path, context):
    folder = stand_in.superpoint(tmp_path / "superpoint")
    return folder, SuperPointFeatures(SuperPointOptions(model=str(folder)), context)


def test_superpoint_finds_what_the_library_finds(superpoint, blocks, view_of):
    folder, provider = superpoint
    view = view_of(blocks)
    with quiet(), torch.inference_mode():
        network = hf.SuperPointForKeypointDetection.from_pretrained(folder).eval()
        found = network(gray_image(view, view.camera.size, "cpu"))
    features = provider.extract(view)
    order = np.argsort(-found.scores[0].numpy(), kind="stable")
    expected = found.keypoints[0].numpy()[order] * view.camera.size + 0.5
    assert len(features) > 50
    np.testing.assert_allclose(features.keypoints, expected, atol=1e-3)
    np.testing.assert_allclose(features.descriptors, found.descriptors[0][order], rtol=1e-5)
    assert (features.keypoints % 1 == 0.5).all()


def test_superpoint_with_a_mask_and_a_limit(superpoint, tmp_path, context, blocks, view_of):
    folder, provider = superpoint
    view = view_of(blocks)
    mask = np.zeros(blocks.shape[:2], dtype=bool)
    mask[:, 128:] = True
    masked = View(view.name, view.image, view.camera, mask)
    assert (provider.extract(masked).keypoints[:, 0] > 128).all()
    few = SuperPointFeatures(SuperPointOptions(model=str(folder), max_keypoints=20), context)
    assert len(few.extract(masked)) == 20
    best = provider.extract(masked).keypoints[:20]
    np.testing.assert_array_equal(few.extract(masked).keypoints, best)


@pytest.mark.parametrize("name", MATCHERS)
def test_given_keypoints_match_as_detected_ones(name, context, tmp_path, blocks, view_of):
    """Check that given keypoints have the same matches as in the joint pass of transformers."""
    factory, options, family = MATCHERS[name]
    folder = getattr(stand_in, name)(tmp_path / name)
    views = view_of(blocks), view_of(np.roll(blocks, 24, axis=1))
    with quiet(), torch.inference_mode():
        network = family.from_pretrained(folder).eval()
        pixels = [gray_image(view, view.camera.size, "cpu") for view in views]
        found = network(torch.stack(pixels, dim=1))
        detected = network.keypoint_detector(torch.cat(pixels))
    given = []
    for side in (0, 1):
        count = int(detected.mask[side].sum())
        xy = detected.keypoints[side, :count].double().numpy() * views[side].camera.size
        given.append(
            Features(
                xy + 0.5,
                detected.descriptors[side, :count].numpy(),
                detected.scores[side, :count].numpy(),
            )
        )
    matches = factory(options(model=str(folder)), context).match(*views, *given).sparse
    partners = found.matches.reshape(2, -1)[0, : len(given[0])].numpy()
    rows = np.flatnonzero(partners >= 0)
    assert len(rows) >= 3
    order = np.argsort(matches.indices[:, 0])
    np.testing.assert_array_equal(matches.indices[order, 0], rows)
    np.testing.assert_array_equal(matches.indices[order, 1], partners[rows])
    expected = found.matching_scores.reshape(2, -1)[0, rows].clamp(0, 1)
    np.testing.assert_allclose(matches.scores[order], expected, rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("name", MATCHERS)
def test_size_of_a_view_does_not_matter(name, context, tmp_path, view_of, blocks):
    """Check that enlarging a view and its keypoints does not change the matches."""
    factory, options, _ = MATCHERS[name]
    matcher = factory(options(model=str(getattr(stand_in, name)(tmp_path / name))), context)
    rng = np.random.default_rng(1)
    features = [
        Features(
            rng.uniform(10, 180, (40, 2)),
            rng.normal(size=(40, 32)).astype(np.float32),
            rng.uniform(size=40).astype(np.float32),
        )
        for _ in range(2)
    ]
    view = view_of(blocks)
    double = view_of(blocks.repeat(2, axis=0).repeat(2, axis=1))
    xy = (features[1].keypoints - 0.5) * 2 + 0.5
    moved = Features(xy, features[1].descriptors, features[1].scores)
    one = matcher.match(view, view, *features).sparse
    two = matcher.match(view, double, features[0], moved).sparse
    np.testing.assert_array_equal(one.indices, two.indices)


@pytest.mark.parametrize("name", MATCHERS)
def test_features_of_another_family(name, context, tmp_path, view_of, blocks):
    factory, options, _ = MATCHERS[name]
    matcher = factory(options(model=str(getattr(stand_in, name)(tmp_path / name))), context)
    features = Features(np.ones((2, 2)), np.ones((2, 64), dtype=np.float32))
    view = view_of(blocks)
    with pytest.raises(ProviderError, match="64 dimensions, this matcher needs 32"):
        matcher.match(view, view, features, features)


def test_efficient_loftr_where_matches_cross(context, tmp_path, blocks, view_of):
    """Check images with exchanged halves, whose matches transformers pairs incorrectly."""
    folder = stand_in.efficient_loftr(tmp_path / "loftr")
    matcher = EfficientLoftrMatcher(EfficientLoftrOptions(model=str(folder)), context)
    swapped = np.concatenate([blocks[:, 128:], blocks[:, :128]], axis=1)
    dense = matcher.match(view_of(blocks), view_of(swapped)).dense
    flow = dense.points_b - dense.points_a
    right = np.where(dense.points_a[:, 0] < 128, 128, -128)
    error = np.hypot(flow[:, 0] - right, flow[:, 1])
    assert len(dense) > 40
    assert np.percentile(error, 90) < 0.5


def test_efficient_loftr_of_different_sizes(context, tmp_path, blocks, view_of):
    """Check that match positions are in pixels of each view, not of the common input size."""
    folder = stand_in.efficient_loftr(tmp_path / "loftr")
    matcher = EfficientLoftrMatcher(EfficientLoftrOptions(model=str(folder)), context)
    dense = matcher.match(view_of(blocks), view_of(blocks[:, :192])).dense
    assert len(dense) > 20
    assert np.median(np.linalg.norm(dense.points_b - dense.points_a, axis=1)) < 0.5
    assert dense.points_b[:, 0].max() < 192
