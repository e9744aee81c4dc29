"""Tests of imports from and exports to formats of other programs."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest

from mpsfm_core.data import PinholeCamera
from mpsfm_core.evaluation import evaluate, read_poses
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


@pytest.mark.slow
def test_video_exports_to_gsplat(mpsfm, tmp_path: Path) -> None:
    """Two commands convert a video to gsplat data, without network and intrinsics."""
    size = (320, 240)
    camera = PinholeCamera(*size, 384.0, 384.0, 160.0, 120.0)
    scene = room_scene()
    video = tmp_path / "walk.avi"
    writer = cv2.VideoWriter(str(video), cv2.VideoWriter_fourcc(*"MJPG"), 10, size)
    for pose in arc_poses(30, 2.5):
        writer.write(cv2.cvtColor(scene.render(camera, pose).rgb, cv2.COLOR_RGB2BGR))
    writer.release()
    config = tmp_path / "config.yaml"
    config.write_text(
        "features: {use: sift}\nmatcher: {use: mutual-nearest}\n"
        "depth: {use: flat}\nnormals: {use: from-depth}\n"
    )
    output = tmp_path / "out"
    made = mpsfm("reconstruct", video, "--config", config, "--output", output)
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
