"""Read the reconstruction to export from a result folder or a COLMAP model."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path, PurePath
from typing import Any

import numpy as np
import pycolmap
from scipy.spatial.transform import Rotation

from mpsfm_core.data import DepthPrior, Float32, Float64, NormalPrior, PinholeCamera, UInt8
from mpsfm_core.data.errors import InputError
from mpsfm_core.data.result_layout import DENSE, DEPTH, SUMMARY
from mpsfm_core.geometry.pycolmap_conversion import colmap_from_pinhole
from mpsfm_core.inputs.image_search import find_images
from mpsfm_core.inputs.images import ImageSet, load_images
from mpsfm_core.inputs.models import find_model_folder, match_names, read_model
from mpsfm_core.inputs.options import InputOptions
from mpsfm_core.providers.builtin.normals_from_depth import fit_normals
from mpsfm_core.providers.builtin.options import NormalsFromDepthOptions
from mpsfm_core.results.depth_maps import read_depth_map
from mpsfm_core.results.gravity import Gravity, estimate_gravity, rotation_to_z
from mpsfm_core.results.original_images import export_view, exported_image_name
from mpsfm_core.results.ply import read_normals, read_ply
from mpsfm_core.results.summary import read_summary
from mpsfm_core.results.trajectory import find_trajectories, read_trajectory_rows

_NORMALS_AN_IMAGE = 2000
"""Maximum number of surface normals per image in the estimation of gravity."""


@dataclass(frozen=True, eq=False)
class ExportMaps:
    """Refined depth and normals of an image on one grid."""

    camera: PinholeCamera
    """Pinhole camera of the grid of the depth map."""
    depth: DepthPrior
    """Refined z-depth in units of the exported world."""
    normals: NormalPrior
    """Surface normals computed from the refined depth."""


@dataclass(frozen=True, eq=False)
class ExportSource:
    """Reconstruction to export, with its images, depth maps and summary."""

    folder: Path
    """Result folder or folder of a COLMAP model."""
    model: pycolmap.Reconstruction
    """COLMAP model of the original images, without tentatively registered images."""
    photos: Path | None
    """Folder of the original images, None if unknown."""
    summary: Mapping[str, Any]
    """Content of the run's ``summary.json``, empty for a COLMAP model."""
    left_out: tuple[str, ...] = ()
    """Names of the tentatively registered images, which are not exported."""
    world_from_model: pycolmap.Sim3d = field(default_factory=pycolmap.Sim3d)
    """Similarity from the model in the folder to the exported world."""
    gravity: Gravity | None = None
    """Gravity direction that was rotated to -z, None if the world was not rotated."""

    @classmethod
    def read(cls, folder: Path, photos: Path | None = None) -> ExportSource:
        """Read a reconstruction from a result folder or COLMAP model.

        Args:
            folder: result folder or COLMAP model to read.
            photos: folder of the original images, if it has moved since the run.

        Raises:
            InputError: the folder has no model, or the model is damaged.
        """
        summary = _read_summary(folder / SUMMARY)
        if photos is None:
            recorded = summary.get("photos")
            sibling = find_model_folder(folder).parent / "images"
            candidates = [Path(recorded)] if recorded else [folder / "images", sibling]
            photos = next((path for path in candidates if path.is_dir()), None)
        model = read_model(folder, photos)
        guesses = tuple(summary.get("images", {}).get("unconfirmed", ()))
        for image in list(model.images.values()):
            if image.name in guesses:
                model.deregister_frame(image.frame_id)
        for image in model.images.values():
            path = PurePath(str(image.name))
            if path.is_absolute() or path.drive or ".." in path.parts:
                raise InputError(
                    f"{folder}: the name of image {image.name!r} is not below the images folder"
                )
        if not model.num_reg_images():
            raise InputError(f"{folder}: the model has no image with a pose")
        return cls(folder, model, photos, summary, guesses)

    @property
    def metres_per_unit(self) -> float | None:
        """Meters per unit of the exported world, None if unknown."""
        if self._metric is None:
            return None
        before = 1.0 if self._metric["trusted"] else float(self._metric["metres_per_unit"])
        return before / float(self.world_from_model.scale)

    @property
    def scale_spread(self) -> float | None:
        """Relative standard deviation of the metric scale, None if unknown."""
        return None if self._metric is None else float(self._metric["spread"])

    @property
    def _metric(self) -> Mapping[str, Any] | None:
        described = self.summary.get("reconstructions") or [{}]
        metric: Mapping[str, Any] | None = described[0].get("metric_scale")
        return metric

    @cached_property
    def names(self) -> list[str]:
        """Names of the registered images, sorted."""
        return sorted(str(self.model.images[i].name) for i in self.model.reg_image_ids())

    @cached_property
    def images(self) -> ImageSet:
        """Original images of the registered images in the order of :attr:`names`.

        Raises:
            InputError: the original image files are missing.
        """
        settings = self.summary.get("config", {}).get("inputs", {})
        return self.load_images(
            InputOptions(max_image_size=settings.get("max_image_size"), strict=True)
        )

    @property
    def held_out(self) -> tuple[str, ...]:
        """Names of the images that the dense stage ignored, as recorded by the run."""
        return tuple(self.summary.get("images", {}).get("held_out", ()))

    def load_images(self, options: InputOptions) -> ImageSet:
        """Load the original images of the registered images, with the cameras of the model.

        Raises:
            InputError: the original image files are missing.
        """
        if self.photos is None:
            recorded = self.summary.get("photos", "")
            where = f" (the run read them from {recorded})" if recorded else ""
            raise InputError(
                f"{self.folder}: the folder of the photos is unknown{where}; give it with --images"
            )
        files = match_names(self.names, find_images(self.photos))
        missing = [name for name in self.names if name not in files]
        if missing:
            raise InputError(
                f"{self.photos}: has no photo {missing[0]!r}"
                + (f" and {len(missing) - 1} more of the model" if len(missing) > 1 else "")
            )
        names = [files[name] for name in self.names]
        return load_images(
            self.photos, find_model_folder(self.folder), options=options, names=names
        )

    @property
    def is_georeferenced(self) -> bool:
        """True if the exported world is georeferenced to east, north, up in meters."""
        return "origin" in (self.summary.get("georeference") or {})

    @property
    def z_is_up(self) -> bool:
        """True if gravity is along -z in the exported world."""
        return self.gravity is not None or self.is_georeferenced

    def turned(self) -> ExportSource:
        """Return the reconstruction with gravity along -z, in meters if the scale is known.

        The new origin is the median 3D point, or the median camera center of a model without
        points.
        """
        gravity = estimate_gravity(self._rotations(), self._world_normals())
        first = self._rotations()[0]
        rotation = rotation_to_z(gravity.up, first[0])
        points = self.points()[0]
        if not len(points):
            points = np.stack([image.projection_center() for image in self.registered()])
        middle = np.median(points @ rotation.T, axis=0)
        scale = self.metres_per_unit or 1.0
        moved = pycolmap.Sim3d(scale, pycolmap.Rotation3d(rotation), -scale * middle)
        return replace(self._transformed(moved), gravity=gravity)

    def registered(self) -> list[pycolmap.Image]:
        """Return the registered images in the order of :attr:`names`."""
        by_name = {str(image.name): image for image in self.model.images.values()}
        return [by_name[name] for name in self.names]

    def points(self) -> tuple[Float64, UInt8]:
        """Return positions (n, 3) and RGB colors (n, 3) of the 3D points, sorted by id."""
        ids = sorted(self.model.points3D)
        points = [self.model.points3D[i] for i in ids]
        xyz = np.array([point.xyz for point in points], dtype=np.float64).reshape(-1, 3)
        return xyz, np.array([point.color for point in points], dtype=np.uint8).reshape(-1, 3)

    @property
    def has_dense_points(self) -> bool:
        """True if the folder has a cloud of fused depth maps."""
        return (self.folder / DENSE).is_file()

    def dense_points(self) -> tuple[Float64, UInt8]:
        """Return positions and colors of the fused depth maps, else of the 3D points."""
        if not self.has_dense_points:
            return self.points()
        points, colors = read_ply(self.folder / DENSE)
        moved: Float64 = self.world_from_model * points
        return moved, colors

    def dense_normals(self) -> Float32:
        """Return the unit normals (n, 3) of :meth:`dense_points`, zero if they are unknown."""
        normals = read_normals(self.folder / DENSE) if self.has_dense_points else None
        if normals is None:
            return np.zeros((len(self.dense_points()[0]), 3), np.float32)
        turn = self.world_from_model.rotation.matrix()
        turned: Float32 = (normals @ turn.T).astype(np.float32)
        return turned

    def trajectories(self) -> dict[str, tuple[Float64, Float64, Float64]]:
        """Read the poses of the frames of each video, by video name, empty for a single video.

        Returns:
            Time stamps (n,) in seconds, camera centers (n, 3) in the exported world, and rotations
            (n, 3, 3) ``world_from_cam``.
        """
        turn = self.world_from_model.rotation.matrix()
        read = {}
        for name, path in find_trajectories(self.folder).items():
            table = read_trajectory_rows(path)
            centers: Float64 = self.world_from_model * table[:, 1:4]
            rotations = turn @ Rotation.from_quat(table[:, 4:]).as_matrix()
            read[name] = table[:, 0], centers, rotations
        return read

    def maps(self, name: str) -> ExportMaps | None:
        """Read depth and normals of an image, None if the folder has no depth map.

        Raises:
            InputError: the depth map file is damaged.
        """
        path = self.folder / DEPTH / f"{name}.npz"
        if not path.is_file():
            return None
        camera, depth = read_depth_map(path, float(self.world_from_model.scale))
        return ExportMaps(camera, depth, fit_normals(camera, depth, NormalsFromDepthOptions()))

    def undistorted(self) -> pycolmap.Reconstruction:
        """Build the model of the undistorted images that :meth:`write_photos` writes.

        Image and point ids are unchanged; keypoints without a 3D point are omitted.
        """
        model = pycolmap.Reconstruction()
        cameras: dict[str, int] = {}
        rows: dict[int, dict[int, int]] = {}
        for image, photo in zip(self.registered(), self.images, strict=True):
            camera = colmap_from_pinhole(photo.pinhole)
            key = str(camera.todict())
            if key not in cameras:
                cameras[key] = camera.camera_id = len(cameras) + 1
                model.add_camera_with_trivial_rig(camera)
            observed = [k for k, point in enumerate(image.points2D) if point.has_point3D()]
            xy = np.array([image.points2D[k].xy for k in observed], dtype=np.float64).reshape(-1, 2)
            xy = photo.view_pixels(xy)
            visible = np.flatnonzero(np.isfinite(xy).all(axis=1))
            rows[image.image_id] = {observed[k]: row for row, k in enumerate(visible)}
            new = pycolmap.Image(
                name=exported_image_name(str(image.name)),
                keypoints=xy[visible],
                camera_id=cameras[key],
                image_id=image.image_id,
            )
            model.add_image_with_trivial_frame(new, image.cam_from_world())
        for number, point in sorted(self.model.points3D.items()):
            track = [
                pycolmap.TrackElement(element.image_id, rows[element.image_id][element.point2D_idx])
                for element in point.track.elements
                if element.point2D_idx in rows.get(element.image_id, ())
            ]
            if track:
                model.add_point3D_with_id(
                    number,
                    pycolmap.Point3D(xyz=point.xyz, color=point.color, track=pycolmap.Track(track)),
                )
        model.update_point_3d_errors()
        return model

    def write_photos(self, folder: Path) -> None:
        """Write all registered images upright, undistorted, and in a common image format."""
        for index, name in enumerate(self.names):
            export_view(self.images, index, folder / exported_image_name(name))

    def _transformed(self, similarity: pycolmap.Sim3d) -> ExportSource:
        model = pycolmap.Reconstruction(self.model)
        model.transform(similarity)
        return replace(self, model=model, world_from_model=similarity * self.world_from_model)

    def _rotations(self) -> Float64:
        return np.stack([image.cam_from_world().rotation.matrix() for image in self.registered()])

    def _world_normals(self) -> Float64:
        """Return surface normals (n, 3) in the world frame, from all images with depth."""
        normals_of_images = [np.zeros((0, 3))]
        for image in self.registered():
            maps = self.maps(str(image.name))
            if maps is None:
                continue
            normals = maps.normals.normals[maps.normals.valid].astype(np.float64)
            step = max(1, len(normals) // _NORMALS_AN_IMAGE)
            normals_of_images.append(normals[::step] @ image.cam_from_world().rotation.matrix())
        return np.concatenate(normals_of_images)


def _read_summary(path: Path) -> dict[str, Any]:
    if not path.is_file():
        return {}
    summary = read_summary(path)
    if summary["status"] == "failed":
        raise InputError(f"{path.parent}: the run made no reconstruction; {SUMMARY} says why")
    return summary
