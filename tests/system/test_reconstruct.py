"""Tests of ``mpsfm reconstruct`` and of the Python API, from photos to result files."""

from __future__ import annotations

import contextlib
import json
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest

import mpsfm_core
from mpsfm_core.cli.reconstruct import _refined_focal_lengths
from mpsfm_core.data.errors import ReconstructionError
from mpsfm_core.dense.densify import densify
from mpsfm_core.evaluation import evaluate, read_poses, reconstruction_poses
from mpsfm_core.mapping.scene.reconstruction import MappingReport, MappingResult
from mpsfm_core.results.transforms_json import write_transforms

from .conftest import POSES_ONLY


@pytest.fixture(scope="module")
def output(photo_scene, mpsfm, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("results") / "out"
    ended = mpsfm(*photo_scene.arguments, "--output", folder)
    assert ended.code == 0, ended.err
    assert "5 of 5 images" in ended.out
    assert "meters, as given by the depth files: 5 depth maps, spread " in ended.out
    return folder


def test_output_folder_contains_documented_files(output: Path) -> None:
    names = {path.name for path in output.iterdir()}
    report = {"views", "report.html"}
    assert names == {"sparse", "points.ply", "dense.ply", "depth", "summary.json"} | report
    assert {path.name for path in (output / "depth").iterdir()} == {
        f"{number}.png.npz" for number in range(5)
    }


def test_poses_and_depth_are_accurate(output: Path, photo_scene) -> None:
    report = evaluate(read_poses(output), read_poses(photo_scene.truth))
    assert report["registered"] == 5
    assert report["auc"]["1"] > 80
    # The depth is exact and metric, so the model is in meters.
    assert report["trajectory"]["scale"] == pytest.approx(1, abs=0.02)
    for number in range(5):
        with np.load(output / "depth" / f"{number}.png.npz") as refined:
            depth, valid = refined["depth"], refined["valid"]
        with np.load(photo_scene.folder / "depth" / f"{number}.npz") as exact:
            truth = cv2.resize(exact["depth"], depth.shape[::-1], interpolation=cv2.INTER_NEAREST)
        error = np.abs(depth[valid] / truth[valid] - 1)
        assert np.median(error) < 0.02


def test_model_opens_in_pycolmap_with_photo_names(output: Path) -> None:
    model = pycolmap.Reconstruction(str(output / "sparse"))
    assert sorted(image.name for image in model.images.values()) == [f"{i}.png" for i in range(5)]
    assert model.num_points3D() > 100
    assert model.compute_mean_reprojection_error() < 2


def test_summary_lists_providers_and_results(output: Path) -> None:
    summary = json.loads((output / "summary.json").read_text())
    assert summary["status"] == "success"
    assert summary["images"]["unregistered"] == {}
    assert summary["config"]["features"]["use"] == "sift"
    assert {provider["kind"] for provider in summary["providers"]} == {
        "features",
        "matcher",
        "depth",
        "normals",
    }
    rooms = {"providers", "inputs", "extraction", "mapping", "dense", "results"}
    assert set(summary["stages"]) == rooms
    for stage in summary["stages"].values():
        assert stage["seconds"] > 0
        assert stage["peak_memory_mb"] > 10
    (best,) = summary["reconstructions"]
    assert best["images"] == 5


def test_default_focal_length_is_refined_and_reported(photo_scene, mpsfm, tmp_path: Path) -> None:
    (camera,) = pycolmap.Reconstruction(str(photo_scene.truth)).cameras.values()
    guess = 1.06 * camera.focal_length_x
    ended = mpsfm(
        *photo_scene.without_intrinsics,
        "--output",
        tmp_path / "out",
        "--set",
        f"inputs.default_focal_ratio={guess / camera.width}",
        *POSES_ONLY,
    )
    assert ended.code == 0, ended.err
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    (told,) = {
        (image["focal_length_px"], image["refined_focal_length_px"], image["focal_length_from"])
        for image in summary["images"]["details"].values()
    }
    assert told == (pytest.approx(guess), pytest.approx(camera.focal_length_x, rel=0.02), "default")
    assert f"focal length refined from {guess:.0f} (default) to {told[1]:.0f} px" in ended.out


@pytest.mark.parametrize("depth", ["files", "flat"])
def test_radial_distortion_is_estimated_for_all_results(
    photo_scene, mpsfm, tmp_path: Path, depth: str
) -> None:
    (camera,) = pycolmap.Reconstruction(str(photo_scene.truth)).cameras.values()
    distorted = pycolmap.Camera(
        model="SIMPLE_RADIAL", width=320, height=240, params=[280, 160, 120, -0.2]
    )
    photos, output = tmp_path / "photos", tmp_path / "out"
    resample_images(photo_scene.images, photos, camera, distorted)
    ended = mpsfm(
        "reconstruct",
        photos,
        "--config",
        photo_scene.config,
        "--output",
        output,
        "--set",
        f"inputs.default_focal_ratio={1.06 * 280 / 320}",
        *([] if depth == "files" else ["--set", f"depth={{use: {depth}}}"]),
        *POSES_ONLY,
    )
    assert ended.code == 0, ended.err
    assert "radial distortion estimated as -0." in ended.out
    assert ("flat predicts depth again" in ended.err) == (depth == "flat")
    model = pycolmap.Reconstruction(str(output / "sparse"))
    (refined,) = model.cameras.values()
    assert refined.model_name == "SIMPLE_RADIAL"
    assert refined.focal_length == pytest.approx(280, rel=0.02)
    assert refined.params[3] == pytest.approx(-0.2, abs=0.02)
    errors_px = [
        np.linalg.norm(image.project_point(model.points3D[point.point3D_id].xyz) - point.xy)
        for image in model.images.values()
        for point in image.get_observation_points2D()
    ]
    assert np.median(errors_px) < 0.5
    undistorted = pycolmap.Reconstruction(str(output / "undistorted" / "sparse"))
    (pinhole,) = undistorted.cameras.values()
    assert pinhole.model_name == "PINHOLE"
    assert cv2.imread(str(output / "undistorted" / "images" / "0.png")).shape[:2] == (
        pinhole.height,
        pinhole.width,
    )
    summary = json.loads((output / "summary.json").read_text())
    for image in summary["images"]["details"].values():
        assert image["radial_distortion"] == pytest.approx(refined.params[3])
        assert 0 < image["radial_distortion_std"] < 0.02
    report = evaluate(read_poses(output), read_poses(photo_scene.truth))
    assert report["registered"] == 5 and report["auc"]["5"] > 80


def resample_images(source: Path, target: Path, old: pycolmap.Camera, new: pycolmap.Camera) -> None:
    """Write the images of a folder as a camera with other intrinsics takes them."""
    target.mkdir()
    x, y = np.meshgrid(np.arange(new.width) + 0.5, np.arange(new.height) + 0.5)
    rays = new.cam_from_img(np.column_stack([x.ravel(), y.ravel()]))
    xy = old.img_from_cam(np.column_stack([rays, np.ones(len(rays))])) - 0.5
    pixels = xy.reshape(new.height, new.width, 2).astype(np.float32)
    for path in source.iterdir():
        image = cv2.imread(str(path))
        cv2.imwrite(str(target / path.name), cv2.remap(image, pixels, None, cv2.INTER_CUBIC))


def test_refined_focal_lengths_of_several_cameras_are_printed_as_range() -> None:
    known = {"focal_length_from": "intrinsics", "focal_length_px": 500.0}
    guessed = {"focal_length_from": "exif", "focal_length_px": 1000.0}
    longer = {**guessed, "refined_focal_length_px": 1030.0}
    shorter = {**guessed, "refined_focal_length_px": 980.0}
    assert _refined_focal_lengths([known, longer, longer, shorter]) == (
        "2 focal lengths refined, by -2% to +3%"
    )
    assert _refined_focal_lengths([known, guessed]) == ""


def test_python_api_without_output_gives_same_poses(
    output: Path, photo_scene, cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MPSFM_CACHE", str(cache))
    result = mpsfm_core.reconstruct(
        photo_scene.images,
        config=photo_scene.config,
        intrinsics=photo_scene.intrinsics,
        overrides=["runtime.seed=0", "dense.enabled=false"],
    )
    assert result.output is None
    assert result.summary["status"] == "success"
    assert len(result.mapping.reconstructions[0].images) == 5
    written = read_poses(output)
    for name, (rotation, translation) in reconstruction_poses(result.model).items():
        np.testing.assert_allclose(rotation, written[name][0], atol=1e-9)
        np.testing.assert_allclose(translation, written[name][1], atol=1e-9)


def test_image_list_selects_photos_and_quiet_prints_nothing(
    photo_scene, mpsfm, tmp_path: Path
) -> None:
    listed = tmp_path / "list.txt"
    listed.write_text("1.png\n2.png\n3.png\n")
    output = tmp_path / "out"
    ended = mpsfm(
        *photo_scene.arguments, "--output", output, "--image-list", listed, "--quiet", *POSES_ONLY
    )
    assert (ended.code, ended.out, ended.err) == (0, "", "")
    model = pycolmap.Reconstruction(str(output / "sparse"))
    assert {image.name for image in model.images.values()} == {"1.png", "2.png", "3.png"}


def test_set_option_changes_the_run(photo_scene, mpsfm, tmp_path: Path) -> None:
    ended = mpsfm(
        *photo_scene.arguments, "--output", tmp_path / "out", "--set", "results.dense_cloud=false"
    )
    assert ended.code == 0, ended.err
    assert not (tmp_path / "out" / "dense.ply").exists()


def test_runtime_seed_is_passed_to_mapper(
    photo_scene, cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MPSFM_CACHE", str(cache))
    seeds = []

    def observed(problem, options, events, checkpoints, map_parts):
        seeds.append(options.seed)
        return MappingResult((), MappingReport())

    monkeypatch.setattr("mpsfm_core.mapping.parts.part_mapping.reconstruct", observed)
    with pytest.raises(ReconstructionError):
        mpsfm_core.reconstruct(
            photo_scene.images, config=photo_scene.config, overrides=["runtime.seed=11"]
        )
    assert seeds == [11]


@pytest.mark.parametrize("file", [".", "transforms.json"], ids=["COLMAP", "nerfstudio"])
def test_known_poses_stay_fixed_and_give_consistent_depth(
    photo_scene, mpsfm, tmp_path: Path, file: str
) -> None:
    output = tmp_path / "out"
    model = pycolmap.Reconstruction(str(photo_scene.truth))
    names = {image.name: f"images/{image.name}" for image in model.images.values()}
    model.write_text(str(tmp_path))
    write_transforms(tmp_path / "transforms.json", model, names)
    poses = ("--poses", tmp_path / file, "--set", "mapping.known_poses=fixed")
    ended = mpsfm(*photo_scene.without_intrinsics, "--output", output, *poses, *POSES_ONLY)
    assert ended.code == 0, ended.err
    (camera,) = pycolmap.Reconstruction(str(output / "sparse")).cameras.values()
    assert camera.params.tolist() == [280, 280, 160, 120]
    truth, written = read_poses(photo_scene.truth), read_poses(output)
    assert written.keys() == truth.keys()
    for name, (rotation, translation) in truth.items():
        np.testing.assert_allclose(written[name][0], rotation, atol=1e-9)
        np.testing.assert_allclose(written[name][1], translation, atol=1e-9)


def test_partial_model_is_extended_with_its_camera(photo_scene, mpsfm, tmp_path: Path) -> None:
    model = pycolmap.Reconstruction(str(photo_scene.truth))
    for number in (4, 5):
        model.deregister_frame(number)
    model.write_text(str(tmp_path))
    output = tmp_path / "out"
    poses = ("--poses", tmp_path)
    ended = mpsfm(*photo_scene.without_intrinsics, "--output", output, *poses, *POSES_ONLY)
    assert ended.code == 0, ended.err
    report = evaluate(read_poses(output), read_poses(photo_scene.truth))
    assert (report["registered"], len(read_poses(tmp_path))) == (5, 3)
    assert report["auc"]["1"] > 80
    (camera,) = pycolmap.Reconstruction(str(output / "sparse")).cameras.values()
    assert camera.params.tolist() == [280, 280, 160, 120]


def test_poses_of_other_images_are_wrong_input(photo_scene, mpsfm, tmp_path: Path) -> None:
    model = pycolmap.Reconstruction(str(photo_scene.truth))
    for image in model.images.values():
        image.name = f"other_{image.name}"
    model.write_text(str(tmp_path))
    ended = mpsfm(*photo_scene.arguments, "--output", tmp_path / "out", "--poses", tmp_path)
    assert ended.code == 2
    assert "none of the images" in ended.err


def test_one_known_pose_is_wrong_input(photo_scene, mpsfm, tmp_path: Path) -> None:
    model = pycolmap.Reconstruction(str(photo_scene.truth))
    for number in (2, 3, 4, 5):
        model.deregister_frame(number)
    model.write_text(str(tmp_path))
    ended = mpsfm(*photo_scene.arguments, "--output", tmp_path / "out", "--poses", tmp_path)
    assert ended.code == 2
    assert "has a pose of 0.png only; a run needs the poses of two images" in ended.err


def test_poses_without_photo_are_reported(
    photo_scene, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    listed = tmp_path / "list.txt"
    listed.write_text("0.png\n1.png\n2.png\n")
    result = mpsfm_core.reconstruct(
        photo_scene.images,
        config=photo_scene.config,
        image_list=listed,
        poses=photo_scene.truth,
        overrides=["mapping.known_poses=fixed", "dense.enabled=false"],
    )
    assert result.model.num_images() == 3
    assert "2 of its 5 images are not among the photos: 3.png, 4.png" in caplog.text
    assert any("are not among the photos" in text for text in result.summary["warnings"])


@pytest.mark.parametrize(("poses", "found"), [("fixed", False), ("start", True)])
def test_densify_treats_fixed_poses_as_independent_of_depth(
    photo_scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, poses: str, found: bool
) -> None:
    told = []

    def observed(*arguments, poses_use_depth: bool):
        told.append(poses_use_depth)
        return densify(*arguments, poses_use_depth=poses_use_depth)

    monkeypatch.setattr("mpsfm_core.pipeline.run.densify", observed)
    listed = tmp_path / "list.txt"
    listed.write_text("0.png\n1.png\n2.png\n")
    mpsfm_core.reconstruct(
        photo_scene.images,
        config=photo_scene.config,
        image_list=listed,
        poses=photo_scene.truth,
        overrides=[f"mapping.known_poses={poses}"],
    )
    assert told == [found]


@pytest.fixture(scope="module")
def unrelated(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three photos of noise with depth files; no pair has matches."""
    folder = tmp_path_factory.mktemp("noise")
    (folder / "images").mkdir()
    rng = np.random.default_rng(0)
    for number in range(3):
        noise = rng.integers(0, 256, (240, 320, 3)).astype(np.uint8)
        cv2.imwrite(str(folder / "images" / f"{number}.png"), noise)
        np.savez(folder / f"{number}.npz", depth=np.full((60, 80), 2.0, np.float32))
    return folder


def test_failed_reconstruction_exits_with_3_and_gives_reasons(
    photo_scene, unrelated: Path, mpsfm, tmp_path: Path
) -> None:
    output = tmp_path / "out"
    (output / "sparse").mkdir(parents=True)
    (output / "sparse" / "images.bin").write_text("earlier")
    ended = mpsfm(
        "reconstruct",
        unrelated / "images",
        "--config",
        photo_scene.config,
        "--set",
        f"depth.options.directory={unrelated}",
        "--output",
        output,
        "--quiet",
    )
    assert ended.code == 3, ended.err
    assert "no reconstruction was possible from 3 images" in ended.err
    assert "summary.json" in ended.err
    summary = json.loads((output / "summary.json").read_text())
    assert summary["status"] == "failed"
    assert set(summary["images"]["unregistered"]) == {"0.png", "1.png", "2.png"}
    assert all(summary["images"]["unregistered"].values())
    assert summary["pairs"]["matched"] == 3
    assert all(pair["dropped"] for pair in summary["pairs"]["all"])
    assert (output / "sparse" / "images.bin").read_text() == "earlier"


def test_python_api_raises_if_reconstruction_fails(
    photo_scene, unrelated: Path, cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MPSFM_CACHE", str(cache))
    with pytest.raises(ReconstructionError, match="0 of 3 matched pairs") as raised:
        mpsfm_core.reconstruct(
            unrelated / "images",
            config=photo_scene.config,
            overrides=[f"depth.options.directory={unrelated}"],
        )
    assert raised.value.summary["status"] == "failed"


@pytest.mark.parametrize(
    ("answer", "code", "detail"),
    [
        ("list(range(len(pairs)))", "hook-left-out", "must return pairs of image names, got 0"),
        (
            "[(a.split('.')[0], b.split('.')[0]) for a, b in pairs]",
            "hook-left-out",
            "no candidate pair, for example ('0', '1')",
        ),
        (
            "[*pairs, ('photos/0.png', '1.png')]",
            "pairs-ignored",
            "1 of 11 selected pairs are no candidates",
        ),
        ("[]", "no-pairs-selected", "selects none of 10 candidate pairs"),
    ],
)
def test_unusable_pair_filter_is_named_in_the_summary(
    answer: str, code: str, detail: str, photo_scene, install_plugin, tmp_path: Path
) -> None:
    install_plugin(
        "mpsfm-filter",
        f"""
        from mpsfm_core import hookimpl

        @hookimpl
        def mpsfm_filter_pairs(pairs):
            return {answer}
        """,
    )
    overrides = ["runtime.on_error=skip", f"runtime.cache_dir={tmp_path / 'cache'}"]
    overrides += ["dense.enabled=false", "results.report=false"]
    with contextlib.suppress(ReconstructionError):
        mpsfm_core.reconstruct(
            photo_scene.images,
            tmp_path / "out",
            photo_scene.config,
            intrinsics=photo_scene.intrinsics,
            overrides=overrides,
        )
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    (reason,) = summary["hooks"]
    assert reason["code"] == code
    assert reason["plugin"].startswith("mpsfm-filter")
    assert reason["hook"] == "mpsfm_filter_pairs" and detail in reason["detail"]
    assert any("mpsfm-filter" in text and detail in text for text in summary["warnings"])
    selected_pairs = 0 if code == "no-pairs-selected" else 10
    assert summary["pairs"]["matched"] == selected_pairs
