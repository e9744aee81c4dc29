"""Tests of views that are undistorted again with the radial distortion that the mapper
estimated."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest

import mpsfm_core as mpsfm
from mpsfm_core.data import Float64, MappingProblem
from mpsfm_core.data.camera_models import CameraModel, IntrinsicParameter
from mpsfm_core.data.options import SettingsError
from mpsfm_core.geometry import pixel_centers, project, sample_nearest, scale_pixels, transform
from mpsfm_core.inputs.images import ImageSet, SourceImage
from mpsfm_core.inputs.options import InputOptions
from mpsfm_core.inputs.undistortion import undistort_camera
from mpsfm_core.mapping.options import MapperOptions
from mpsfm_core.mapping.scene.estimated_intrinsics import (
    CalibrationOutcome,
    IntrinsicEstimate,
)
from mpsfm_core.mapping.scene.reconstruction import CalibratedParameter, MappingResult
from mpsfm_core.results.original_images import OriginalImages
from mpsfm_core.results.refined_views import (
    measure_distortion,
    undistort_cameras,
    undistort_images,
    undistort_problem,
)
from mpsfm_core.results.summary import describe_images
from mpsfm_core.results.writer import ComponentResult

GUESS = pycolmap.Camera(
    model="SIMPLE_PINHOLE", width=160, height=120, params=[150, 80, 60], camera_id=1
)
FOCAL_PX, RADIAL = 140.0, -0.12
TRUE = pycolmap.Camera(
    model="SIMPLE_RADIAL", width=160, height=120, params=[FOCAL_PX, 80, 60, RADIAL], camera_id=1
)


def coefficients(radial: float) -> Float64:
    """Return the distortion coefficients of a SIMPLE_RADIAL camera."""
    return np.array([radial, 0.0, 0.0, 0.0])


@pytest.fixture
def images(solved, tmp_path: Path) -> ImageSet:
    sources = []
    for name, view in solved.views.items():
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(path), cv2.cvtColor(view.image, cv2.COLOR_RGB2BGR))
        pinhole = undistort_camera(GUESS)
        sources.append(SourceImage(name, path, GUESS, pinhole, "default", "0"))
    return ImageSet(sources, InputOptions())


@pytest.fixture
def mapped(solved, images: ImageSet) -> tuple[MappingProblem, MappingResult]:
    """Problem and result of a mapper that found the true focal length and distortion."""
    pinhole = replace(images[0].pinhole, fx=FOCAL_PX, fy=FOCAL_PX)
    views = [replace(i, camera=images[0].pinhole, focal_known=False) for i in solved.problem.images]
    registered = []
    estimate = IntrinsicEstimate(CalibrationOutcome.REFINED, RADIAL, 0.01)
    calibration = {IntrinsicParameter.RADIAL_DISTORTION: CalibratedParameter(estimate)}
    for image in solved.best.images:
        seen = image.point_ids >= 0
        local = transform(image.rotation, image.translation, solved.best.points)
        keypoints = solved.problem.images[image.index].keypoints.copy()
        keypoints[seen] = TRUE.img_from_cam(local[image.point_ids[seen]])
        views[image.index] = replace(views[image.index], keypoints=keypoints)
        registered.append(
            replace(image, camera=pinhole, distortion=coefficients(RADIAL), calibration=calibration)
        )
    model = replace(solved.best, images=tuple(registered))
    return replace(solved.problem, images=tuple(views)), MappingResult(
        (model,), solved.result.report
    )


def test_undistort_problem_moves_keypoints_to_the_refined_pinhole_camera(images, mapped) -> None:
    problem, mapping = mapped
    refined = undistort_images(images, problem, mapping.reconstructions)
    moved = undistort_problem(images, refined, problem)
    model = undistort_cameras(refined, mapping.reconstructions[0])
    for image in model.images:
        view = moved.images[image.index]
        assert image.camera == refined[image.index].pinhole == view.camera
        assert view.distortion[0] == image.distortion[0] == RADIAL
        assert view.focal_prior_px == problem.images[image.index].focal_prior_px
        seen = image.point_ids >= 0
        points = model.points[image.point_ids[seen]]
        expected = project(image.camera, transform(image.rotation, image.translation, points))
        np.testing.assert_allclose(view.keypoints[seen], expected, atol=1e-6)
        original = refined[image.index].original_pixels(view.keypoints)
        np.testing.assert_allclose(original, problem.images[image.index].keypoints, atol=1e-6)


def test_measure_distortion_is_the_relative_shift_of_the_corners(images) -> None:
    distorted = replace(images[0], camera=TRUE)
    corner = np.array([80.0, 60.0])
    (ray,) = TRUE.cam_from_img(np.zeros((1, 2)))
    expected = FOCAL_PX * np.linalg.norm(ray) / np.linalg.norm(corner) - 1
    assert measure_distortion(images[0]) == pytest.approx(0)
    assert measure_distortion(distorted) == pytest.approx(expected)
    assert 0.05 < expected < 0.2


def test_undistort_images_gives_unregistered_images_the_shared_camera(images, mapped) -> None:
    refined = undistort_images(images, mapped[0], mapped[1].reconstructions)
    np.testing.assert_allclose(refined[3].camera.params, TRUE.params)


def test_undistort_images_again_replaces_the_coefficient(images, mapped) -> None:
    """A second mapping of undistorted views refines the camera of the original images."""
    problem, mapping = mapped
    first = replace(mapping.reconstructions[0].images[0], distortion=coefficients(-0.1))
    other = replace(mapping.reconstructions[0], images=(first,))
    views = undistort_images(images, problem, [other])
    camera = replace(views[0].pinhole, fx=FOCAL_PX, fy=FOCAL_PX)
    second = replace(mapping.reconstructions[0].images[0], camera=camera)
    refined = undistort_images(
        views, problem, [replace(mapping.reconstructions[0], images=(second,))]
    )
    np.testing.assert_allclose(refined[0].camera.params, TRUE.params)
    xy = np.array([[30.0, 20.0], [80.0, 60.0]])
    np.testing.assert_allclose(
        refined[0].original_pixels(refined[0].view_pixels(xy)), xy, atol=1e-6
    )


@pytest.mark.parametrize(
    ("guess", "true"),
    [
        (
            GUESS,
            pycolmap.Camera(
                model="OPENCV",
                width=160,
                height=120,
                params=[140, 141, 82, 59, -0.1, 0.03, 0.004, -0.006],
                camera_id=1,
            ),
        ),
        (
            pycolmap.Camera(
                model="OPENCV_FISHEYE",
                width=160,
                height=120,
                params=[150, 150, 80, 60, 0, 0, 0, 0],
                camera_id=1,
            ),
            pycolmap.Camera(
                model="OPENCV_FISHEYE",
                width=160,
                height=120,
                params=[140, 141, 82, 59, 0.05, -0.02, 0.01, 0.001],
                camera_id=1,
            ),
        ),
    ],
    ids=["OPENCV", "OPENCV_FISHEYE"],
)
def test_undistort_images_takes_all_parameters_of_the_camera_model(
    solved, images: ImageSet, guess: pycolmap.Camera, true: pycolmap.Camera
) -> None:
    model = CameraModel(true.model_name)
    views = images.with_cameras(dict.fromkeys(images.names, guess))
    view = views[0].pinhole
    intrinsics, distortion = model.from_params(np.array(true.params))
    shift = np.array([view.cx, view.cy]) - guess.params[-6:-4] if model.is_fisheye else np.zeros(2)
    center = intrinsics[2:] + (shift if model.is_fisheye else 0.0)
    pinhole = replace(view, fx=140.0, fy=141.0, cx=center[0], cy=center[1])
    registered = replace(
        solved.best.images[0], camera=pinhole, camera_model=model, distortion=distortion
    )
    problem = replace(
        solved.problem,
        images=tuple(
            replace(i, camera=view, focal_known=False, camera_model=model)
            for i in solved.problem.images
        ),
    )
    refined = undistort_images(views, problem, [replace(solved.best, images=(registered,))])
    assert refined[0].camera.model_name == true.model_name
    np.testing.assert_allclose(refined[0].camera.params, true.params, atol=1e-9)
    moved = undistort_problem(views, refined, problem).images[0]
    pixels = [views[0].original_pixels(problem.images[0].keypoints)]
    pixels += [refined[0].original_pixels(moved.keypoints)]
    inside = ((pixels[0] > 0) & (pixels[0] < [160, 120])).all(axis=1)
    assert inside.sum() > 20
    np.testing.assert_allclose(pixels[1][inside], pixels[0][inside], atol=1e-5)
    assert moved.distortion == pytest.approx(tuple(distortion))


def test_undistort_problem_moves_depth_along_its_rays(images, mapped) -> None:
    problem, mapping = mapped
    refined = undistort_images(images, problem, mapping.reconstructions)
    moved = undistort_problem(images, refined, problem)
    for old, new in zip(problem.images, moved.images, strict=True):
        rows, columns = new.depth.shape
        grid = pixel_centers(columns, rows)[new.depth.valid]
        view = scale_pixels(grid, (columns, rows), refined[0].pinhole.size)
        original = refined[0].original_pixels(view)
        before = scale_pixels(original, (160, 120), old.depth.shape[::-1])
        expected = sample_nearest(old.depth.depth, before)
        assert np.median(np.abs(new.depth.depth[new.depth.valid] / expected - 1)) < 0.01
        assert new.depth.valid.mean() > 0.9 * old.depth.valid.mean()


def test_undistort_without_distortion_changes_nothing(solved, images) -> None:
    assert undistort_images(images, solved.problem, [solved.best]) is images
    moved = undistort_problem(images, images, solved.problem)
    assert all(new is old for new, old in zip(moved.images, solved.problem.images, strict=True))


@pytest.mark.parametrize("options", [None, {"seed": 1}, MapperOptions(seed=1)])
def test_undistort_views_takes_options_as_run_mapper_does(solved, images, options) -> None:
    result = mpsfm.undistort_views(solved.result, solved.problem, images, options)
    assert result[0] is solved.result and result[2] is images
    with pytest.raises(SettingsError, match="sed"):
        mpsfm.undistort_views(solved.result, solved.problem, images, {"sed": 1})


def test_model_and_summary_have_the_refined_camera(images, mapped) -> None:
    problem, mapping = mapped
    refined = undistort_images(images, problem, mapping.reconstructions)
    photos = OriginalImages(refined, undistort_problem(images, refined, problem))
    model = undistort_cameras(refined, mapping.reconstructions[0])
    mapping = replace(mapping, reconstructions=(model,))
    component = ComponentResult.of(model, photos)
    assert photos.any_distorted(model)
    (camera,) = component.model.cameras.values()
    assert camera.model_name == "SIMPLE_RADIAL"
    np.testing.assert_allclose(camera.params, TRUE.params)
    assert component.model.compute_mean_reprojection_error() < 1e-6
    assert component.undistorted(photos).compute_mean_reprojection_error() < 1e-6
    nothing = {"images": {name: {} for name in images.names}, "failed": {}}
    details = describe_images(images, nothing, mapping, photos)["details"]["images/0.png"]
    assert details["focal_length_px"] == 150
    assert details["refined_focal_length_px"] == pytest.approx(FOCAL_PX)
    assert details["radial_distortion"] == RADIAL
    assert details["radial_distortion_std"] == 0.01
