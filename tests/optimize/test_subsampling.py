"""Tests of subsampled maps: positions of their pixels, and interpolation to full size."""

import numpy as np
import pytest

from mpsfm_core.data import PinholeCamera
from mpsfm_core.geometry import pixel_centers, unproject
from mpsfm_core.optimize.subsampling import (
    compute_subsampling_step,
    subsample,
    subsample_camera,
    subsample_pixels,
    upsample,
)

CAMERA = PinholeCamera(37, 26, 30.0, 31.0, 18.2, 13.1)


@pytest.mark.parametrize("step", [1, 2, 3, 4])
def test_subsampled_pixels_keep_their_rays(step: int) -> None:
    xy = pixel_centers(CAMERA.width, CAMERA.height)
    rays = unproject(CAMERA, xy, np.ones(xy.shape[:2]))
    camera = subsample_camera(CAMERA, step)
    centers = pixel_centers(camera.width, camera.height)
    np.testing.assert_allclose(
        unproject(camera, centers, np.ones(centers.shape[:2])), subsample(rays, step), atol=1e-12
    )
    np.testing.assert_allclose(
        subsample_pixels(subsample(xy, step).reshape(-1, 2), step),
        centers.reshape(-1, 2),
        atol=1e-12,
    )


@pytest.mark.parametrize("step", [1, 2, 3])
def test_interpolated_plane_equals_the_original(step: int) -> None:
    rows, columns = np.mgrid[:26, :37]
    plane = 0.3 * rows - 0.2 * columns + 1.0
    thin = subsample(plane, step)
    back = upsample(thin, np.ones(thin.shape, dtype=np.bool_), plane.shape)
    inside = (slice(step, -step),) * 2  # values outside of the outer pixels are unknown
    np.testing.assert_allclose(back[inside], plane[inside], atol=1e-5)


def test_invalid_pixels_are_ignored() -> None:
    thin = np.full((13, 18), 2.0)
    valid = np.ones(thin.shape, dtype=np.bool_)
    thin[4:7, 5:8], valid[4:7, 5:8] = np.nan, False
    back = upsample(thin, valid, (26, 37))
    assert set(np.unique(back)) == {0.0, 2.0}
    assert back[11, 13] == 0.0


def test_step_gives_about_the_requested_columns() -> None:
    assert [compute_subsampling_step(columns, 200) for columns in (50, 200, 387, 640)] == [
        1,
        1,
        2,
        3,
    ]
