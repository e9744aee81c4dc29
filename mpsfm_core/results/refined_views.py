"""Undistort images again with the distortion that the mapper estimated.

Images without given intrinsics are first mapped as pinhole images of a guessed focal length. If the
mapper estimates distortion, keypoints, depth priors and normal priors are transferred to
views that are undistorted with the refined cameras. The transfer moves pixels, and keeps values of
depth along z and of normals in the camera frame.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import cv2
import numpy as np
import pycolmap

from mpsfm_core.data import (
    Bool,
    DepthPrior,
    Float32,
    Float64,
    MappingImage,
    MappingProblem,
    NormalPrior,
)
from mpsfm_core.data.camera_models import CameraModel, Distortion, to_distortion
from mpsfm_core.geometry import pixel_centers, project, scale_pixels
from mpsfm_core.geometry.distortion import undistort_rays
from mpsfm_core.geometry.pycolmap_conversion import camera_key
from mpsfm_core.inputs.images import ImageSet, SourceImage
from mpsfm_core.mapping.depth_map_refinement import refine_depth_maps
from mpsfm_core.mapping.options import MapperOptions
from mpsfm_core.mapping.scene.reconstruction import Reconstruction, RegisteredImage
from mpsfm_core.support.disk_arrays import current_store, store_fields
from mpsfm_core.support.lru_cache import LruCache
from mpsfm_core.support.threads import parallel_map

MIN_VALID_WEIGHT = 0.999
"""Minimum sum of interpolation weights of valid pixels for a valid resampled pixel. [ours]"""
_CACHED_WARPS = 2
"""Number of cached maps of pixels, because images share cameras. [ours]"""


def undistort_images(
    images: ImageSet, problem: MappingProblem, reconstructions: Sequence[Reconstruction]
) -> ImageSet:
    """Return the images with the cameras that the mapper estimated, in their camera model.

    An image that is not registered gets the camera of a registered image that shares its guessed
    camera. The images are returned unchanged if neither distortion nor principal point
    nor aspect ratio was estimated.

    Args:
        images: Images whose undistorted views were mapped.
        problem: Mapping problem of the undistorted views.
        reconstructions: Components that the mapper reconstructed.
    """
    registered = {image.index: image for part in reconstructions for image in part.images}
    shared = {
        problem.images[image.index].shared_camera: image
        for image in reversed(list(registered.values()))
        if not problem.images[image.index].focal_known
    }
    cameras = {}
    for index, (source, image) in enumerate(zip(images, problem.images, strict=True)):
        refined = registered.get(index)
        if refined is None and not image.focal_known:
            refined = shared.get(image.shared_camera)
        if refined is not None and refined.changes_view:
            cameras[source.name] = _refined_camera(source, refined)
    return images.with_cameras(cameras) if cameras else images


def measure_distortion(image: SourceImage) -> float:
    """Measure the largest relative displacement of the corners of an image by lens distortion."""
    camera = image.camera
    center = np.array([camera.principal_point_x, camera.principal_point_y])
    corners = np.array([[x, y] for x in (0.0, camera.width) for y in (0.0, camera.height)])
    offsets = camera.cam_from_img(corners) * (camera.focal_length_x, camera.focal_length_y)
    ratios = np.linalg.norm(offsets, axis=1) / np.linalg.norm(corners - center, axis=1)
    return float(np.nan_to_num(np.abs(ratios - 1)).max())


def undistort_problem(
    images: ImageSet, refined: ImageSet, problem: MappingProblem
) -> MappingProblem:
    """Transfer a mapping problem to views that are undistorted with refined cameras.

    Args:
        images: Images with the cameras before refinement, to whose views the problem refers.
        refined: Images with the refined cameras, in the same order.
        problem: Mapping problem with keypoints and priors on the views of ``images``.
    """
    warps: LruCache[object, _ViewWarp] = LruCache(_CACHED_WARPS, lambda _: 1)

    def move(sources: tuple[SourceImage, SourceImage, MappingImage]) -> MappingImage:
        old, new, view = sources
        if new is old:
            return view
        key = camera_key(old.camera), old.pinhole, camera_key(new.camera), new.pinhole
        return warps.get(key, partial(_ViewWarp, old, new)).move_view(view)

    views = parallel_map(move, zip(images, refined, problem.images, strict=True))
    return replace(problem, images=tuple(views))


def undistort_cameras(refined: ImageSet, reconstruction: Reconstruction) -> Reconstruction:
    """Replace the cameras of a reconstruction by the pinhole cameras of refined views.

    The depth maps of the reconstruction do not change, so they have to be refined again.

    Args:
        refined: Images with the cameras that :func:`undistort_images` estimated.
        reconstruction: One component of the result of the mapper.
    """
    images = tuple(take_refined_camera(refined, image) for image in reconstruction.images)
    return replace(reconstruction, images=images)


def take_refined_camera(refined: ImageSet, image: RegisteredImage) -> RegisteredImage:
    """Replace the camera of an image by that of its refined view, if the view changes."""
    return replace(image, camera=refined[image.index].pinhole) if image.changes_view else image


def refine_reconstructions(
    refined: ImageSet,
    problem: MappingProblem,
    reconstructions: Sequence[Reconstruction],
    options: MapperOptions,
) -> tuple[Reconstruction, ...]:
    """Replace cameras by the cameras of refined views, and refine the depth maps in these views.

    Args:
        refined: Images with the cameras that :func:`undistort_images` estimated.
        problem: Mapping problem that :func:`undistort_problem` transferred to the refined views.
        reconstructions: Components that the mapper reconstructed.
        options: Options of the mapper.
    """
    return tuple(
        refine_depth_maps(problem, undistort_cameras(refined, part), options)
        for part in reconstructions
    )


def _refined_camera(source: SourceImage, registered: RegisteredImage) -> pycolmap.Camera:
    """Return the camera that the mapper estimated for an upright original image."""
    camera, old, new = source.camera, source.pinhole, registered.camera
    scale_x, scale_y = camera.focal_length_x / old.fx, camera.focal_length_y / old.fy
    intrinsics = np.array(
        [
            camera.focal_length_x * new.fx / old.fx,
            camera.focal_length_y * new.fy / old.fy,
            camera.principal_point_x + (new.cx - old.cx) * scale_x,
            camera.principal_point_y + (new.cy - old.cy) * scale_y,
        ]
    )
    model = registered.camera_model
    return pycolmap.Camera(
        model=model.value,
        width=camera.width,
        height=camera.height,
        params=model.to_params(intrinsics, registered.distortion),
        camera_id=camera.camera_id,
    )


class _ViewWarp:
    """Resampling of keypoints and maps from an old to a new undistorted view of an image."""

    def __init__(self, old: SourceImage, new: SourceImage) -> None:
        self._old, self._new = old, new
        self._pixels: dict[tuple[int, int], Float32] = {}

    def move_view(self, image: MappingImage) -> MappingImage:
        """Return an image of the mapping problem with keypoints and priors on the new view."""
        store = current_store()
        return replace(
            image,
            camera=self._new.pinhole,
            focal_guess_px=image.focal_prior_px,
            distortion=self._distortion,
            keypoints=self.move_keypoints(image.keypoints),
            depth=store_fields(self.move_depth(image.depth), store),
            normals=store_fields(self.move_normals(image.normals), store),
        )

    @property
    def _distortion(self) -> Distortion:
        camera = self._new.camera
        _, distortion = CameraModel(camera.model_name).from_params(np.array(camera.params))
        return to_distortion(distortion)

    def move_keypoints(self, xy: Float64) -> Float64:
        """Map keypoints (n, 2) in pixels of the old view to pixels of the new view."""
        camera = self._new.camera
        center = np.array([camera.principal_point_x, camera.principal_point_y])
        focal_px = np.array([camera.focal_length_x, camera.focal_length_y])
        distorted = (self._old.original_pixels(xy) - center) / focal_px
        fisheye = CameraModel(camera.model_name).is_fisheye
        rays = undistort_rays(distorted, self._distortion, fisheye=fisheye)
        return project(self._new.pinhole, np.column_stack([rays, np.ones(len(rays))]))

    def move_depth(self, prior: DepthPrior) -> DepthPrior:
        """Resample a depth prior on the new view by bilinear interpolation of log depth."""
        safe = np.where(prior.valid, prior.depth, np.float32(1))
        depth = np.exp(self._resample(np.log(safe)))
        variance = prior.variance
        if variance is not None:
            variance = self._resample(np.where(prior.valid, variance / safe**2, 0)) * depth**2
        return DepthPrior.from_arrays(
            depth, variance, self._resample_mask(prior.valid), metric=prior.metric
        )

    def move_normals(self, prior: NormalPrior) -> NormalPrior:
        """Resample a normal prior on the new view by bilinear interpolation."""
        variance = None if prior.variance is None else self._resample(prior.variance)
        return NormalPrior.from_arrays(
            self._resample(prior.normals), variance, self._resample_mask(prior.valid)
        )

    def _resample_mask(self, mask: Bool) -> Bool:
        weight = self._resample(mask.astype(np.float32), cv2.BORDER_CONSTANT)
        valid: Bool = weight > MIN_VALID_WEIGHT
        return valid

    def _resample(self, values: Float32, border: int = cv2.BORDER_REPLICATE) -> Float32:
        """Resample a map (h, w) or (h, w, 3) of the old view to a map of the new view."""
        rows, columns = values.shape[:2]
        if (rows, columns) not in self._pixels:
            self._pixels[rows, columns] = self._map_pixels(rows, columns)
        xy = self._pixels[rows, columns]
        resampled: Float32 = cv2.remap(values, xy, None, cv2.INTER_LINEAR, borderMode=border)
        return resampled

    def _map_pixels(self, rows: int, columns: int) -> Float32:
        """Return pixels (h, w, 2) in a map of the old view of each pixel of a new map."""
        old, new = self._old.pinhole, self._new.pinhole
        width = max(1, round(columns * new.width / old.width))
        height = max(1, round(rows * new.height / old.height))
        centers = pixel_centers(width, height).reshape(-1, 2)
        view = scale_pixels(centers, (width, height), new.size)
        xy = self._old.view_pixels(self._new.original_pixels(view))
        pixels = scale_pixels(xy, old.size, (columns, rows)) - 0.5
        positions: Float32 = pixels.astype(np.float32).reshape(height, width, 2)
        return positions
