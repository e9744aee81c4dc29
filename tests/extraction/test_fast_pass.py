"""Tests of the fast pass and of further matches for images with few points."""

from __future__ import annotations

import numpy as np
import pytest

from mpsfm_core.config import FastPass
from mpsfm_core.data import Float64
from mpsfm_core.extraction.options import PairOptions
from mpsfm_core.extraction.runner import Extraction, extend_matches
from mpsfm_core.geometry import transform
from mpsfm_core.inputs.images import load_images
from mpsfm_core.pipeline.run import reconstruct
from mpsfm_core.providers.provider_config import ProviderConfig

TRUTH = FastPass(features=ProviderConfig(use="truth"), matcher=ProviderConfig(use="mutual-nearest"))
DENSE = {"features": None, "matcher": None, "dense_matcher": ProviderConfig(use="dense")}


def distances_to_epipolar_lines(world, extraction: Extraction, pair) -> Float64:
    """Return the epipolar errors of all matches of a pair, in normalized image coordinates."""
    names = [extraction.problem.images[index].name for index in (pair.image_a, pair.image_b)]
    a, b = (world.poses[name] for name in names)
    rotation = b[:, :3] @ a[:, :3].T
    translation = b[:, 3] - rotation @ a[:, 3]
    x, y = (
        (extraction.problem.images[index].keypoints[pair.matches[:, side]] - (80, 60)) / 140
        for side, index in enumerate((pair.image_a, pair.image_b))
    )
    lines = np.cross(translation, transform(rotation, np.zeros(3), np.c_[x, np.ones(len(x))]))
    along = (lines * np.c_[y, np.ones(len(y))]).sum(axis=1)
    return np.abs(along) / np.linalg.norm(lines[:, :2], axis=1)


def test_extend_matches_adds_matches_of_one_image(world) -> None:
    first = world.extract()
    assert world.asked() == {"features": 4, "depth": 4, "normals": 4}
    config = world.config(**DENSE)
    images = load_images(world.root / "images", world.root / "intrinsics.yaml")
    both = extend_matches(images, config, world.registry, first, {3})
    assert world.asked() == {"dense": 3}  # only pairs of the image, and no priors
    assert [len(image.keypoints) for image in both.problem.images[:3]] > [
        len(image.keypoints) for image in first.problem.images[:3]
    ]
    before = {(pair.image_a, pair.image_b): pair for pair in first.problem.pairs}
    for pair in both.problem.pairs:
        earlier = before[pair.image_a, pair.image_b]
        np.testing.assert_array_equal(pair.matches[: len(earlier)], earlier.matches)
        assert (len(pair) > len(earlier)) == (pair.image_b == 3)
        added = distances_to_epipolar_lines(world, both, pair)[len(earlier) :]
        assert (added < 1e-6).all()  # match rows index the right keypoints
    for image, earlier in zip(both.problem.images, first.problem.images, strict=True):
        assert image.depth is earlier.depth and image.normals is earlier.normals
    report = both.report
    assert report["pairs_proposed"] == 6 + 3 and report["pairs_matched"] == 6 + 3
    assert len(report["pairs"]) == report["pairs_verified"] == 6
    assert {pair["inliers"] for pair in report["pairs"]} == {len(p) for p in both.problem.pairs}
    assert [provider["kind"] for provider in report["providers"]].count("matcher") == 2


def test_extend_matches_verifies_pair_that_fast_pass_dropped(world) -> None:
    first = world.extract(matcher=ProviderConfig(use="mutual-nearest", options={"ratio": 0.001}))
    assert not first.problem.pairs
    images = load_images(world.root / "images", world.root / "intrinsics.yaml")
    both = extend_matches(images, world.config(), world.registry, first, {0})
    assert [(pair.image_a, pair.image_b) for pair in both.problem.pairs] == [(0, 1), (0, 2), (0, 3)]
    kept = [pair["images"] for pair in both.report["pairs"] if "dropped" not in pair]
    assert kept == [[world.names[0], name] for name in world.names[1:]]


def test_extend_matches_uses_number_of_partners_of_fast_pass(world) -> None:
    """The most similar image of the last image is also its neighbor in the sequence."""
    pairs = PairOptions(mode="auto", partners=2, overlap=1)
    fast_pass = TRUTH.model_copy(update={"partners": 1})
    images = load_images(world.root / "images", world.root / "intrinsics.yaml")
    first = world.extract()

    def asked(image: int, **changes: object) -> int:
        config = world.config(pairs=pairs, **changes)
        both = extend_matches(images, config, world.registry, first, {image})
        return both.report["pairs_proposed"] - first.report["pairs_proposed"]

    assert asked(3) == 2
    assert asked(3, fast_pass=fast_pass) == 1


@pytest.mark.parametrize(("fast_pass", "asked"), [(TRUTH, 0), ("weak", 6)])
def test_constrained_images_are_not_matched_again(world, fast_pass, asked: int) -> None:
    if fast_pass == "weak":
        sift = ProviderConfig(use="sift", options={"max_keypoints": 5})
        fast_pass = TRUTH.model_copy(update={"features": sift})
    config = world.config(**DENSE, fast_pass=fast_pass)
    result = reconstruct(
        world.root / "images",
        config=config,
        intrinsics=world.root / "intrinsics.yaml",
        registry=world.registry,
    )
    assert len(result.summary["images"]["registered"]) == 4
    assert world.asked()["dense"] == asked
    blocks = [provider["block"] for provider in result.summary["providers"]]
    assert blocks == [
        "fast_pass.features",
        "fast_pass.matcher",
        "dense_matcher",
        "depth",
        "normals",
    ]


def test_same_features_in_both_passes_skip_second_pass(world) -> None:
    """Without networks, both passes use SIFT."""
    assert not world.config(fast_pass=TRUTH).has_second_pass
    assert world.config(**DENSE, fast_pass=TRUTH).has_second_pass
    assert not world.config().has_second_pass
