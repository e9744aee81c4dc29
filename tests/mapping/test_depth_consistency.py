"""The depth check: carried depth and variance, what counts as a contradiction, twin rooms."""

from __future__ import annotations

import numpy as np
import pytest

from mpsfm_core.data import (
    DepthPrior,
    Float32,
    Float64,
    MappingImage,
    MappingProblem,
    NormalPrior,
    PinholeCamera,
)
from mpsfm_core.geometry import pixel_centers, project, unproject
from mpsfm_core.mapping.depth_consistency import (
    check_image,
    conflicting_images,
    contradiction,
    overlapping_views,
    warp_depth,
)
from mpsfm_core.mapping.options import ConsistencyOptions
from mpsfm_core.scene.scene import Scene
from mpsfm_core.testing.symmetric import CAMERA, moved, twin_room_poses, twin_rooms

OPTIONS = ConsistencyOptions()
SMALL = PinholeCamera(40, 30, 40.0, 40.0, 20.0, 15.0)
PARAMS = np.array(SMALL.params)


def posed_scene(
    maps: list[Float32], poses: list[Float64], camera: PinholeCamera, std: float = 0.01
) -> Scene:
    """Registered views with given depth and no keypoints."""
    images = []
    for number, depth in enumerate(maps):
        normals = np.zeros((*depth.shape, 3), np.float32)
        normals[..., 2] = -1
        images.append(
            MappingImage(
                f"{number}.png",
                camera,
                np.zeros((0, 2)),
                DepthPrior.from_arrays(depth, (std * depth) ** 2),
                NormalPrior.from_arrays(normals, np.full(depth.shape, 0.01, np.float32)),
            )
        )
    scene = Scene(MappingProblem(tuple(images), ()))
    for number, pose in enumerate(poses):
        scene.register(number, pose[:, :3], pose[:, 3])
        scene.maps[number].set_scale(1.0)
    return scene


def wall(depth: float) -> Float32:
    return np.full((30, 40), depth, np.float32)


HERE = np.eye(3, 4)


@pytest.mark.parametrize("reverse", [False, True])
def test_the_nearest_surface_of_a_pixel_is_kept(reverse: bool) -> None:
    """Seen from 6 m further back many pixels share one, in whatever order they come."""
    depth = np.random.default_rng(0).uniform(2, 6, (30, 40)).astype(np.float32)
    depth[0] = np.sort(depth[0])[:: -1 if reverse else 1]
    valid = np.ones(depth.shape, np.bool_)
    back = np.array([0.0, 0.0, 6.0])
    carried, _ = warp_depth(depth, 0 * depth, valid, PARAMS, np.eye(3), back, PARAMS, depth.shape)
    points = unproject(SMALL, pixel_centers(40, 30), depth).reshape(-1, 3) + back
    column, row = np.floor(project(SMALL, points)).astype(np.int64).T
    expected = np.full(depth.shape, np.inf)
    np.minimum.at(expected, (row, column), points[:, 2])
    assert np.isfinite(carried).sum() < depth.size / 2
    np.testing.assert_allclose(carried, expected)


def test_invalid_pixels_are_not_carried() -> None:
    valid = np.zeros((30, 40), np.bool_)
    valid[10, 12] = True
    carried, _ = warp_depth(
        wall(2.0), wall(0.1), valid, PARAMS, np.eye(3), np.zeros(3), PARAMS, (30, 40)
    )
    assert np.argwhere(np.isfinite(carried)).tolist() == [[10, 12]]


