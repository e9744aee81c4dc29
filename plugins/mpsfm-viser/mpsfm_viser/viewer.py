"""Browser viewer of the current reconstruction, with a server in the running process."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable
from pathlib import Path
from urllib.parse import quote

import numpy as np
import viser
import viser.transforms

from mpsfm_core import hookimpl
from mpsfm_core.data import PosedImage, SceneState
from mpsfm_core.geometry import camera_center
from mpsfm_core.report.viewing import ColoredPoints, Pictures, unproject_depth_map

PORT_VARIABLE = "MPSFM_VIEWER_PORT"
"""Environment variable with the port of the viewer's web page. If the port is taken, the viewer
uses the next free port."""
HOST_VARIABLE = "MPSFM_VIEWER_HOST"
"""Environment variable with the host address. 0.0.0.0 allows access from other machines."""
_LEAST_SECONDS = 1.0
"""Minimum time in seconds between two updates of the scene during a reconstruction. [ours]"""
_NEW, _OLD = (255, 122, 26), (31, 157, 107)


class ViserViewer:
    """Viewer of camera frustums with images, depth maps as points, and sparse points.

    The viewer does not write to ``output``, the output folder of the reconstruction.
    """

    def __init__(self, output: Path, pictures: Pictures) -> None:
        self.server = viser.ViserServer(
            host=os.environ.get(HOST_VARIABLE, "127.0.0.1"),
            port=int(os.environ.get(PORT_VARIABLE, "8080")),
            label="MP-SfM",
            verbose=False,
        )
        self._pictures = pictures
        self._thumbnails: dict[str, object] = {}
        self._shown: set[str] = set()
        self._last = -np.inf
        self._lock = threading.Lock()
        self._state = self.server.gui.add_markdown("waiting for the first images")
        self._point_size = self.server.gui.add_slider("point size", 0.1, 5.0, 0.1, 1.0)
        self._frustum_size = self.server.gui.add_slider("camera size", 0.1, 5.0, 0.1, 1.0)
        self.clouds: list[viser.PointCloudHandle] = []
        self.frustums: dict[str, viser.CameraFrustumHandle] = {}
        self._unit = 1.0
        self._point_size.on_update(lambda _: self._resize())
        self._frustum_size.on_update(lambda _: self._resize())

    @property
    def address(self) -> str:
        """Return the local address of the viewer's web page."""
        return f"http://localhost:{self.server.get_port()}"

    @hookimpl
    def mpsfm_scene_changed(self, scene: Callable[[], SceneState]) -> None:
        """Show the scene, unless the last update was less than a second ago."""
        now = time.monotonic()
        if now - self._last >= _LEAST_SECONDS:
            self._last = now
            self.show(scene())

    @hookimpl
    def mpsfm_stage_started(self, stage: str, total: int | None) -> None:
        """Show the name of the current stage until the first scene is shown."""
        if not self._shown:
            self._state.content = f"{stage} ..."

    @hookimpl
    def mpsfm_stage_progress(self, stage: str, done: int, total: int) -> None:
        """Show the progress of the current stage until the first scene is shown."""
        if not self._shown:
            self._state.content = f"{stage}: {done} of {total}"

    def show(self, scene: SceneState, cloud: ColoredPoints | None = None) -> None:
        """Show a new scene, with the points of ``cloud`` or else of the depth maps."""
        with self._lock, self.server.atomic():
            self._unit = _unit(scene)
            while self.clouds:
                self.clouds.pop().remove()
            for name in self.frustums.keys() - {image.name for image in scene.images}:
                self.frustums.pop(name).remove()
            for image in scene.images:
                self.frustums[image.name] = self._frustum(image)
                if cloud is None:
                    self._cloud(
                        f"/depth/{_key(image.name)}",
                        unproject_depth_map(image, self._picture(image)),
                    )
            if cloud is None:
                grey = np.full(scene.points.shape, 200, np.uint8)
                self._cloud("/sparse", ColoredPoints(scene.points, grey))
            else:
                self._cloud("/dense", cloud)
            self._shown = set(self.frustums)
            self._state.content = f"**{len(scene.images)} images**, {len(scene.points):,} points"
            if scene.images:
                up = -np.sum([image.rotation[1] for image in scene.images], axis=0)
                if np.linalg.norm(up) > 0:
                    self.server.scene.set_up_direction(tuple(up / np.linalg.norm(up)))
            self._resize()

    def finish(self) -> str:
        """Return the address of the page, which stays open until the program ends."""
        return f"{self.address} shows it"

    def wait(self) -> None:
        """Wait until Ctrl-C."""
        threading.Event().wait()

    def _frustum(self, image: PosedImage) -> viser.CameraFrustumHandle:
        camera = image.camera
        wxyz = viser.transforms.SO3.from_matrix(image.rotation.T).wxyz
        handle = self.server.scene.add_camera_frustum(
            f"/cameras/{_key(image.name)}",
            fov=2 * float(np.arctan2(camera.height / 2, camera.fy)),
            aspect=camera.width / camera.height,
            scale=0.1 * self._unit,
            color=_OLD if image.name in self._shown else _NEW,
            image=self._picture(image),
            wxyz=wxyz,
            position=camera_center(image.rotation, image.translation),
        )

        @handle.on_click
        def _(event: viser.SceneNodePointerEvent[viser.CameraFrustumHandle]) -> None:
            """Move the viewer's camera to the pose of the clicked frustum."""
            event.client.camera.wxyz = handle.wxyz
            event.client.camera.position = handle.position

        return handle

    def _cloud(self, name: str, cloud: ColoredPoints) -> None:
        handle = self.server.scene.add_point_cloud(
            name,
            cloud.xyz.astype(np.float32),
            cloud.rgb,
            point_size=0.005 * self._unit,
            point_shading="flat",
        )
        self.clouds.append(handle)

    def _picture(self, image: PosedImage) -> np.ndarray | None:
        if image.name not in self._thumbnails:
            self._thumbnails[image.name] = self._pictures(image.name)
        return self._thumbnails[image.name]

    def _resize(self) -> None:
        for cloud in self.clouds:
            cloud.point_size = 0.005 * self._unit * self._point_size.value
        for frustum in self.frustums.values():
            frustum.scale = 0.1 * self._unit * self._frustum_size.value


def _unit(scene: SceneState) -> float:
    """Compute the scale of the scene, the median distance of points and cameras from the center."""
    centers = [camera_center(image.rotation, image.translation) for image in scene.images]
    places = np.array([*scene.points[:: max(1, len(scene.points) // 2000)], *centers])
    if not len(places):
        return 1.0
    distances = np.linalg.norm(places - np.median(places, axis=0), axis=1)
    return float(np.median(distances)) or 1.0


def _key(name: str) -> str:
    """Convert an image name to one level of the scene tree of viser."""
    return quote(name, safe="")
