"""Tests of the stages as public functions, with arrays and objects of the caller."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest

import mpsfm_core as mpsfm
from mpsfm_core.data.errors import ConfigError, ProviderError
from mpsfm_core.data.events import Event, StageFinished
from mpsfm_core.testing.synthetic.problems import make_mapping_problem
from mpsfm_core.testing.synthetic.scenes import arc_poses, room_scene

SAMPLE = Path(__file__).parents[2] / "examples" / "sample_scene"
POSES = arc_poses(4, 10.0)
NUM_PHOTOS = 4
SMALL = (
    *("inputs.max_image_size=320", "extraction.integration_size=96"),
    *("dense.enabled=false", "features.options.max_keypoints=1000"),
)


@pytest.fixture(scope="module")
def known() -> Any:
    """Return keypoints, matches, depth and poses of a synthetic room, as plain arrays."""
    camera = mpsfm.PinholeCamera(320, 240, 280.0, 280.0, 160.0, 120.0)
    return make_mapping_problem(room_scene(), camera, POSES, points_per_view=200)


@pytest.fixture(scope="module")
def photos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with the first photos of the sample scene."""
    folder = tmp_path_factory.mktemp("photos")
    for number in range(NUM_PHOTOS):
        shutil.copy(SAMPLE / "images" / f"view_{number}.jpg", folder)
    return folder


@pytest.fixture(scope="module")
def images(photos: Path) -> Any:
    return mpsfm.load_images(photos, intrinsics=SAMPLE / "intrinsics.yaml", overrides=SMALL)


@pytest.fixture(scope="module")
def features(images: Any, tmp_path_factory: pytest.TempPathFactory) -> Any:
    cache = f"runtime.cache_dir={tmp_path_factory.mktemp('cache')}"
    return mpsfm.extract_features(images, "sift", config="demo", overrides=[*SMALL, cache])


def test_arrays_without_files_become_a_colmap_model(known: Any) -> None:
    names = [image.name for image in known.images]
    problem = mpsfm.build_problem(
        cameras={image.name: image.camera for image in known.images},
        matches={(names[p.image_a], names[p.image_b]): p.matches for p in known.pairs},
        keypoints={image.name: image.keypoints for image in known.images},
        depth={image.name: (image.depth.depth, image.depth.variance) for image in known.images},
        poses=dict(zip(names, POSES, strict=True)),
    )
    result = mpsfm.run_mapper(problem, {"known_poses": "fixed"})
    model = mpsfm.to_colmap(result.reconstructions[0], problem)
    assert model.num_reg_images() == 4
    assert model.num_points3D() > 50
    assert mpsfm.evaluate(model, dict(zip(names, POSES, strict=True)))["auc"]["1"] > 99


class Ramp:
    """Depth provider of the test, which predicts a ramp and its variance."""

    def predict(self, view: mpsfm.View) -> mpsfm.DepthPrior:
        depth = np.linspace(4.0, 2.0, 24)[:, None] * np.ones((24, 32))
        return mpsfm.DepthPrior.from_arrays(depth, (0.3 * depth) ** 2)


def test_own_depth_class_in_one_call(photos: Path, tmp_path: Path) -> None:
    result = mpsfm.reconstruct(
        photos,
        cameras=mpsfm.PinholeCamera(640, 480, 540.0, 540.0, 320.0, 240.0),
        config="demo",
        depth=Ramp(),
        overrides=[*SMALL, f"runtime.cache_dir={tmp_path}"],
    )
    assert result.summary["providers"][2]["name"] == "ramp"
    assert result.model.num_reg_images() == NUM_PHOTOS
    assert not list((tmp_path / "extraction" / "depth").rglob("*.npz"))


def test_stages_in_a_row(images: Any, tmp_path: Path) -> None:
    settings: dict[str, Any] = {
        "config": "demo",
        "overrides": [*SMALL, f"runtime.cache_dir={tmp_path}"],
    }
    events: list[Event] = []
    features = mpsfm.extract_features(images, "sift", on_event=events.append, **settings)
    first = features["view_0.jpg"]
    assert first.descriptors.shape == (len(first.keypoints), 128)
    assert any(isinstance(event, StageFinished) for event in events)
    matches = mpsfm.match_images(images, features, **settings)
    assert set(matches.verified) <= set(matches.matches)
    assert set(matches.dropped) == set(matches.matches) - set(matches.verified)
    priors = mpsfm.predict_priors(images, Ramp(), **settings)
    assert priors.depth["view_0.jpg"].variance is not None
    problem = mpsfm.build_problem(images, matches, depth=priors.depth, normals=priors.normals)
    result = mpsfm.run_mapper(problem)
    largest = result.reconstructions[0]
    model = mpsfm.to_colmap(largest, problem, images)
    assert model.num_reg_images() == len(largest.images) == NUM_PHOTOS
    again = mpsfm.from_colmap(model, images)
    assert mpsfm.evaluate(again, largest)["auc"]["1"] == pytest.approx(100.0, abs=0.1)
    assert len(again.points) == model.num_points3D()


def test_own_features_and_pairs_are_matched(images: Any, features: Any, tmp_path: Path) -> None:
    settings = [f"runtime.cache_dir={tmp_path}"]
    own = {name: features[name] for name in ("view_0.jpg", "view_1.jpg")}
    matches = mpsfm.match_images(
        images, own, pairs=[("view_1.jpg", "view_0.jpg")], overrides=settings, config="demo"
    )
    assert list(matches.matches) == [("view_0.jpg", "view_1.jpg")]
    assert len(matches.verified["view_0.jpg", "view_1.jpg"]) > 15


