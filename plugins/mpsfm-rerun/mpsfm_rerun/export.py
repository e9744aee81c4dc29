"""Export of a finished reconstruction for ``mpsfm export DIR --to rerun``."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from mpsfm_core.data import PosedImage, SceneState
from mpsfm_core.report.viewing import (
    ColoredPoints,
    pictures_from_photos,
    pictures_from_results,
    scene_from_model,
)
from mpsfm_core.results.exports.source import ExportSource
from mpsfm_rerun.viewer import RerunViewer


def write(source: ExportSource, folder: Path) -> None:
    """Write the recording ``scene.rrd``, with images, depth maps and video if available."""
    scene, _ = scene_from_model(source.model)
    images = tuple(_with_depth(source, image) for image in scene.images)
    if source.summary or source.photos is None:
        pictures = pictures_from_results(source.folder)
    else:
        pictures = pictures_from_photos(source.photos)
    viewer = RerunViewer(folder, pictures, z_is_up=source.z_is_up)
    viewer.show(SceneState(images, scene.points), ColoredPoints(*source.dense_points()))
    for name, trajectory in source.trajectories().items() if images else ():
        camera = next((i.camera for i in images if i.name.startswith(f"{name}/")), images[0].camera)
        viewer.show_trajectory(name, *trajectory, camera)
    viewer.finish()


def _with_depth(source: ExportSource, image: PosedImage) -> PosedImage:
    """Add the refined depth map of an image and the camera of the depth map to a recording."""
    maps = source.maps(image.name)
    return image if maps is None else replace(image, camera=maps.camera, depth=maps.depth)
