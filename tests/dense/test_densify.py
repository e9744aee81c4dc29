"""Tests of densification on a rendered room and on difficult images."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from mpsfm_core.data import DepthPrior, View
from mpsfm_core.data.errors import OutputError
from mpsfm_core.dense.dense_view import DenseView
from mpsfm_core.dense.densify import densify
from mpsfm_core.dense.fusion import fuse_depth_maps
from mpsfm_core.dense.options import DenseOptions
from mpsfm_core.dense.stereo import StereoDepth
from mpsfm_core.extraction.cache import Cache
from mpsfm_core.geometry import project, transform
from mpsfm_core.pipeline.checkpoints import DenseCheckpoints
from mpsfm_core.support.disk_arrays import store_on_disk

OPTIONS = DenseOptions(correlation_px=20)


def changed(room, change: Callable[[int, np.ndarray], np.ndarray]) -> Callable[[str], View]:
    """Return a loader of views with changed pixels."""

    def view_of(name: str) -> View:
        view = room.views[name]
        return replace(view, image=change(int(name[0]), view.image))

    return view_of


def test_densify_improves_depth_of_overlapping_views(room) -> None:
    dense, report = densify(room.reconstruction, room.views.__getitem__, OPTIONS)
    before, after = room.errors(room.reconstruction), room.errors(dense)
    for name, error in after.items():
        assert np.median(error) < 0.01 < 0.03 < np.median(before[name])
        assert error.mean() < 0.35 * before[name].mean()
        assert report.confirmed[name] > 0.6 and name not in report.sources[name]


def test_densify_std_is_calibrated(room) -> None:
    dense, _ = densify(room.reconstruction, room.views.__getitem__, OPTIONS)
    error = np.concatenate([e.ravel() for e in room.errors(dense).values()])
    depths = [image.depth for image in dense.images]
    std = np.concatenate([(np.sqrt(d.variance) / d.depth).ravel() for d in depths])
    assert 0.55 < (error < std).mean() < 0.9
    certain = std < np.median(std)
    assert error[certain].mean() < error[~certain].mean()


def test_densify_keeps_sensor_depth_and_fills_holes(room) -> None:
    images, holes = [], {}
    for number, image in enumerate(room.reconstruction.images):
        depth = room.truth[image.name]
        hole = np.zeros(depth.shape, np.bool_)
        hole[30:90, 50 + 5 * number : 110 + 5 * number] = True
        hole |= np.random.default_rng(number).random(depth.shape) < 0.1
        known = DepthPrior.from_arrays(depth, (0.01 * depth) ** 2, ~hole)
        images.append(replace(image, depth=known))
        holes[image.name] = hole
    sensor = replace(room.reconstruction, images=tuple(images))
    dense, report = densify(sensor, room.views.__getitem__, OPTIONS)
    for name, error in room.errors(dense).items():
        hole = holes[name]
        assert error[~hole].mean() < 0.003
        assert np.median(error[hole & report.measured[name]]) < 0.01
        assert error[hole].mean() < 0.1


def test_densify_poses_from_depth_add_scale_variance(room) -> None:
    # A correlation length of the map's size excludes shared pixels, so only known depth constrains
    # the scales of pairs.
    loose = OPTIONS.model_copy(update={"correlation_px": 1000.0})
    tied, _ = densify(room.reconstruction, room.views.__getitem__, loose)
    fixed, _ = densify(room.reconstruction, room.views.__getitem__, loose, poses_use_depth=False)
    for a, b in zip(tied.images, fixed.images, strict=True):
        np.testing.assert_array_equal(a.depth.depth, b.depth.depth)
        added = (a.depth.variance - b.depth.variance) / a.depth.depth**2
        # The scale error is constant over the image.
        np.testing.assert_allclose(added, added.mean(), rtol=1e-2)
        assert 0.003 < added.mean() ** 0.5 < 0.1


def test_densify_is_independent_of_threads(room) -> None:
    one, _ = densify(room.reconstruction, room.views.__getitem__, OPTIONS, workers=1)
    two, _ = densify(room.reconstruction, room.views.__getitem__, OPTIONS, workers=2)
    for a, b in zip(one.images, two.images, strict=True):
        np.testing.assert_array_equal(a.depth.depth, b.depth.depth)


def test_densify_with_arrays_on_disk_is_identical(room, tmp_path: Path) -> None:
    there, report = densify(room.reconstruction, room.views.__getitem__, OPTIONS)
    with store_on_disk(tmp_path, in_memory=0):
        here, same = densify(room.reconstruction, room.views.__getitem__, OPTIONS)
    for a, b in zip(there.images, here.images, strict=True):
        np.testing.assert_array_equal(a.depth.depth, b.depth.depth)
        np.testing.assert_array_equal(a.depth.variance, b.depth.variance)
        np.testing.assert_array_equal(report.measured[a.name], same.measured[a.name])


def test_densify_unrelated_images_measure_nothing(room) -> None:
    def unrelated(index: int, image: np.ndarray) -> np.ndarray:
        noise = np.random.default_rng(index).random(image.shape[:2]).astype(np.float32)
        grey = cv2.normalize(cv2.GaussianBlur(noise, (0, 0), 2), None, 0, 255, cv2.NORM_MINMAX)
        return np.repeat(grey[:, :, None], 3, axis=2).astype(np.uint8)

    dense, report = densify(room.reconstruction, changed(room, unrelated), OPTIONS)
    for image, before in zip(dense.images, room.reconstruction.images, strict=True):
        assert report.confirmed[image.name] == 0 and not report.measured[image.name].any()
        np.testing.assert_allclose(image.depth.depth, before.depth.depth, rtol=1e-5)


def test_densify_pixels_without_match_have_unknown_std(room) -> None:
    noise = np.random.default_rng(0).integers(0, 256, (60, 60, 3), np.uint8)

    def covered(index: int, image: np.ndarray) -> np.ndarray:
        image = image.copy()
        if index == 0:
            image[40:100, 50:110] = noise
        return image

    dense, _ = densify(room.reconstruction, changed(room, covered), OPTIONS)
    image = dense.images[0]
    depth = image.depth
    log_std = np.sqrt(depth.variance) / depth.depth
    assert np.median(log_std[50:90, 60:100]) > 0.99
    assert np.median(log_std[:, :40]) < 0.1
    points = fuse_depth_maps(replace(dense, images=dense.images[:1]), room.views.__getitem__).points
    xy = project(image.camera, transform(image.rotation, image.translation, points))
    in_noise = (np.abs(xy - (80, 70)) < 20).all(axis=1)
    assert len(points) > 5000 and in_noise.mean() < 0.02


def test_densify_is_invariant_to_exposure(room) -> None:
    def exposed(index: int, image: np.ndarray) -> np.ndarray:
        return np.clip(image * (0.6 + 0.2 * index) + 8 * index, 0, 255).astype(np.uint8)

    dense, _ = densify(room.reconstruction, changed(room, exposed), OPTIONS)
    assert max(np.median(error) for error in room.errors(dense).values()) < 0.01


@pytest.mark.parametrize("value", [0, 255])
def test_densify_blank_images_keep_depth(room, value: int) -> None:
    blank = changed(room, lambda _, image: np.full_like(image, value))
    dense, _ = densify(room.reconstruction, blank, OPTIONS)
    before, after = room.errors(room.reconstruction), room.errors(dense)
    for name in before:
        assert after[name].mean() < 1.1 * before[name].mean()


def test_densify_without_overlap_keeps_depth(room) -> None:
    first = room.reconstruction.images[0]
    away = replace(first, name="1.png", translation=first.translation + 100)
    for images in ((first,), (first, away)):
        alone = replace(room.reconstruction, images=images)
        dense, report = densify(alone, room.views.__getitem__, OPTIONS)
        assert dense.images[0].depth is first.depth
        assert report.confirmed["0.png"] == 0 and not report.sources["0.png"]


def test_densify_ignores_unconfirmed_pose(room) -> None:
    images = list(room.reconstruction.images)
    images[1] = replace(images[1], confirmed=False)
    guessed = replace(room.reconstruction, images=tuple(images))
    dense, report = densify(guessed, room.views.__getitem__, OPTIONS)
    assert dense.images[1].depth is images[1].depth
    assert all("1.png" not in sources for sources in report.sources.values())


class FailingCheckpoints:
    """Checkpoint store that interrupts densification at the third image."""

    def __init__(self, kept: DenseCheckpoints) -> None:
        self.kept, self.loaded, self.saved = kept, 0, 0

    def load(self, name: str) -> StereoDepth | None:
        found = self.kept.load(name)
        self.loaded += found is not None
        return found

    def save(self, name: str, depth: StereoDepth) -> None:
        self.saved += 1
        if self.saved >= 3:
            raise KeyboardInterrupt
        self.kept.save(name, depth)


def test_densify_resumes_from_checkpoints(room, tmp_path: Path) -> None:
    def checkpoints(photos: list[str]) -> DenseCheckpoints:
        return DenseCheckpoints(tmp_path, room.reconstruction, photos, OPTIONS)

    whole, _ = densify(room.reconstruction, room.views.__getitem__, OPTIONS)
    keys = list(room.views)
    with pytest.raises(KeyboardInterrupt):
        densify(
            room.reconstruction,
            room.views.__getitem__,
            OPTIONS,
            workers=1,
            checkpoints=FailingCheckpoints(checkpoints(keys)),
        )
    second = FailingCheckpoints(checkpoints(keys))
    again, _ = densify(
        room.reconstruction, room.views.__getitem__, OPTIONS, workers=1, checkpoints=second
    )
    assert second.loaded == 2
    for a, b in zip(whole.images, again.images, strict=True):
        np.testing.assert_array_equal(a.depth.depth, b.depth.depth)
        np.testing.assert_array_equal(a.depth.variance, b.depth.variance)
    assert checkpoints(keys).load(keys[0]) is not None
    assert checkpoints([*keys[1:], "another photo"]).load(keys[0]) is None
    checkpoints(keys).forget()
    assert not list(tmp_path.rglob("*.npz"))


def test_densify_with_full_disk_finishes(
    room, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def full(*_: object) -> None:
        raise OutputError("cannot write to the cache: the disk is full")

    kept = DenseCheckpoints(tmp_path, room.reconstruction, list(room.views), OPTIONS)
    monkeypatch.setattr(Cache, "store", full)
    dense, _ = densify(room.reconstruction, room.views.__getitem__, OPTIONS, checkpoints=kept)
    assert all(image.depth is not None for image in dense.images)
    assert caplog.text.count("no checkpoints from now on") == 1
    assert "the disk is full" in caplog.text


def test_dense_view_does_not_interpolate_across_depth_edge(room) -> None:
    """The coarse depth map has an edge much larger than its std."""
    image, size = room.reconstruction.images[0], 16
    depth = np.where(np.arange(size) < size // 2, 2.0, 4.0) * np.ones((size, 1))
    known = DepthPrior.from_arrays(depth, (0.01 * depth) ** 2)
    view = DenseView.from_view(
        replace(image, depth=known), room.views[image.name], OPTIONS.max_size
    )
    assert view.log_depth.shape[1] >= 2 * size
    np.testing.assert_allclose(np.unique(np.exp(view.log_depth)), [2, 4], rtol=1e-6)
    unsure = replace(image, depth=DepthPrior.from_arrays(depth, depth**2))
    view = DenseView.from_view(unsure, room.views[image.name], OPTIONS.max_size)
    assert len(np.unique(view.log_depth)) > 2
