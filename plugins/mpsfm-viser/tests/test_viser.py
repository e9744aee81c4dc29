"""Tests of a running viser server: its web page and its scene."""

from __future__ import annotations

import struct
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("viser", reason="viser is not installed")
import msgspec
import viser
import websockets.sync.client
import zstandard
from mpsfm_viser.viewer import ViserViewer

from mpsfm_core.data import DepthPrior, PinholeCamera, PosedImage, SceneState
from mpsfm_core.providers.registry import Registry
from mpsfm_core.report.viewing import ColoredPoints

CAMERA = PinholeCamera(64, 48, 60.0, 60.0, 32.0, 24.0)
pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning")


def scene(count: int) -> SceneState:
    depth = DepthPrior.from_arrays(np.full((12, 16), 2.0), np.full((12, 16), 1e-4))
    images = tuple(
        PosedImage(f"room/{i}.jpg", CAMERA, np.eye(3), np.array([-float(i), 0, 0]), depth)
        for i in range(count)
    )
    return SceneState(images, np.random.default_rng(0).uniform(-1, 1, (50, 3)))


@pytest.fixture
def viewer(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[ViserViewer]:
    monkeypatch.setenv("MPSFM_VIEWER_PORT", "18765")
    made = ViserViewer(tmp_path, lambda name: np.zeros((12, 16, 3), np.uint8))
    yield made
    made.server.stop()


def test_web_page_is_served(viewer: ViserViewer) -> None:
    with urllib.request.urlopen(viewer.address, timeout=20) as page:
        assert page.status == 200
        assert b"<html" in page.read()
    assert viewer.address in viewer.finish()


def messages_to_browser(viewer: ViserViewer) -> dict[str, dict[str, Any]]:
    """Connect as viser's web page does; return the received messages by type and scene node."""
    address = viewer.address.replace("http:", "ws:")
    protocol = [f"viser-v{viser.__version__}"]
    with websockets.sync.client.connect(address, subprotocols=protocol, max_size=None) as socket:
        data = socket.recv(timeout=20)
    _, size = struct.unpack("<QQ", data[:16])  # sizes with and without decompression
    packed = zstandard.ZstdDecompressor().decompress(data[16 : 16 + size])
    messages: dict[str, dict[str, Any]] = {}
    for message in msgspec.msgpack.decode(packed)["messages"]:
        messages.setdefault(message["type"], {})[message.get("name", "")] = message
    return messages


def test_browser_receives_cameras_photos_and_points(viewer: ViserViewer) -> None:
    viewer.show(scene(3))
    messages = messages_to_browser(viewer)
    cameras = messages["CameraFrustumMessage"]
    assert cameras.keys() == {f"/cameras/room%2F{i}.jpg" for i in range(3)}
    props = cameras["/cameras/room%2F2.jpg"]["props"]
    assert props["fov"] == pytest.approx(2 * np.arctan(24 / 60))
    assert props["_image_data"] is not None
    np.testing.assert_allclose(
        messages["SetPositionMessage"]["/cameras/room%2F2.jpg"]["position"], [2, 0, 0]
    )
    assert messages["PointCloudMessage"].keys() == {
        "/sparse",
        *(f"/depth/room%2F{i}.jpg" for i in range(3)),
    }


def test_scene_has_cameras_and_depth_maps(viewer: ViserViewer) -> None:
    viewer.show(scene(3))
    assert viewer.frustums.keys() == {f"room/{i}.jpg" for i in range(3)}
    np.testing.assert_allclose(viewer.frustums["room/2.jpg"].position, [2, 0, 0])
    assert viewer.frustums["room/2.jpg"].aspect == pytest.approx(64 / 48)
    names = {cloud.name for cloud in viewer.clouds}
    assert names == {"/sparse", *(f"/depth/room%2F{i}.jpg" for i in range(3))}
    (depth,) = (cloud for cloud in viewer.clouds if cloud.name == "/depth/room%2F0.jpg")
    np.testing.assert_allclose(np.asarray(depth.points)[:, 2], 2, atol=1e-2)


def test_removed_images_are_removed_from_the_scene(viewer: ViserViewer) -> None:
    viewer.show(scene(3))
    viewer.show(scene(2))
    assert viewer.frustums.keys() == {"room/0.jpg", "room/1.jpg"}
    assert len(viewer.clouds) == 3


def test_final_cloud_replaces_the_depth_maps(viewer: ViserViewer) -> None:
    viewer.show(scene(2))
    before = list(viewer.clouds)
    viewer.show(scene(2), ColoredPoints(np.zeros((4, 3)), np.zeros((4, 3), np.uint8)))
    assert [cloud.name for cloud in viewer.clouds] == ["/dense"]
    for cloud in before:
        with pytest.warns(UserWarning, match="removed"):
            cloud.remove()


def test_viewer_receives_the_events_of_a_run(viewer: ViserViewer) -> None:
    registry = Registry()
    registry.register(viewer, name="viewer")
    registry.call_hook("mpsfm_stage_progress", stage="matching", done=3, total=28)
    assert viewer._state.content == "matching: 3 of 28"
    registry.call_hook("mpsfm_scene_changed", scene=lambda: scene(2))
    assert len(viewer.frustums) == 2
    registry.call_hook("mpsfm_scene_changed", scene=lambda: scene(3))
    assert len(viewer.frustums) == 2, "the last one was just now"
