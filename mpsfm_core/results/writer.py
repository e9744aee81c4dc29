"""Write the result folder and replace earlier results atomically.

::

    OUTPUT/sparse/          COLMAP model of the original images, binary
           sparse_text/     the same model as text (results.text_model)
           components/N/    models of further components, largest first, each with depth/ and
                            dense.ply
           undistorted/     images/ and sparse/ with pinhole cameras, if an image is distorted or
                            rotated by EXIF
           points.ply       triangulated points of the largest component
           dense.ply        fused depth maps
           depth/NAME.npz   refined depth, variance and camera of each registered image
           mesh.ply, .glb   surface mesh, made after the run from the depth maps
           transforms.json  cameras for nerfstudio (results.nerfstudio)
           views/           small views, priors and matches of all images, for the report
           summary.json     configuration, results, and reasons of missing images
"""

from __future__ import annotations

import json
import logging
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, TypeVar

import pycolmap

from mpsfm_core.data import UInt8
from mpsfm_core.data.result_layout import (
    COMPONENTS,
    DENSE,
    DEPTH,
    ENTRIES,
    POINTS,
    REPORT,
    SPARSE,
    SPARSE_TEXT,
    SUMMARY,
    TRANSFORMS,
    UNDISTORTED,
    VIEWS,
)
from mpsfm_core.dense.fusion import fuse_depth_maps
from mpsfm_core.geometry.pycolmap_conversion import colmap_from_pinhole
from mpsfm_core.mapping.scene.reconstruction import Reconstruction
from mpsfm_core.results.colmap_model import average_point_colors, build_model, write_model
from mpsfm_core.results.depth_maps import write_depth_maps
from mpsfm_core.results.options import ResultOptions
from mpsfm_core.results.original_images import OriginalImages, exported_image_name
from mpsfm_core.results.ply import write_cloud, write_ply
from mpsfm_core.results.trajectory import TrajectoryFrame, write_trajectory
from mpsfm_core.results.transforms_json import supports_camera, write_transforms
from mpsfm_core.results.views import write_views
from mpsfm_core.support.files import replace_entries, write_file

_log = logging.getLogger(__name__)

Summary = TypeVar("Summary", bound=Mapping[str, Any])


@dataclass(frozen=True, eq=False)
class ComponentResult:
    """Reconstruction of one component with its COLMAP model."""

    reconstruction: Reconstruction
    """Poses, 3D points and refined depth maps of the component."""
    colors: UInt8
    """(p, 3) uint8 RGB colors of the 3D points."""
    model: pycolmap.Reconstruction
    """COLMAP model of the component for the original images."""

    @classmethod
    def of(cls, reconstruction: Reconstruction, photos: OriginalImages) -> ComponentResult:
        """Color the 3D points and build the COLMAP model of the original images."""
        colors = average_point_colors(reconstruction, photos.keypoints(reconstruction), photos.view)
        cameras = [photos.original_camera(image) for image in reconstruction.images]
        keypoints = photos.original_keypoints(reconstruction)
        model = build_model(reconstruction, cameras, keypoints, colors)
        return cls(reconstruction, colors, model)

    def undistorted(self, photos: OriginalImages) -> pycolmap.Reconstruction:
        """Build the COLMAP model of the undistorted images."""
        cameras = [colmap_from_pinhole(image.camera) for image in self.reconstruction.images]
        keypoints = photos.keypoints(self.reconstruction)
        images = (replace(i, name=exported_image_name(i.name)) for i in self.reconstruction.images)
        renamed = replace(self.reconstruction, images=tuple(images))
        return build_model(renamed, cameras, keypoints, self.colors)


