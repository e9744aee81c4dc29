"""Tests that select the source views of multi-view stereo."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mpsfm_core.data import DepthPrior
from mpsfm_core.dense.view_selection import select_source_views
from mpsfm_core.mapping.scene.reconstruction import RegisteredImage
from mpsfm_core.support.threads import limit_threads
from mpsfm_core.testing.synthetic import halls

SOURCES = 6
DISTANCE = 500.0
"""Distance in meters between two copies of a hall."""


@pytest.fixture(scope="module")
def hall() -> list[RegisteredImage]:
    """Return 36 posed views of a hall, whose depth maps have a std of 2 %."""
    poses, scene = halls.make_hall(36, np.random.default_rng(0))
    grid = halls.CAMERA.resized(64, 48)
    images = []
    for index, pose in enumerate(poses):
        depth = scene.render(grid, pose).depth.astype(np.float32)
        prior = DepthPrior.from_arrays(depth, (0.02 * depth) ** 2)
        rotation, translation = pose[:, :3], pose[:, 3]
        no_points = np.full(0, -1)
        images.append(
            RegisteredImage(
                index, f"{index}", halls.CAMERA, rotation, translation, no_points, prior, 1.0
            )
        )
    return images


def test_select_source_views_distant_views_change_nothing(hall) -> None:
    shift = np.array([DISTANCE, 0.0, 0.0])
    distant = [replace(im, translation=im.translation - im.rotation @ shift) for im in hall]
    alone, together = (select_source_views(images, SOURCES) for images in (hall, hall + distant))
    assert together[: len(hall)] == alone
    assert together[len(hall) :] == [[len(hall) + view for view in views] for views in alone]
    assert np.mean([len(views) for views in alone]) > SOURCES - 1


def test_select_source_views_opposite_views_are_not_selected(hall) -> None:
    turn = np.diag([-1.0, 1.0, -1.0])  # The camera looks back from the same position.
    back = [
        replace(im, rotation=turn @ im.rotation, translation=turn @ im.translation) for im in hall
    ]
    for image, opposite in zip(hall, back, strict=True):
        assert select_source_views([image, opposite], SOURCES) == [[], []]


def test_select_source_views_occluded_views_are_not_selected(hall) -> None:
    """A camera that only sees a wall in front of it is no source view of other cameras."""
    walled = []
    for image in hall[::2]:
        depth = np.full_like(image.depth.depth, 0.05)
        walled.append(replace(image, depth=DepthPrior.from_arrays(depth, (0.02 * depth) ** 2)))
    selected = select_source_views([*hall[1::2], *walled], SOURCES)
    sources = {source for views in selected[: len(walled)] for source in views}
    assert sources and max(sources) < len(walled)


def test_select_source_views_number_of_threads_changes_nothing(hall) -> None:
    with limit_threads(1):
        one = select_source_views(hall, SOURCES)
    with limit_threads(3):
        assert select_source_views(hall, SOURCES) == one
