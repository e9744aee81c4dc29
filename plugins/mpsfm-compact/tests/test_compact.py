"""Accuracy of the shipped network on the sample scene, which is not in its training data."""

from __future__ import annotations

from dataclasses import replace
from importlib.metadata import distribution
from pathlib import Path

import cv2
import numpy as np
import pytest
from mpsfm_compact.options import CameraOptions, CompactOptions
from mpsfm_compact.provider import CompactCamera, CompactDepth, CompactMask, CompactNormals

from mpsfm_core import PinholeCamera, ProviderContext, View
from mpsfm_core.data import Float32
from mpsfm_core.geometry import angle_between_deg, resize_map
from mpsfm_core.inputs.images import load_images
from mpsfm_core.providers.registry import Registry
from mpsfm_core.providers.weights import WeightStore

SCENE = Path(__file__).parents[3] / "examples" / "sample_scene"
WEIGHTS = Path(__file__).parents[1] / "mpsfm_compact" / "compact.onnx"


@pytest.fixture(scope="module")
def views() -> list[View]:
    images = load_images(SCENE / "images", SCENE / "intrinsics.yaml")
    return [images.view(index) for index in range(len(images))]


@pytest.fixture(scope="module")
def context() -> ProviderContext:
    return ProviderContext(resolve_weights=WeightStore(offline=True).resolve)


def true_depth(view: View) -> Float32:
    stored = cv2.imread(str(SCENE / "gt_depth" / f"{Path(view.name).stem}.png"), -1)
    return stored.astype(np.float32) / 1000


def true_normals(view: View) -> Float32:
    stored = cv2.imread(str(SCENE / "gt_normals" / f"{Path(view.name).stem}.png"))[..., ::-1]
    return stored.astype(np.float32) / 127.5 - 1


def test_weights_are_small() -> None:
    assert WEIGHTS.stat().st_size < 10e6
    assert distribution("mpsfm-compact").metadata["License-Expression"] == "Apache-2.0"


def test_depth_normals_and_their_std(views: list[View], context: ProviderContext) -> None:
    """Check the accuracy and the coverage of predicted depth and normals."""
    provider = CompactDepth(CompactOptions(), context)
    registry = Registry.discover()
    calibrations = {k: registry.spec(k, "compact").calibration for k in ("depth", "normals")}
    errors, stds, angles, inside = [], [], [], []
    for view in views:
        depth, normals = provider.predict_joint(view)
        calibrated = calibrations["depth"].apply(depth)
        size = depth.depth.shape[::-1]
        truth = cv2.resize(true_depth(view), size, interpolation=cv2.INTER_NEAREST)
        known = (truth > 0) & depth.valid
        residual = np.log(depth.depth[known] / truth[known])
        residual -= np.median(residual)
        errors.append(np.abs(residual))
        stds.append(np.sqrt(calibrated.variance[known]) / depth.depth[known])
        wanted = cv2.resize(true_normals(view), size, interpolation=cv2.INTER_NEAREST)
        seen = (np.linalg.norm(wanted, axis=-1) > 0.9) & normals.valid
        angles.append(angle_between_deg(normals.normals[seen], wanted[seen]))
        assert calibrations["normals"].apply(normals).variance[seen].min() > 0
        inside.append(np.mean(errors[-1] < stds[-1]))
    assert np.mean(np.concatenate(errors)) < 0.2
    assert np.median(np.concatenate(angles)) < 25
    assert 0.5 < np.mean(inside) < 0.95
    assert np.std(np.concatenate(stds)) > 0.01  # the predicted std varies between pixels


def test_separate_normals_and_mask_equal_joint_prediction(
    views: list[View], context: ProviderContext
) -> None:
    """Check that the separate normals and mask providers agree with the joint depth provider."""
    options = CompactOptions()
    depth, normals = CompactDepth(options, context).predict_joint(views[0])
    alone = CompactNormals(options, context).predict(views[0])
    np.testing.assert_array_equal(alone.normals, normals.normals)
    mask = CompactMask(options, context).mask(views[0])
    assert mask.shape == views[0].image.shape[:2]
    agree = (resize_map(mask.astype(np.float32), *depth.valid.shape[::-1]) > 0.5) == depth.valid
    assert agree.mean() > 0.97


def test_depth_follows_the_focal_length(views: list[View], context: ProviderContext) -> None:
    """Check that the predicted depth of an image grows with the focal length of its camera."""
    view = views[0]
    camera = replace(view.camera, fx=1.5 * view.camera.fx, fy=1.5 * view.camera.fy)
    provider = CompactDepth(CompactOptions(), context)
    near, far = provider.predict(view), provider.predict(replace(view, camera=camera))
    both = near.valid & far.valid
    assert 1.2 < np.median(far.depth[both] / near.depth[both]) < 1.8


def test_sky_is_no_surface(context: ProviderContext) -> None:
    """Check that the mask excludes a blue gradient above textured ground."""
    rng = np.random.default_rng(0)
    image = np.empty((480, 640, 3), np.uint8)
    image[:220] = (np.array([120, 170, 240]) + np.arange(220)[:, None, None] // 4).astype(np.uint8)
    grain = cv2.resize(rng.integers(60, 140, (26, 64)).astype(np.uint8), (640, 260))
    image[220:] = grain[..., None]
    view = load_view(image)
    mask = CompactMask(CompactOptions(), context).mask(view)
    assert mask[:160].mean() < 0.1
    assert mask[300:].mean() > 0.9


def test_camera_estimates_focal_length_and_gravity_of_upright_photos(
    views: list[View], context: ProviderContext
) -> None:
    """Check the focal lengths of cropped photos against the truth, within 3 std."""
    provider = CompactCamera(CameraOptions(), context)
    for view in views[:2]:
        for part in (1.0, 0.7):
            prior = provider.calibrate(central_part(view, part))
            assert prior is not None
            error = abs(np.log(prior.focal_px / view.camera.fx))
            assert error < 3 * prior.focal_std_px / prior.focal_px
            assert error < np.log(2)
            assert 0.05 < prior.focal_std_px / prior.focal_px <= 0.3
            assert abs(prior.radial) < 0.3
            assert prior.gravity[1] > 0.5


def central_part(view: View, part: float) -> View:
    """Crop a view around the image center to a share of its sides."""
    height, width = view.image.shape[:2]
    w, h = round(part * width), round(part * height)
    x, y = (width - w) // 2, (height - h) // 2
    camera = replace(view.camera, width=w, height=h, cx=w / 2, cy=h / 2)
    return replace(view, image=view.image[y : y + h, x : x + w], camera=camera)


def load_view(image: np.ndarray) -> View:
    """Create a view of an image with a focal length of 560 pixels."""
    height, width = image.shape[:2]
    return View("made", image, PinholeCamera(width, height, 560.0, 560.0, width / 2, height / 2))