def write_results(
    output: Path,
    components: Sequence[ComponentResult],
    photos: OriginalImages,
    options: ResultOptions,
    summarize: Callable[[], Summary],
    seed: int = 0,
    trajectories: Mapping[str, Sequence[TrajectoryFrame]] = MappingProxyType({}),
) -> Summary:
    """Write the results of a successful run.

    Args:
        output: result folder.
        components: reconstructed components, at least one, largest first.
        photos: original images.
        options: selection of the files to write.
        summarize: function that returns the content of ``summary.json``, called after all other
            files are written.
        seed: random seed of the selection of pixels for ``dense.ply``.
        trajectories: localized frames of each video, whose name is empty for a single video.

    Returns:
        Content of the written file ``summary.json``.

    Raises:
        OSError: as :func:`mpsfm_core.support.files.replace_entries`.
    """
    largest, others = components[0], components[1:]
    with replace_entries(output, ENTRIES) as folder:
        write_model(folder / SPARSE, largest.model)
        if options.text_model:
            _write_text_model(folder / SPARSE_TEXT, largest.model)
        for number, component in enumerate(others, start=1):
            subfolder = folder / COMPONENTS / str(number)
            write_model(subfolder, component.model)
            _write_dense(subfolder, component, photos, options, seed)
        write_ply(folder / POINTS, largest.reconstruction.points, largest.colors)
        _write_dense(folder, largest, photos, options, seed)
        if photos.any_distorted(largest.reconstruction) or photos.any_rotated(
            largest.reconstruction
        ):
            _write_undistorted(folder / UNDISTORTED, largest, photos)
        if options.nerfstudio:
            _write_nerfstudio(folder / TRANSFORMS, output, largest, photos)
        if options.report:
            write_views(folder / VIEWS, photos.problem, photos.view)
        for video, frames in trajectories.items():
            write_trajectory(folder, frames, video)
        summary = summarize()
        _write_json(folder / SUMMARY, summary)
    return summary


def _write_text_model(folder: Path, model: pycolmap.Reconstruction) -> None:
    """Write the COLMAP text model, or warn if an image name has a space, which COLMAP cuts off."""
    spaced = [name for i in model.images.values() if len((name := str(i.name)).split()) != 1]
    if spaced:
        text = "sparse_text is not written: COLMAP's text format allows no spaces in names (%s)"
        _log.warning(text, min(spaced))
        return
    write_model(folder, model, text=True)


def _write_dense(
    folder: Path,
    component: ComponentResult,
    photos: OriginalImages,
    options: ResultOptions,
    seed: int,
) -> None:
    """Write the point cloud of the fused depth maps, and the depth maps if enabled."""
    if options.dense_cloud:
        cloud = fuse_depth_maps(
            component.reconstruction, photos.view, options.dense_max_points, seed
        )
        write_cloud(folder / DENSE, cloud)
    if options.depth_maps:
        write_depth_maps(folder / DEPTH, component.reconstruction)


def update_summary(output: Path, summary: Mapping[str, Any]) -> None:
    """Replace ``summary.json`` of written results; raise :class:`OSError` if writing fails."""
    write_file(output / SUMMARY, _json_text(summary))


def write_failure(
    output: Path, photos: OriginalImages, options: ResultOptions, summary: Mapping[str, Any]
) -> None:
    """Write ``summary.json`` and ``views/`` of a failed run; keep earlier models in the folder."""
    with replace_entries(output, (VIEWS, REPORT, SUMMARY)) as folder:
        if options.report:
            write_views(folder / VIEWS, photos.problem, photos.view)
        _write_json(folder / SUMMARY, summary)


def _write_undistorted(folder: Path, component: ComponentResult, photos: OriginalImages) -> None:
    write_model(folder / "sparse", component.undistorted(photos))
    for image in component.reconstruction.images:
        photos.write_view(image, folder / "images" / exported_image_name(image.name))


def _write_nerfstudio(
    path: Path, output: Path, component: ComponentResult, photos: OriginalImages
) -> None:
    """Write ``transforms.json`` of the original or, for some camera models, undistorted images."""
    images = component.reconstruction.images
    has_cameras = all(supports_camera(camera) for camera in component.model.cameras.values())
    if has_cameras and not photos.any_rotated(component.reconstruction):
        model = component.model
        files = {image.name: os.path.relpath(photos.source(image).path, output) for image in images}
    else:
        model = component.undistorted(photos)
        names = [exported_image_name(image.name) for image in images]
        files = {name: f"{UNDISTORTED}/images/{name}" for name in names}
    write_transforms(path, model, files)


def _write_json(path: Path, data: Mapping[str, Any]) -> None:
    path.write_text(_json_text(data), encoding="utf-8")


def _json_text(data: Mapping[str, Any]) -> str:
    return json.dumps(data, indent=2) + "\n"
