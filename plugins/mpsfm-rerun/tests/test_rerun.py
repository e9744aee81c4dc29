"""Tests of recordings, which are read with rerun's own reader."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pycolmap
import pytest

pytest.importorskip("rerun", reason="rerun-sdk is not installed")

from mpsfm_rerun.viewer import RECORDING, RerunViewer
from rerun.chunk import RrdReader

from mpsfm_core.data import DepthPrior, PinholeCamera, PosedImage, SceneState
from mpsfm_core.providers.registry import Registry
from mpsfm_core.report.viewing import ColoredPoints
from mpsfm_core.results.exports.formats import export

CAMERA = PinholeCamera(64, 48, 60.0, 60.0, 32.0, 24.0)


def scene(count: int) -> SceneState:
    depth = DepthPrior.from_arrays(np.full((12, 16), 2.0), np.full((12, 16), 1e-4))
    images = tuple(
        PosedImage(f"room/{i}.jpg", CAMERA, np.eye(3), np.array([-float(i), 0, 0]), depth)
        for i in range(count)
    )
    return SceneState(images, np.random.default_rng(0).uniform(-1, 1, (50, 3)))


def recorded(path: Path) -> dict[str, int]:
    """Return the number of rows of each entity in a recording."""
    rows: dict[str, int] = {}
    for chunk in RrdReader(str(path)).stream():
        rows[str(chunk.entity_path)] = rows.get(str(chunk.entity_path), 0) + chunk.num_rows
    return rows


def test_run_is_recorded_step_by_step(tmp_path: Path) -> None:
    viewer = RerunViewer(tmp_path, lambda name: np.zeros((12, 16, 3), np.uint8))
    registry = Registry()
    registry.register(viewer, name="viewer")
    for count in (2, 3):
        registry.call_hook("mpsfm_scene_changed", scene=lambda count=count: scene(count))
    registry.call_hook(
        "mpsfm_image_rejected", name="room/9.jpg", reason=None, text="too few matches"
    )
    assert str(tmp_path / RECORDING) in viewer.finish()
    rows = recorded(tmp_path / RECORDING)
    cameras = [path for path in rows if path.startswith("/world/cameras/") and "photo" not in path]
    assert len(cameras) == 3
    assert sum("photo" in path for path in rows) == 3
    assert rows["/world/points"] == 2, "a row a step"
    assert rows["/log"] == 1


def test_cameras_photos_and_depth_maps_are_recorded_at_their_places(tmp_path: Path) -> None:
    viewer = RerunViewer(tmp_path, lambda name: np.full((24, 32, 3), 90, np.uint8))
    viewer.show(scene(3))
    viewer.finish()
    recording = tmp_path / RECORDING
    camera = values_of(recording, r"/world/cameras/room\/2.jpg")
    assert camera["Transform3D:translation"] == [[2, 0, 0]]
    photo = values_of(recording, r"/world/cameras/room\/2.jpg/photo")
    assert photo["Pinhole:resolution"] == [[32, 24]]
    columns = photo["Pinhole:image_from_camera"][0]
    np.testing.assert_allclose(columns, [30, 0, 0, 0, 30, 0, 16, 12, 1])
    blob = np.array(photo["EncodedImage:blob"][0], np.uint8)
    shown = cv2.imdecode(blob, cv2.IMREAD_COLOR)
    assert shown.shape == (24, 32, 3) and abs(int(shown.mean()) - 90) <= 2
    points = np.array(values_of(recording, r"/world/depth/room\/2.jpg")["Points3D:positions"])
    np.testing.assert_allclose(points[:, 2], 2, atol=1e-2)
    assert points[:, 0].min() < 2 < points[:, 0].max(), "in front of the camera at x = 2"


def test_removed_images_are_cleared_with_their_depth_maps(tmp_path: Path) -> None:
    viewer = RerunViewer(tmp_path, lambda name: None)
    viewer.show(scene(3))
    viewer.show(scene(2))
    viewer.finish()
    cleared = {entity for step, entity in clears(tmp_path / RECORDING) if step == 2}
    assert cleared == {r"/world/cameras/room\/2.jpg", r"/world/depth/room\/2.jpg"}


def test_final_cloud_replaces_the_depth_maps(tmp_path: Path) -> None:
    viewer = RerunViewer(tmp_path, lambda name: None)
    viewer.show(scene(2))
    viewer.show(scene(2), ColoredPoints(np.zeros((4, 3)), np.zeros((4, 3), np.uint8)))
    viewer.finish()
    rows = recorded(tmp_path / RECORDING)
    assert rows["/world/dense"] == 1
    assert rows[r"/world/depth/room\/0.jpg"] == 1, "only in the first step"
    assert clears(tmp_path / RECORDING) == {(2, "/world/depth")}


def clears(path: Path) -> set[tuple[int, str]]:
    """Return the steps and entities at which a recording clears an entity and its children."""
    found = set()
    for chunk in RrdReader(str(path)).stream():
        batch = chunk.to_record_batch()
        if "Clear:is_recursive" in batch.schema.names:
            found |= {(step, str(chunk.entity_path)) for step in batch["step"].to_pylist()}
    return found


def values_of(path: Path, entity: str) -> dict[str, Any]:
    """Return the values of each component in the only row of an entity, by component."""
    return {
        name: column.to_pylist()[0]
        for chunk in RrdReader(str(path)).stream()
        if str(chunk.entity_path) == entity
        for name, column in zip(
            chunk.to_record_batch().schema.names, chunk.to_record_batch().columns, strict=True
        )
        if ":" in name
    }


def test_exported_model_has_images_and_depth_maps(tmp_path: Path) -> None:
    """Check exported images and depth maps, and gravity along -z."""
    pycolmap.set_random_seed(0)
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_cameras_per_rig = 1, 1
    options.num_frames_per_rig, options.num_points3D = 3, 20
    model = pycolmap.synthesize_dataset(options)
    for folder in ("sparse", "images", "depth"):
        (tmp_path / folder).mkdir()
    model.write(str(tmp_path / "sparse"))
    names = sorted(image.name for image in model.images.values())
    for name in names:
        cv2.imwrite(str(tmp_path / "images" / name), np.full((60, 80, 3), 90, np.uint8))
    depth = np.full((6, 8), 2.0, np.float32)
    depth[0] = 4.0
    np.savez(
        tmp_path / "depth" / f"{names[0]}.npz",
        depth=depth,
        variance=np.full((6, 8), 1e-4, np.float32),
        valid=np.arange(48).reshape(6, 8) != 47,
        camera=[9.0, 9.0, 4.0, 3.0],
    )
    half = np.sqrt(0.5)
    (tmp_path / "trajectory.txt").write_text(
        f"# timestamp tx ty tz qx qy qz qw\n0.5 0 0 0 0 0 0 1\n1.0 1 2 3 0 0 {half} {half}\n"
    )
    (tmp_path / "trajectories").mkdir()
    (tmp_path / "trajectories" / "hall.txt").write_text("0 0 0 0 0 0 0 1\n1 1 0 0 0 0 0 1\n")
    described = export(tmp_path, "rerun")
    assert described["orientation"].startswith("z is up")
    recording = tmp_path / "exports" / "rerun" / RECORDING
    rows = recorded(recording)
    assert sum(path.endswith("/photo") for path in rows) == 3
    assert [path for path in rows if path.startswith("/depth/")] == [f"/depth/{names[0]}"]
    assert values_of(recording, "/world")["ViewCoordinates:xyz"] == [[3, 5, 1]]  # right, back, up
    world_from_model = np.array(described["world_from_model"])
    points = np.array([model.points3D[i].xyz for i in sorted(model.points3D)])
    turned = points @ world_from_model[:, :3].T + world_from_model[:, 3]
    (video,) = (
        chunk.to_record_batch()
        for chunk in RrdReader(str(recording)).stream()
        if str(chunk.entity_path) == "/world/video_camera" and not chunk.is_static
    )
    assert [time.total_seconds() for time in video["time"].to_pylist()] == [0.5, 1.0]
    assert {"/world/video_camera/hall", "/world/trajectory/hall"} <= rows.keys()
    moved = np.array([[0, 0, 0], [1, 2, 3]]) @ world_from_model[:, :3].T + world_from_model[:, 3]
    centers = np.array([c[0] for c in video["Transform3D:translation"].to_pylist()])
    np.testing.assert_allclose(centers, moved, atol=1e-5)
    scale = np.cbrt(np.linalg.det(world_from_model[:, :3]))
    quarter = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]])
    for column, turn in zip(
        video["Transform3D:mat3x3"].to_pylist(), (np.eye(3), quarter), strict=True
    ):
        rotation = np.reshape(column[0], (3, 3)).T  # columns first
        np.testing.assert_allclose(rotation, world_from_model[:, :3] / scale @ turn, atol=1e-5)
    shown = values_of(recording, "/world/dense")
    np.testing.assert_allclose(shown["Points3D:positions"], turned, atol=1e-5)
    kept = values_of(recording, f"/depth/{names[0]}")
    steps = np.array(kept["DepthImage:buffer"][0], np.uint8).view(np.uint16).reshape(6, 8)
    expected = np.where(np.arange(48).reshape(6, 8) == 47, 0, depth)
    np.testing.assert_allclose(steps / kept["DepthImage:meter"][0], expected, rtol=1e-4)
