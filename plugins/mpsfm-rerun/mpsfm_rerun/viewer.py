"""Recording of a growing reconstruction, image by image."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import rerun

from mpsfm_core import hookimpl
from mpsfm_core.data import DepthPrior, Float64, PinholeCamera, PosedImage, SceneState
from mpsfm_core.report.viewing import (
    ColoredPoints,
    Pictures,
    select_certain_pixels,
    unproject_depth_map,
)

RECORDING = "scene.rrd"
TIMELINE = "step"
VIDEO_TIMELINE = "time"
VIDEO_CAMERA = "world/video_camera"
TRAJECTORY = "world/trajectory"
_DEPTH = "world/depth"


class RerunViewer:
    """Viewer that writes the recording ``OUTPUT/scene.rrd``.

    Each recorded scene is a step of rerun's timeline ``step``; the cameras of videos move along
    the timeline ``time``. If ``z_is_up`` is True, the z axis of the recorded world points up. If
    ``z_is_up`` is False, the y axis of the recorded world points down, as in the camera frame.
    """

    def __init__(self, output: Path, pictures: Pictures, z_is_up: bool = False) -> None:
        output.mkdir(parents=True, exist_ok=True)
        self.path = output / RECORDING
        self._recording = rerun.RecordingStream("mpsfm")
        self._recording.save(self.path)
        axes = rerun.ViewCoordinates
        up = axes.RIGHT_HAND_Z_UP if z_is_up else axes.RIGHT_HAND_Y_DOWN
        self._recording.log("world", up, static=True)
        self._pictures = pictures
        self._step = 0
        self._shown: set[str] = set()

    @hookimpl
    def mpsfm_scene_changed(self, scene: Callable[[], SceneState]) -> None:
        """Record the current scene as a step of rerun's timeline."""
        self.show(scene())

    @hookimpl
    def mpsfm_notice(self, text: str) -> None:
        """Record a message in the log of the recording."""
        self._recording.log("log", rerun.TextLog(text))

    @hookimpl
    def mpsfm_image_rejected(self, name: str, text: str) -> None:
        """Record the rejection of an image in the log of the recording."""
        self._recording.log("log", rerun.TextLog(f"{name}: {text}", level=rerun.TextLogLevel.WARN))

    def show(self, scene: SceneState, cloud: ColoredPoints | None = None) -> None:
        """Record a scene as next step, with points from depth maps unless ``cloud`` is given."""
        self._step += 1
        self._recording.set_time(TIMELINE, sequence=self._step)
        names = {image.name for image in scene.images}
        for name in self._shown - names:
            self._recording.log(_place(name), rerun.Clear(recursive=True))
            self._recording.log(_depth_place(name), rerun.Clear(recursive=True))
        if cloud is not None:
            self._recording.log(_DEPTH, rerun.Clear(recursive=True))
        for image in scene.images:
            self._log_image(image, as_points=cloud is None)
        self._recording.log("world/points", rerun.Points3D(scene.points))
        if cloud is not None:
            self._recording.log("world/dense", rerun.Points3D(cloud.xyz, colors=cloud.rgb))
        self._shown = names

    def show_trajectory(
        self,
        video: str,
        times: Float64,
        centers: Float64,
        rotations: Float64,
        camera: PinholeCamera,
    ) -> None:
        """Record the path of a video, and its camera at each time of rerun's timeline ``time``.

        Args:
            video: Name of the video, which is empty for a single video.
            times: (n,) time stamps in seconds.
            centers: (n, 3) camera centers in the world.
            rotations: (n, 3, 3) rotations ``world_from_cam``.
            camera: Camera of the video.
        """
        path, place = rerun.LineStrips3D([centers]), _child(VIDEO_CAMERA, video)
        self._recording.log(_child(TRAJECTORY, video), path, static=True)
        pinhole = rerun.Pinhole(
            image_from_camera=camera.matrix,
            resolution=camera.size,
            camera_xyz=rerun.ViewCoordinates.RDF,
        )
        self._recording.log(place, pinhole, static=True)
        self._recording.send_columns(
            place,
            indexes=[rerun.TimeColumn(VIDEO_TIMELINE, duration=times)],
            columns=rerun.Transform3D.columns(translation=centers, mat3x3=rotations),
        )

    def finish(self) -> str:
        """Close the file."""
        self._recording.flush()
        self._recording.disconnect()
        return f"open it with: rerun {self.path}"

    def wait(self) -> None:
        """Do nothing, because a recording has no window to wait for."""

    def _log_image(self, image: PosedImage, *, as_points: bool) -> None:
        place, camera = _place(image.name), image.camera
        world_from_camera = rerun.Transform3D(
            translation=-image.rotation.T @ image.translation, mat3x3=image.rotation.T
        )
        self._recording.log(place, world_from_camera)
        pinhole = rerun.Pinhole(
            image_from_camera=camera.matrix,
            resolution=camera.size,
            camera_xyz=rerun.ViewCoordinates.RDF,
        )
        picture = self._pictures(image.name)
        if image.name not in self._shown and picture is not None:
            scale = np.diag([picture.shape[1] / camera.width, picture.shape[0] / camera.height, 1])
            pinhole = rerun.Pinhole(
                image_from_camera=scale @ camera.matrix,
                resolution=(picture.shape[1], picture.shape[0]),
                camera_xyz=rerun.ViewCoordinates.RDF,
            )
            self._recording.log(f"{place}/photo", rerun.Image(picture).compress(), static=True)
        if image.name not in self._shown:
            self._recording.log(f"{place}/photo", pinhole, static=True)
        if image.depth is not None and not as_points:
            self._recording.log(f"depth/{_key(image.name)}", _depth_image(image.depth))
        elif as_points:
            points = unproject_depth_map(image, picture)
            shown = rerun.Points3D(points.xyz, colors=points.rgb)
            self._recording.log(_depth_place(image.name), shown)


def _depth_image(depth: DepthPrior) -> rerun.DepthImage:
    """Convert depth to a 16-bit image, with 0 where the variance is large."""
    shown = np.where(select_certain_pixels(depth), depth.depth, 0.0)
    steps = np.iinfo(np.uint16).max / max(float(shown.max()), 1e-12)
    return rerun.DepthImage(np.round(shown * steps).astype(np.uint16), meter=steps)


def _place(name: str) -> str:
    return f"world/cameras/{_key(name)}"


def _depth_place(name: str) -> str:
    return f"{_DEPTH}/{_key(name)}"


def _child(place: str, video: str) -> str:
    """Return the entity path of a video, which is the place itself for a single video."""
    return f"{place}/{_key(video)}" if video else place


def _key(name: str) -> str:
    """Convert the name of an image or video to one part of an entity path of rerun."""
    return str(rerun.escape_entity_path_part(name))
