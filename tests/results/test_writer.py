"""Tests of a whole output folder, read with pycolmap."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
from PIL import Image

from mpsfm_core.data import MappingProblem
from mpsfm_core.data.decisions import ImageReason
from mpsfm_core.geometry import project, transform
from mpsfm_core.inputs.images import FocalSource, ImageSet, SourceImage
from mpsfm_core.inputs.options import InputOptions
from mpsfm_core.inputs.undistortion import undistort_camera
from mpsfm_core.mapping.scene.reconstruction import MappingReport, MappingResult, Reconstruction
from mpsfm_core.results.options import ResultOptions
from mpsfm_core.results.original_images import OriginalImages
from mpsfm_core.results.summary import (
    describe_images,
    describe_pairs,
    describe_reconstructions,
)
from mpsfm_core.results.writer import ComponentResult, write_failure, write_results

PINHOLE = pycolmap.Camera(
    model="PINHOLE", width=160, height=120, params=[140, 141, 80.5, 59], camera_id=1
)
DISTORTED = pycolmap.Camera(
    model="OPENCV",
    width=160,
    height=120,
    params=[140, 141, 80, 60, 0.08, -0.03, 0.001, -0.002],
    camera_id=1,
)


def photos_of(solved, folder: Path, camera: pycolmap.Camera, known: bool = True) -> ImageSet:
    source: FocalSource = "intrinsics" if known else "default"
    sources = []
    for name, view in solved.views.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(path), cv2.cvtColor(view.image, cv2.COLOR_RGB2BGR))
        pinhole = undistort_camera(camera)
        sources.append(SourceImage(name, path, camera, pinhole, source, "0"))
    return ImageSet(sources, InputOptions())


def seen_through(solved, images: ImageSet) -> tuple[MappingProblem, Reconstruction]:
    """Return problem and reconstruction with the pinhole cameras of the image set."""
    pinhole = images[0].pinhole
    registered, problem_images = [], list(solved.problem.images)
    for image in solved.best.images:
        seen = image.point_ids >= 0
        local = transform(image.rotation, image.translation, solved.best.points)
        keypoints = solved.problem.images[image.index].keypoints.copy()
        keypoints[seen] = project(pinhole, local[image.point_ids[seen]])
        registered.append(replace(image, camera=pinhole))
        problem_images[image.index] = replace(
            problem_images[image.index], camera=pinhole, keypoints=keypoints
        )
    problem = MappingProblem(tuple(problem_images), solved.problem.pairs)
    return problem, replace(solved.best, images=tuple(registered))


def write(solved, tmp_path: Path, camera: pycolmap.Camera, options: ResultOptions) -> Path:
    images = photos_of(solved, tmp_path / "photos", camera)
    problem, reconstruction = seen_through(solved, images)
    photos = OriginalImages(images, problem)
    component = ComponentResult.of(reconstruction, photos)
    write_results(tmp_path / "out", [component], photos, options, lambda: {"status": "success"})
    return tmp_path / "out"


def test_default_output_has_the_documented_files(solved, tmp_path: Path) -> None:
    output = write(solved, tmp_path, PINHOLE, ResultOptions())
    assert sorted(path.name for path in output.iterdir()) == [
        "dense.ply",
        "depth",
        "points.ply",
        "sparse",
        "summary.json",
        "views",
    ]
    assert json.loads((output / "summary.json").read_text()) == {"status": "success"}
    model = pycolmap.Reconstruction(str(output / "sparse"))
    assert model.compute_mean_reprojection_error() < 1e-6
    assert {image.name for image in model.images.values()} == {
        image.name for image in solved.best.images
    }
    cloud = pycolmap.Reconstruction()
    cloud.import_PLY(str(output / "points.ply"))
    assert cloud.num_points3D() == len(solved.best.points)
    assert len(list((output / "depth").rglob("*.npz"))) == 3


def test_distorted_camera_gives_original_and_undistorted_model(solved, tmp_path: Path) -> None:
    output = write(solved, tmp_path, DISTORTED, ResultOptions())
    original = pycolmap.Reconstruction(str(output / "sparse"))
    (camera,) = original.cameras.values()
    assert camera.model_name == "OPENCV"
    assert camera.params.tolist() == DISTORTED.params.tolist()
    # The points, poses and keypoints fit together through the distorted camera.
    assert original.compute_mean_reprojection_error() < 1e-6
    undistorted = pycolmap.Reconstruction(str(output / "undistorted" / "sparse"))
    (camera,) = undistorted.cameras.values()
    assert camera.model_name == "PINHOLE"
    assert undistorted.compute_mean_reprojection_error() < 1e-6
    for image in undistorted.images.values():
        picture = cv2.imread(str(output / "undistorted" / "images" / image.name))
        assert picture.shape == (camera.height, camera.width, 3)


@pytest.mark.parametrize("flag", [3, 6])
def test_photos_that_exif_rotates_get_upright_images(solved, tmp_path: Path, flag: int) -> None:
    """Most programs ignore the EXIF orientation, so the model refers to written upright images."""
    plain = photos_of(solved, tmp_path / "photos", PINHOLE)
    turn = {3: Image.Transpose.ROTATE_180, 6: Image.Transpose.ROTATE_90}[flag]
    exif = Image.Exif()
    exif[0x0112] = flag
    for source in plain:
        Image.open(source.path).transpose(turn).save(source.path, exif=exif)
    images = ImageSet([replace(source, orientation=flag) for source in plain], InputOptions())
    problem, reconstruction = seen_through(solved, images)
    photos = OriginalImages(images, problem)
    component = ComponentResult.of(reconstruction, photos)
    output = tmp_path / "out"
    options = ResultOptions(nerfstudio=True)
    write_results(output, [component], photos, options, lambda: {"status": "success"})
    undistorted = pycolmap.Reconstruction(str(output / "undistorted" / "sparse"))
    assert undistorted.compute_mean_reprojection_error() < 1e-6
    frames = json.loads((output / "transforms.json").read_text())["frames"]
    assert len(frames) == len(undistorted.images)
    for frame in frames:
        with Image.open(output / frame["file_path"]) as picture:
            assert picture.size == (frame["w"], frame["h"]) == (160, 120)
            assert picture.getexif().get(0x0112, 1) == 1
            name = frame["file_path"].removeprefix("undistorted/images/")
            expected = solved.views[name].image
            assert np.abs(np.asarray(picture).astype(int) - expected).mean() < 3


@pytest.mark.parametrize("model", ["OPENCV", "FULL_OPENCV"])
def test_transforms_project_points_to_their_keypoints(solved, tmp_path: Path, model: str) -> None:
    params = [*DISTORTED.params] + [0.0] * (4 if model == "FULL_OPENCV" else 0)
    camera = pycolmap.Camera(model=model, width=160, height=120, params=params, camera_id=1)
    output = write(solved, tmp_path, camera, ResultOptions(nerfstudio=True))
    # The format does not support FULL_OPENCV, so it refers to the undistorted views.
    folder = "sparse" if model == "OPENCV" else "undistorted/sparse"
    reference = pycolmap.Reconstruction(str(output / folder))
    frames = json.loads((output / "transforms.json").read_text())["frames"]
    assert len(frames) == 3
    for frame, image in zip(
        frames, sorted(reference.images.values(), key=lambda image: image.name), strict=True
    ):
        assert (output / frame["file_path"]).resolve().is_file()
        distortion = [frame.get(key, 0.0) for key in ("k1", "k2", "p1", "p2")]
        matrix = np.array(
            [[frame["fl_x"], 0, frame["cx"]], [0, frame["fl_y"], frame["cy"]], [0, 0, 1]]
        )
        cam_from_world = np.linalg.inv(np.array(frame["transform_matrix"]))
        cam_from_world[1:3] *= -1
        for point in image.get_observation_points2D()[:5]:
            xyz = reference.points3D[point.point3D_id].xyz
            local = cam_from_world[:3, :3] @ xyz + cam_from_world[:3, 3]
            xy, _ = cv2.projectPoints(
                local[None], np.zeros(3), np.zeros(3), matrix, np.array(distortion)
            )
            np.testing.assert_allclose(xy.ravel(), point.xy, atol=1e-5)


def test_refined_focal_length_is_written_to_the_camera(solved, tmp_path: Path) -> None:
    images = photos_of(solved, tmp_path, PINHOLE, known=False)
    problem, reconstruction = seen_through(solved, images)
    refined = replace(images[0].pinhole, fx=140 * 1.1, fy=141 * 1.1)
    reconstruction = replace(
        reconstruction,
        images=tuple(replace(image, camera=refined) for image in reconstruction.images),
    )
    model = ComponentResult.of(reconstruction, OriginalImages(images, problem)).model
    (camera,) = model.cameras.values()
    np.testing.assert_allclose(camera.params, [154, 155.1, 80.5, 59])
    mapping = MappingResult((reconstruction,), solved.result.report)
    nothing: dict[str, dict[str, object]] = {name: {} for name in images.names}
    photos = OriginalImages(images, problem)
    report = {"images": nothing, "failed": {}}
    details = describe_images(images, report, mapping, photos)["details"]
    assert details["images/0.png"] == {
        "focal_length_from": "default",
        "focal_length_px": pytest.approx(140.5),
        "refined_focal_length_px": pytest.approx(154.55),
    }
    assert "refined_focal_length_px" not in details["images/3.png"], "it is not registered"


def test_views_contain_the_input_of_the_mapper(solved, tmp_path: Path) -> None:
    output = write(solved, tmp_path, DISTORTED, ResultOptions())
    given = solved.problem.images[3]  # not registered
    size = given.camera.size
    picture = cv2.imread(str(output / "views" / f"{given.name}.webp"))
    assert picture.shape == (*undistort_camera(DISTORTED).size[::-1], 3)
    with np.load(output / "views" / f"{given.name}.npz") as maps:
        assert maps["camera"].tolist() == [*size, *given.camera.params]
        np.testing.assert_array_equal(maps["depth"], given.depth.depth)
        np.testing.assert_allclose(maps["normals"], given.normals.normals, atol=1e-3)
        std = np.sqrt(given.depth.variance) / given.depth.depth
        np.testing.assert_allclose(maps["relative_std"], std, rtol=1e-3)


def test_disabled_results_are_not_written(solved, tmp_path: Path) -> None:
    options = ResultOptions(depth_maps=False, dense_cloud=False, text_model=True, report=False)
    output = write(solved, tmp_path, PINHOLE, options)
    names = sorted(path.name for path in output.iterdir())
    assert names == ["points.ply", "sparse", "sparse_text", "summary.json"]
    assert pycolmap.Reconstruction(str(output / "sparse_text")).num_points3D() == 40


def test_further_components_are_separate_models(solved, tmp_path: Path) -> None:
    images = photos_of(solved, tmp_path / "photos", PINHOLE)
    problem, reconstruction = seen_through(solved, images)
    photos = OriginalImages(images, problem)
    first = replace(reconstruction, images=reconstruction.images[:2])
    second = replace(reconstruction, images=reconstruction.images[1:])
    components = [ComponentResult.of(part, photos) for part in (first, second)]
    write_results(tmp_path / "out", components, photos, ResultOptions(), dict)
    main = pycolmap.Reconstruction(str(tmp_path / "out" / "sparse"))
    other = pycolmap.Reconstruction(str(tmp_path / "out" / "components" / "1"))
    assert {image.name for image in main.images.values()} == {"images/0.png", "images/1.png"}
    assert {image.name for image in other.images.values()} == {"images/1.png", "images/2.png"}
    maps = tmp_path / "out" / "components" / "1" / "depth" / "images"
    assert sorted(path.name for path in maps.iterdir()) == ["1.png.npz", "2.png.npz"]
    assert (tmp_path / "out" / "components" / "1" / "dense.ply").is_file()


def test_tentative_images_are_in_the_model_without_points(solved, tmp_path: Path) -> None:
    images = photos_of(solved, tmp_path / "photos", PINHOLE)
    problem, reconstruction = seen_through(solved, images)
    *others, last = reconstruction.images
    guessed = replace(last, confirmed=False, point_ids=np.full_like(last.point_ids, -1))
    complete = replace(reconstruction, images=(*others, guessed))
    component = ComponentResult.of(complete, OriginalImages(images, problem))
    options = ResultOptions(nerfstudio=True)
    write_results(tmp_path / "out", [component], OriginalImages(images, problem), options, dict)
    model = pycolmap.Reconstruction(str(tmp_path / "out" / "sparse"))
    points = {image.name: image.num_points3D for image in model.images.values()}
    assert points == {"images/0.png": 40, "images/1.png": 40, "images/2.png": 0}
    frames = json.loads((tmp_path / "out" / "transforms.json").read_text())["frames"]
    assert len(frames) == 3


def test_summary_lists_tentative_images(solved, tmp_path: Path) -> None:
    images = photos_of(solved, tmp_path, PINHOLE)
    problem, reconstruction = seen_through(solved, images)
    first, second, third = reconstruction.images
    guessed = [replace(image, confirmed=False) for image in (second, third)]
    best = replace(reconstruction, images=(first, *guessed))
    other = replace(reconstruction, images=(third,))
    report = MappingReport(
        {
            "images/1.png": ImageReason.NO_VALID_DEPTH.because(),
            "images/3.png": ImageReason.NO_POSE.because(),
        }
    )
    extraction = {"images": {name: {} for name in images.names}, "failed": {}}
    described = describe_images(
        images, extraction, MappingResult((best, other), report), OriginalImages(images, problem)
    )
    assert described["registered"] == ["images/0.png"]
    assert described["unconfirmed"] == {
        "images/1.png": {"code": "no-valid-depth"},
        "images/2.png": {"code": "other-component", "component": 1},
    }
    assert described["unregistered"] == {"images/3.png": {"code": "no-pose"}}


def test_failed_run_writes_summary_and_keeps_earlier_model(solved, tmp_path: Path) -> None:
    output = write(solved, tmp_path, PINHOLE, ResultOptions())
    before = (output / "sparse" / "points3D.bin").read_bytes()
    (output / "report.html").write_text("of the run before")
    photos = OriginalImages(photos_of(solved, tmp_path / "photos", PINHOLE), solved.problem)
    write_failure(output, photos, ResultOptions(), {"status": "failed"})
    assert not (output / "report.html").exists()
    assert (output / "views" / "images" / "3.png.npz").exists()
    assert json.loads((output / "summary.json").read_text()) == {"status": "failed"}
    assert (output / "sparse" / "points3D.bin").read_bytes() == before


def test_summary_lists_registered_images_and_reasons(solved, tmp_path: Path) -> None:
    images = photos_of(solved, tmp_path, PINHOLE)
    problem, reconstruction = seen_through(solved, images)
    model = ComponentResult.of(reconstruction, OriginalImages(images, problem)).model
    mapping = MappingResult((reconstruction,), solved.result.report)
    extraction = {
        "images": {name: {"keypoints": 46} for name in images.names},
        "pairs": [{"images": ["images/0.png", "images/3.png"], "matches": 20, "inliers": 15}],
        "pairs_proposed": 6,
        "pairs_matched": 1,
        "pairs_verified": 1,
        "failed": {},
    }
    described = describe_images(images, extraction, mapping, OriginalImages(images, problem))
    assert described["total"] == 4
    assert described["registered"] == ["images/0.png", "images/1.png", "images/2.png"]
    assert described["unregistered"] == {"images/3.png": {"code": "no-verified-matches"}}
    assert described["unconfirmed"] == {}
    details = described["details"]["images/0.png"]
    assert details == {
        "focal_length_from": "intrinsics",
        "focal_length_px": pytest.approx(140.5),
        "keypoints": 46,
    }
    (pair,) = describe_pairs(extraction, mapping, solved.problem)["all"]
    assert pair == {**extraction["pairs"][0], "cannot_start": {"code": "no-pose"}}
    (numbers,) = describe_reconstructions(mapping, [model], solved.problem)
    assert (numbers["images"], numbers["points"], numbers["observations"]) == (3, 40, 120)
    assert numbers["mean_track_length"] == 3
    assert numbers["mean_reprojection_error_px"] == pytest.approx(0, abs=1e-6)
    assert 0.001 < numbers["median_relative_depth_std"] < 0.1
    assert numbers["metric_scale"]["trusted"] is True
    json.dumps([described, numbers], allow_nan=False)
