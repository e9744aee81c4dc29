"""Focal lengths by the depth provider, for photos that do not tell them."""

from __future__ import annotations

import pytest

from mpsfm_core.extraction.priors.focal_length import estimate_focal_lengths
from mpsfm_core.inputs.images import load_images
from mpsfm_core.providers import ProviderSpec
from mpsfm_core.providers.provider_config import ProviderConfig

ESTIMATES = {"view0.png": 150.0, "view1.png": 130.0, "view2.png": 100.0, "view3.png": None}


@pytest.fixture
def estimated(world):
    """The images with estimated focal lengths, and how often the provider was asked."""
    asked = []

    class Sees:
        def __init__(self, options, context) -> None: ...

        def predict(self, view): ...

        def estimate_focal(self, view):
            asked.append(view.name)
            return ESTIMATES[view.name]

    able = frozenset({"estimates-focal"})
    world.registry.add(ProviderSpec("depth", "sees", Sees, capabilities=able))

    def run(provider="sees", intrinsics=None):
        images = load_images(world.root / "images", intrinsics)
        config = world.config(depth=ProviderConfig(use=provider))
        return estimate_focal_lengths(images, config, world.registry), asked

    return run


def test_images_of_one_camera_get_the_median(estimated) -> None:
    images, asked = estimated()
    assert sorted(asked) == sorted(ESTIMATES)
    assert [image.pinhole.fx for image in images] == [130.0] * 4
    assert all(image.focal_source == "provider" and not image.focal_known for image in images)


def test_it_is_asked_once_for_a_photo(estimated) -> None:
    first, _ = estimated()
    again, asked = estimated()
    assert len(asked) == 4
    assert [image.pinhole for image in again] == [image.pinhole for image in first]


def test_known_focal_lengths_stay(estimated, world) -> None:
    images, asked = estimated(intrinsics=world.root / "intrinsics.yaml")
    assert asked == [] and images[0].pinhole.fx == 140.0


def test_a_provider_that_cannot_tell_changes_nothing(estimated) -> None:
    images, _ = estimated("truth")
    assert images[0].focal_source == "default"


def test_where_it_cannot_tell_the_default_stays(estimated, monkeypatch) -> None:
    monkeypatch.setattr(f"{__name__}.ESTIMATES", dict.fromkeys(ESTIMATES))
    images, asked = estimated()
    assert len(asked) == 4 and images[0].focal_source == "default"
