"""Tests of view frusta against projection."""

import numpy as np
from scipy.spatial.transform import Rotation

from mpsfm_core.data import PinholeCamera
from mpsfm_core.geometry import inside, project
from mpsfm_core.geometry.frustum import frustum_planes


def test_points_on_the_inner_side_of_all_planes_are_those_that_project_into_the_image() -> None:
    rng = np.random.default_rng(0)
    camera = PinholeCamera(320, 240, 250.0, 260.0, 150.0, 130.0)
    rotations = Rotation.random(6, random_state=0).as_matrix()
    translations = rng.normal(size=(6, 3))
    points = rng.normal(size=(2000, 3)) * 4
    intrinsics = np.tile([camera.fx, camera.fy, camera.cx, camera.cy], (6, 1))

    planes = frustum_planes(rotations, translations, intrinsics, np.tile([320.0, 240.0], (6, 1)))

    np.testing.assert_allclose(np.linalg.norm(planes[..., :3], axis=-1), 1.0)
    distances = np.einsum("nka,pa->npk", planes, np.c_[points, np.ones(len(points))])
    for view, distance in enumerate(distances):
        in_camera = points @ rotations[view].T + translations[view]
        in_front = in_camera[:, 2] > 0
        visible = in_front.copy()
        visible[in_front] = inside(project(camera, in_camera[in_front]), camera.size)
        assert 0 < visible.sum() < len(points)
        np.testing.assert_array_equal((distance > 0).all(axis=1), visible)