def test_images_in_memory_give_the_views_of_their_files(images: Any) -> None:
    pixels = {name: images.view(row).image for row, name in enumerate(images.names)}
    camera = images[0].pinhole
    in_memory = mpsfm.load_images(pixels, cameras=camera)
    assert in_memory.folder is None and images.folder is not None
    assert in_memory.names == images.names
    assert in_memory[0].pinhole == camera
    np.testing.assert_array_equal(in_memory.view(3).image, images.view(3).image)
    guessed = mpsfm.load_images(pixels)
    assert guessed[0].focal_source == "default"


@pytest.mark.slow
def test_images_in_memory_are_written_next_to_the_results(images: Any, tmp_path: Path) -> None:
    pixels = {Path(n).stem: images.view(row).image for row, n in enumerate(images.names)}
    in_memory = mpsfm.load_images(pixels, cameras=images[0].pinhole)
    result = mpsfm.reconstruct(in_memory, tmp_path / "out", "demo", overrides=SMALL)
    assert result.model.num_reg_images() == NUM_PHOTOS
    exported = mpsfm.export(tmp_path / "out", "nerfstudio")
    assert exported["images"] == NUM_PHOTOS
    assert (tmp_path / "out" / "images" / "view_0.png").is_file()


def test_cancelled_run_continues_from_callback(images: Any, tmp_path: Path) -> None:
    def cancel(event: Event) -> None:
        raise mpsfm.Cancelled("stopped by the user")

    with pytest.raises(mpsfm.Cancelled, match="stopped"):
        mpsfm.extract_features(images, "sift", config="demo", on_event=cancel)


@pytest.mark.parametrize(
    ("depth", "message"),
    [
        (Ramp, "Ramp is a class; pass Ramp()"),
        (object(), "object has no method predict()"),
        ("no-such", "no depth provider 'no-such'"),
        ({"use": "flat", "options": {"scale": 1}}, "unknown key"),
    ],
)
def test_wrong_provider_argument_is_explained(images: Any, depth: Any, message: str) -> None:
    with pytest.raises((ConfigError, ProviderError)) as caught:
        mpsfm.predict_priors(images, depth, config="demo")
    assert message in str(caught.value)


def test_wrong_arrays_are_explained(known: Any) -> None:
    cameras = {image.name: image.camera for image in known.images}
    a, b = list(cameras)[:2]
    wrong: list[tuple[dict[str, Any], str]] = [
        ({"matches": {(a, "c"): np.zeros((1, 2), int)}}, "'c' is not the name of an image"),
        ({"matches": {(a, b): np.zeros((1, 2), int)}}, "give keypoints"),
        ({"matches": {(a, b): np.zeros((1, 3), int)}}, r"expected integers (m, 2)"),
        ({"matches": {}, "poses": {a: np.eye(3)}}, "expected shape (3, 4)"),
        ({"matches": {}, "normals": {a: np.ones((4, 4))}}, "expected shape (h, w, 3)"),
        ({"matches": {}, "keypoints": {a: np.ones(4)}}, "expected shape (n, 2)"),
    ]
    for arguments, message in wrong:
        with pytest.raises(mpsfm.InputError) as caught:
            mpsfm.build_problem(cameras, **arguments)
        assert message in str(caught.value)
    one_camera: Any = cameras[a]
    with pytest.raises(mpsfm.InputError, match="a camera for each image name"):
        mpsfm.build_problem(one_camera, {})


def test_features_are_built_from_arrays_of_any_type(images: Any) -> None:
    features = mpsfm.Features.from_arrays(np.ones((2, 2), np.float32), np.eye(2, dtype=np.float64))
    assert features.keypoints.dtype == np.float64 and features.descriptors.dtype == np.float32
    assert mpsfm.Features.from_arrays([[1, 2]]).descriptors.shape == (1, 0)
    tuples: Any = {images.names[0]: (features.keypoints, features.descriptors)}
    with pytest.raises(mpsfm.InputError, match=r"got tuple; use Features\.from_arrays"):
        mpsfm.match_images(images, tuples)


def test_model_without_images_has_pinhole_cameras(known: Any) -> None:
    result = mpsfm.run_mapper(known)
    model = mpsfm.to_colmap(result.reconstructions[0], known)
    assert {camera.model_name for camera in model.cameras.values()} == {"PINHOLE"}
    assert isinstance(model, pycolmap.Reconstruction)


def test_radial_distortion_reaches_the_colmap_model(known: Any) -> None:
    center, focal_px, radial = np.array([160.0, 120.0]), 280.0, -0.1
    names = [image.name for image in known.images]
    keypoints = {}
    for image in known.images:
        rays = (image.keypoints - center) / focal_px
        distorted = rays * (1 + radial * (rays**2).sum(axis=1, keepdims=True))
        keypoints[image.name] = center + focal_px * distorted
    guesses = [
        replace(image, keypoints=keypoints[image.name], focal_known=False) for image in known.images
    ]
    poses = [(pose[:, :3], pose[:, 3]) for pose in POSES]
    problem = replace(known, images=tuple(guesses)).with_poses(dict(zip(names, poses, strict=True)))
    result = mpsfm.run_mapper(problem, {"known_poses": "fixed"})
    model = mpsfm.to_colmap(result.reconstructions[0], problem)
    (camera,) = model.cameras.values()
    assert camera.model_name == "SIMPLE_RADIAL"
    np.testing.assert_allclose(camera.params, [focal_px, *center, radial], rtol=0.02)
    assert model.compute_mean_reprojection_error() < 0.5
