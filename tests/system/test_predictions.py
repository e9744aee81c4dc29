"""Test that estimated memory and disk space agree with measured values."""

from __future__ import annotations

import json
import shutil
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from mpsfm_core.testing.synthetic.scenes import arc_poses, room_scene

from .conftest import CAMERA


@pytest.fixture(scope="module")
def two_rooms(photo_scene, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Photos of the scene, and the same number of photos of another room."""
    folder = tmp_path_factory.mktemp("rooms")
    for name in ("images", "depth"):
        shutil.copytree(photo_scene.folder / name, folder / name)
    room = room_scene(seed=1)
    for number, pose in enumerate(arc_poses(5, 15.0)):
        rendering = room.render(CAMERA, pose)
        cv2.imwrite(str(folder / "images" / f"other-{number}.png"), rendering.rgb[..., ::-1])
        np.savez(folder / "depth" / f"other-{number}.npz", depth=rendering.depth)
    return folder


@pytest.mark.slow
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="was measured on Linux")
@pytest.mark.parametrize("groups", [1, 2])
def test_measured_resources_agree_with_estimate(
    photo_scene, two_rooms: Path, mpsfm, tmp_path: Path, groups: int
) -> None:
    folder = photo_scene.folder if groups == 1 else two_rooms
    arguments = ["reconstruct", folder / "images", "--config", photo_scene.config]
    arguments += ["--intrinsics", photo_scene.intrinsics, "--output", tmp_path]
    settings = (
        f"depth.options.directory={folder / 'depth'}",
        "features.options.max_keypoints=1024",
    )
    mpsfm(*arguments, *(text for setting in settings for text in ("--set", setting)))
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert [part["images"] for part in summary["reconstructions"]] == [5] * groups
    said, took = (summary["resources"][key] for key in ("predicted", "measured"))
    assert took["memory_mb"] < 1.3 * said["memory_mb"]
    if groups == 1:
        assert took["memory_mb"] > said["memory_mb"] / 1.3
        assert 1 / 3 < took["output_mb"] / said["output_mb"] < 3
