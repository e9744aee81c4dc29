"""A recording, read again by rerun's own reader."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rerun", reason="rerun-sdk is not installed")

from mpsfm_rerun.viewer import RECORDING, RerunViewer
from rerun.chunk import RrdReader

from mpsfm_core.data import DepthPrior, PinholeCamera, PosedImage, SceneState
from mpsfm_core.registry import Registry
from mpsfm_core.viewing import Cloud

CAMERA = PinholeCamera(64, 48, 60.0, 60.0, 32.0, 24.0)


def scene(count: int) -> SceneState:
    depth = DepthPrior.from_arrays(np.full((12, 16), 2.0), np.full((12, 16), 1e-4))
    images = tuple(
        PosedImage(f"room/{i}.jpg", CAMERA, np.eye(3), np.array([-float(i), 0, 0]), depth)
        for i in range(count)
    )
    return SceneState(images, np.random.default_rng(0).uniform(-1, 1, (50, 3)))


def recorded(path: Path) -> dict[str, int]:
    """Entity -> number of rows."""
    rows: dict[str, int] = {}
    for chunk in RrdReader(str(path)).stream():
        rows[str(chunk.entity_path)] = rows.get(str(chunk.entity_path), 0) + chunk.num_rows
    return rows


def test_a_run_is_recorded_step_by_step(tmp_path: Path) -> None:
    viewer = RerunViewer(tmp_path, lambda name: np.zeros((12, 16, 3), np.uint8))
    registry = Registry()
    registry.register(viewer, name="viewer")
    for count in (2, 3):
        registry.call_hook("mpsfm_scene_changed", scene=lambda count=count: scene(count))
    registry.call_hook("mpsfm_image_rejected", name="room/9.jpg", reason="too few matches")
    assert str(tmp_path / RECORDING) in viewer.finish()
    rows = recorded(tmp_path / RECORDING)
    cameras = [path for path in rows if path.startswith("/world/cameras/") and "photo" not in path]
    assert len(cameras) == 3
    assert sum("photo" in path for path in rows) == 3
    assert rows["/world/points"] == 2, "a row a step"
    assert rows["/log"] == 1


def test_a_finished_scene_is_recorded_with_its_cloud(tmp_path: Path) -> None:
    viewer = RerunViewer(tmp_path, lambda name: None)
    viewer.show(scene(2), Cloud(np.zeros((4, 3)), np.zeros((4, 3), np.uint8)))
    viewer.finish()
    rows = recorded(tmp_path / RECORDING)
    assert rows["/world/dense"] == 1
    assert not any("depth" in path for path in rows)
