"""Accuracy of matches between real and rendered images with known cameras."""

from __future__ import annotations

import numpy as np
import pytest

from mpsfm_core.providers.builtin.mutual_nearest import MutualNearest
from mpsfm_core.providers.builtin.options import MutualNearestOptions

FAMILIES = {"xfeat": "lighterglue", "aliked": "lightglue-aliked", "disk": "lightglue-disk"}


@pytest.mark.parametrize(
    ("family", "matches", "median_px"),
    [
        ("xfeat", 550, 0.8),
        pytest.param("aliked", 1000, 0.4, marks=pytest.mark.slow),
        pytest.param("disk", 900, 0.6, marks=pytest.mark.slow),
    ],
)
def test_fountain(make, load_pair, family, matches, median_px):
    pair = load_pair("fountain", "0003.jpg", "0005.jpg")
    found, xy = match(make, pair, family)
    assert len(found) > matches
    assert np.median(pair.epipolar_distance(*xy)) < median_px


@pytest.mark.parametrize("family", ["xfeat", pytest.param("aliked", marks=pytest.mark.slow)])
def test_rendered_kitchen(make, load_pair, family):
    pair = load_pair("rendered_kitchen", "view_028.jpg", "view_029.jpg")
    found, xy = match(make, pair, family)
    assert len(found) > 350
    assert np.median(pair.epipolar_distance(*xy)) < 0.8


@pytest.mark.parametrize("name", ["mutual-nearest", "adalam"])
def test_sift_of_kornia_on_the_fountain(make, load_pair, context, name):
    """Check the number of SIFT matches and their median epipolar error (0.28 and 0.33 px)."""
    pair = load_pair("fountain", "0003.jpg", "0005.jpg")
    detector = make("features", "kornia-sift")
    nearest = MutualNearest(MutualNearestOptions(), context)
    matcher = nearest if name == "mutual-nearest" else make("matcher", name)
    found, xy = match_with(detector, matcher, pair)
    assert len(found) > 350
    assert np.median(pair.epipolar_distance(*xy)) < 0.45


def match(make, pair, family):
    return match_with(make("features", family), make("matcher", FAMILIES[family]), pair)


def match_with(detector, matcher, pair):
    a, b = detector.extract(pair.view_a), detector.extract(pair.view_b)
    found = matcher.match(pair.view_a, pair.view_b, a, b).sparse
    return found, (a.keypoints[found.indices[:, 0]], b.keypoints[found.indices[:, 1]])
