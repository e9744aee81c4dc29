"""Tests of imports from and exports to formats of other programs."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
from scipy.spatial.transform import Rotation

from mpsfm_core.data import PinholeCamera
from mpsfm_core.evaluation import evaluate, read_poses
from mpsfm_core.evaluation.trajectories import read_trajectory
from mpsfm_core.testing.synthetic.scenes import arc_poses, room_scene

from .conftest import POSES_ONLY


def test_exported_database_imports_the_same_matches(photo_scene, mpsfm, tmp_path: Path) -> None:
    first = mpsfm(*photo_scene.arguments, "--output", tmp_path / "first", *POSES_ONLY)
    assert first.code == 0, first.err
    written = mpsfm("export", tmp_path / "first", "--to", "colmap-db")
    assert written.code == 0, written.err
    database = tmp_path / "first" / "exports" / "colmap-db" / "database.db"
    output = tmp_path / "second"
    imported = ("--database", database, "--output", output)
    second = mpsfm(*photo_scene.arguments, *imported, *POSES_ONLY)
    assert second.code == 0, second.err
    assert "5 of 5 images" in second.out
    summary = json.loads((output / "summary.json").read_text())
    assert summary["matches_from"] == str(database)
    assert {provider["kind"] for provider in summary["providers"]} == {"depth", "normals"}
    assert evaluate(read_poses(output), read_poses(photo_scene.truth))["auc"]["1"] > 80


def test_export_lists_formats_and_explains_errors(mpsfm, tmp_path: Path) -> None:
    listed = mpsfm("export", tmp_path)
    assert listed.code == 0
    assert "gsplat" in listed.out
    wrong = mpsfm("export", tmp_path, "--to", "gsplat")
    assert wrong.code == 2
    assert "has no COLMAP model" in wrong.err
    assert len(wrong.err.strip().splitlines()) == 1


def write_video(path: Path, poses: Sequence[np.ndarray]) -> None:
    """Write a rendered video of a room with the given poses ``cam_from_world``."""
    size, scene = (320, 240), room_scene()
    camera = PinholeCamera(*size, 384.0, 384.0, 160.0, 120.0)
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 10, size)
    for pose in poses:
        writer.write(cv2.cvtColor(scene.render(camera, pose).rgb, cv2.COLOR_RGB2BGR))
    writer.release()


@pytest.fixture
def without_network(tmp_path: Path) -> Path:
    """Return a configuration that needs no network."""
    config = tmp_path / "config.yaml"
    config.write_text(
        "features: {use: sift}\nmatcher: {use: mutual-nearest}\n"
        "depth: {use: flat}\nnormals: {use: from-depth}\n"
    )
    return config


@pytest.mark.slow
def test_video_exports_to_gsplat(mpsfm, without_network: Path, tmp_path: Path) -> None:
    """Two commands convert a video to gsplat data, without network and intrinsics."""
    video = tmp_path / "walk.avi"
    write_video(video, arc_poses(30, 2.5))
    output = tmp_path / "out"
    made = mpsfm("reconstruct", video, "--config", without_network, "--output", output)
    assert made.code == 0, made.err
    frames = sorted((output / "frames").glob("*.jpg"))
    assert 5 <= len(frames) <= 20
    exported = mpsfm("export", output, "--to", "gsplat", "--output", tmp_path / "splat")
    assert exported.code == 0, exported.err
    model = pycolmap.Reconstruction(str(tmp_path / "splat" / "sparse" / "0"))
    assert model.num_reg_images() >= 0.8 * len(frames)
    assert model.num_points3D() > 200
    for image in model.images.values():
        picture = cv2.imread(str(tmp_path / "splat" / "images" / image.name))
        assert np.ptp(picture) > 50


@pytest.mark.slow
def test_folder_of_videos_becomes_one_model(mpsfm, without_network: Path, tmp_path: Path) -> None:
    """Two videos of one place become one model, with a trajectory for each video."""
    poses, clips, output = arc_poses(30, 2.5), tmp_path / "clips", tmp_path / "out"
    clips.mkdir()
    write_video(clips / "first.avi", poses[:18])
    write_video(clips / "second.avi", poses[:11:-1])
    made = mpsfm("reconstruct", clips, "--config", without_network, "--output", output)
    assert made.code == 0, made.err
    videos = json.loads((output / "summary.json").read_text())["videos"]
    assert [Path(video["file"]).name for video in videos] == ["first.avi", "second.avi"]
    model = pycolmap.Reconstruction(str(output / "sparse"))
    registered = [str(image.name) for image in model.images.values()]
    for name, true in (("first", poses[:18]), ("second", poses[:11:-1])):
        assert sum(image.startswith(f"{name}/") for image in registered) >= 4
        found = read_trajectory(output / "trajectories" / f"{name}.txt")
        assert len(found.times) == len(true)
        truth = tmp_path / f"{name}.txt"
        inverse = [np.linalg.inv(np.vstack([pose, [0, 0, 0, 1]])) for pose in true]
        quaternions = Rotation.from_matrix([pose[:3, :3] for pose in inverse]).as_quat()
        rows = np.column_stack([found.times, [pose[:3, 3] for pose in inverse], quaternions])
        np.savetxt(truth, rows)
        report = mpsfm("evaluate", output / "trajectories" / f"{name}.txt", truth)
        assert report.code == 0, report.err
        assert json.loads(report.out)["ate_rmse"] < 0.05
