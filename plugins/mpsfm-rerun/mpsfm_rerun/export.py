"""``mpsfm export DIR --to rerun``: a finished reconstruction as one recording."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from mpsfm_core.data import PosedImage, SceneState
from mpsfm_core.report.viewing import Cloud, photos_in, scene_of, views_in
from mpsfm_core.results.exports.source import Source
from mpsfm_rerun.viewer import RerunViewer


def write(source: Source, folder: Path) -> None:
    """Write ``scene.rrd``.

    Photos and depth maps are in it as far as they are to be had: a COLMAP model alone has none.
    """
    scene, _ = scene_of(source.model)
    images = tuple(_with_depth(source, image) for image in scene.images)
    if source.summary or source.photos is None:
        pictures = views_in(source.folder)
    else:
        pictures = photos_in(source.photos)
    viewer = RerunViewer(folder, pictures, z_is_up=source.z_is_up)
    viewer.show(SceneState(images, scene.points), Cloud(*source.dense_points()))
    viewer.finish()


def _with_depth(source: Source, image: PosedImage) -> PosedImage:
    """With its refined depth, and the camera of that."""
    maps = source.maps(image.name)
    return image if maps is None else replace(image, camera=maps.camera, depth=maps.depth)