def test_the_variance_is_that_of_samples() -> None:
    """Depth with 3 % and the pixel's position with 1 px of noise, carried through a rotation."""
    rng = np.random.default_rng(0)
    angle = np.radians(35.0)
    rotation = np.array(
        [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
    )
    translation = np.array([-1.0, 0.1, 0.6])
    depth, valid = wall(3.0), np.zeros((30, 40), np.bool_)
    valid[14, 16] = True
    variance = np.full(depth.shape, (0.03 * 3.0) ** 2, np.float32)
    carried, spread = warp_depth(
        depth, variance, valid, PARAMS, rotation, translation, PARAMS, (30, 40)
    )
    seen = np.isfinite(carried)
    assert seen.sum() == 1
    pixel = np.array([16.5, 14.5]) + rng.normal(size=(200_000, 2))
    rays = np.column_stack([(pixel - PARAMS[2:]) / PARAMS[:2], np.ones(len(pixel))])
    z = 3.0 * (1 + 0.03 * rng.normal(size=len(pixel))) * (rays @ rotation[2]) + translation[2]
    assert spread[seen][0] == pytest.approx(z.var(), rel=0.03)
    assert carried[seen][0] == pytest.approx(z.mean(), rel=0.01)


def test_a_surface_in_seen_empty_space_is_a_violation_and_one_behind_is_not() -> None:
    """A box that only one view sees before the wall contradicts; the wall behind the box not."""
    near = wall(4.0)
    near[10:20, 10:25] = 2.0
    scene = posed_scene([near, wall(4.0)], [HERE, HERE], SMALL)
    box = 150 / near.size
    assert contradiction(scene, 0, 1, OPTIONS) == pytest.approx(box)
    assert contradiction(scene, 1, 0, OPTIONS) == pytest.approx(box)
    check = check_image(scene, 0, OPTIONS)
    assert check.other == 1
    assert check.share == pytest.approx(box)


def test_an_occluded_surface_is_no_violation() -> None:
    """What the second view sees beside a box lies behind the box for the first."""
    rooms = twin_rooms()
    poses, _ = twin_room_poses(0)
    grid = CAMERA.resized(160, 120)
    maps = [rooms.render(grid, pose).depth for pose in poses[:7]]
    scene = posed_scene(maps, poses[:7], CAMERA)
    assert max(check_image(scene, i, OPTIONS).share for i in range(7)) < 0.03


@pytest.mark.parametrize(("gap", "contradicts"), [(0.03, False), (0.10, True)])
def test_small_gaps_are_inaccuracy(gap: float, contradicts: bool) -> None:
    scene = posed_scene([wall(4.0), wall(4.0 * (1 - gap))], [HERE, HERE], SMALL, std=0.001)
    assert (contradiction(scene, 0, 1, OPTIONS) > 0.5) == contradicts


def test_uncertain_depth_contradicts_nothing() -> None:
    scene = posed_scene([wall(4.0), wall(3.0)], [HERE, HERE], SMALL, std=0.03)
    assert contradiction(scene, 0, 1, OPTIONS) > 0.5
    assert contradiction(scene, 0, 1, OPTIONS, std_factor=4.0) == 0


def test_views_that_look_elsewhere_do_not_overlap() -> None:
    back = np.column_stack([np.diag([-1.0, 1.0, -1.0]), np.zeros(3)])
    scene = posed_scene([wall(3.0)] * 3, [HERE, back, HERE], SMALL)
    assert overlapping_views(scene, 0, 5) == [2]
    assert check_image(scene, 1, OPTIONS).other == -1


def test_the_thinned_map_is_where_the_map_is() -> None:
    """A view against itself from a step aside, at full and at a third of the resolution."""
    rooms = twin_rooms()
    pose = twin_room_poses(0)[0][0]
    maps = [rooms.render(CAMERA.resized(480, 360), pose).depth] * 2
    scene = posed_scene(maps, [pose, pose], CAMERA)
    assert contradiction(scene, 0, 1, OPTIONS) == 0
    assert contradiction(scene, 0, 1, OPTIONS.model_copy(update={"map_width": 480})) == 0


def test_a_view_in_the_twin_room_is_told_by_what_differs() -> None:
    """Most views of the second room contradict the first; in their own place none does."""
    rooms = twin_rooms()
    poses, room = twin_room_poses(1)
    maps = [rooms.render(CAMERA.resized(160, 120), pose).depth for pose in poses]
    wrong = []
    for image in np.flatnonzero(np.array(room) == 1):
        scene = posed_scene(maps, poses, CAMERA)
        assert check_image(scene, int(image), OPTIONS).share < OPTIONS.max_violations
        scene.translations[image] = moved(poses[image], 1)[:, 3]
        scene.registered &= np.array(room) != 1
        wrong.append(check_image(scene, int(image), OPTIONS).share > OPTIONS.max_violations)
    assert np.mean(wrong) >= 0.75


def test_the_image_with_most_conflicts_goes() -> None:
    scene = posed_scene([wall(4.0), wall(4.0), wall(2.0), wall(4.0)], [HERE] * 4, SMALL)
    removed = conflicting_images(scene, OPTIONS.max_violations, OPTIONS)
    assert [image for image, _ in removed] == [2]
    assert removed[0][1] == pytest.approx(1.0)
