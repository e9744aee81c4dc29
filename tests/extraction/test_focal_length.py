"""Tests of focal length estimation by the camera provider and the depth provider."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pycolmap
import pytest

from mpsfm_core.extraction.priors.focal_length import estimate_focal_lengths
from mpsfm_core.extraction.runner import extract
from mpsfm_core.inputs.images import ImageSet, load_images
from mpsfm_core.inputs.options import InputOptions
from mpsfm_core.providers import ProviderSpec
from mpsfm_core.providers.kinds.camera import CameraPrior
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


@pytest.fixture
def calibrated(world):
    """Return images whose focal lengths a camera provider estimates, given focal length and std."""

    def run(estimates, exif_px=None):
        class Calibrates:
            def __init__(self, options, context) -> None: ...

            def calibrate(self, view):
                estimate = estimates[view.name]
                return None if estimate is None else CameraPrior(*estimate)

        world.registry.add(ProviderSpec("camera", "calibrates", Calibrates), version="1")
        images = load_images(world.root / "images")
        if exif_px is not None:
            changed = [with_exif(image, exif_px) for image in images]
            images = ImageSet(changed, InputOptions())
        config = world.config(camera=ProviderConfig(use="calibrates"))
        return estimate_focal_lengths(images, config, world.registry)

    return run


def with_exif(image, focal_px):
    camera = pycolmap.Camera(image.camera.todict())
    camera.params = [focal_px, *camera.params[1:]]
    return replace(image, camera=camera, focal_source="exif")


def test_camera_provider_gives_focal_length_and_std_of_image_without_exif(calibrated) -> None:
    images = calibrated(dict.fromkeys(ESTIMATES, (140.0, 7.0)))
    assert {image.pinhole.fx for image in images} == {140.0}
    assert images[0].focal_log_std == pytest.approx(0.05)
    assert images[0].focal_source == "provider" and not images[0].focal_known


def test_scatter_of_camera_estimates_raises_std(calibrated) -> None:
    values = {"view0.png": (100.0, 1.0), "view1.png": (140.0, 1.0), "view2.png": (196.0, 1.0)}
    images = calibrated({**values, "view3.png": None})
    assert images[0].pinhole.fx == pytest.approx(140.0)
    assert images[0].focal_log_std == pytest.approx(1.4826 * np.log(1.4))


def test_camera_estimate_is_combined_with_exif_by_std(calibrated) -> None:
    images = calibrated(dict.fromkeys(ESTIMATES, (140.0, 14.0)), exif_px=140.0 * 1.1)
    assert images[0].pinhole.fx == pytest.approx(140.0 * 1.1**0.5)
    assert images[0].focal_log_std == pytest.approx(0.1 / 2**0.5)


def test_camera_estimate_that_contradicts_exif_has_larger_std(calibrated) -> None:
    images = calibrated(dict.fromkeys(ESTIMATES, (140.0, 14.0)), exif_px=280.0)
    assert images[0].focal_log_std == pytest.approx(np.log(2) / 2, rel=1e-3)


def test_failed_camera_estimate_leaves_default(calibrated) -> None:
    assert calibrated(dict.fromkeys(ESTIMATES))[0].focal_source == "default"


def test_mapping_problem_gets_std_of_camera_estimate(calibrated, world) -> None:
    images = calibrated(dict.fromkeys(ESTIMATES, (140.0, 2.8)))
    problem = extract(images, world.config(), world.registry).problem
    assert {image.focal_prior_px for image in problem.images} == {140.0}
    assert all(image.focal_log_std == pytest.approx(0.02) for image in problem.images)
