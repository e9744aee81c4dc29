"""Tests of focal length estimation by the depth provider."""

from __future__ import annotations

import pytest

from mpsfm_core.extraction.priors.focal_length import estimate_focal_lengths
from mpsfm_core.inputs.images import load_images
from mpsfm_core.providers import ProviderSpec
from mpsfm_core.providers.provider_config import ProviderConfig

ESTIMATES = {"view0.png": 150.0, "view1.png": 130.0, "view2.png": 100.0, "view3.png": None}


@pytest.fixture
def estimated(world):
    """Return images with estimated focal lengths, and the calls of the depth provider."""
    asked = []

    class Sees:
        def __init__(self, options, context) -> None: ...

        def predict(self, view): ...

        def estimate_focal(self, view):
            asked.append(view.name)
            return ESTIMATES[view.name]

    able = frozenset({"estimates-focal"})
    world.registry.add(ProviderSpec("depth", "sees", Sees, capabilities=able), version="1")

    def run(provider="sees", intrinsics=None):
        images = load_images(world.root / "images", intrinsics)
        config = world.config(depth=ProviderConfig(use=provider))
        return estimate_focal_lengths(images, config, world.registry), asked

    return run


def test_focal_length_of_camera_is_median_of_its_images(estimated) -> None:
    images, asked = estimated()
    assert sorted(asked) == sorted(ESTIMATES)
    assert [image.pinhole.fx for image in images] == [130.0] * 4
    assert all(image.focal_source == "provider" and not image.focal_known for image in images)


def test_focal_length_estimate_is_cached(estimated) -> None:
    first, _ = estimated()
    again, asked = estimated()
    assert len(asked) == 4
    assert [image.pinhole for image in again] == [image.pinhole for image in first]


def test_known_focal_lengths_are_unchanged(estimated, world) -> None:
    images, asked = estimated(intrinsics=world.root / "intrinsics.yaml")
    assert asked == [] and images[0].pinhole.fx == 140.0


def test_provider_without_focal_estimates_changes_nothing(estimated) -> None:
    images, _ = estimated("truth")
    assert images[0].focal_source == "default"


def test_failed_focal_estimate_leaves_default(estimated, monkeypatch) -> None:
    monkeypatch.setattr(f"{__name__}.ESTIMATES", dict.fromkeys(ESTIMATES))
    images, asked = estimated()
    assert len(asked) == 4 and images[0].focal_source == "default"
