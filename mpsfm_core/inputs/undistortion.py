"""Undistort images, masks and pixels to pinhole cameras."""

from __future__ import annotations

import cv2
import numpy as np
import pycolmap

from mpsfm_core.data import Bool, Float32, Float64, PinholeCamera, UInt8
from mpsfm_core.geometry import inside, pixel_centers, project, rays, scale_pixels
from mpsfm_core.geometry.pycolmap_conversion import pinhole_from_colmap

_ROWS = 256
"""Number of rows of an undistortion map that are computed together, to bound the memory."""


def is_pinhole(camera: pycolmap.Camera) -> bool:
    """Return whether a COLMAP camera has no lens distortion."""
    return bool(camera.is_perspective_pinhole() and camera.is_undistorted())


def resize_camera(camera: pycolmap.Camera, size: tuple[int, int]) -> pycolmap.Camera:
    """Return the camera of an image after resizing the image to (width, height)."""
    resized = pycolmap.Camera(camera.todict())
    resized.rescale(*size)
    return resized


def undistort_camera(camera: pycolmap.Camera) -> PinholeCamera:
    """Return the pinhole camera of the undistorted image, cropped to valid pixels.

    A pinhole camera is returned unchanged.
    """
    if not is_pinhole(camera):
        options = pycolmap.UndistortCameraOptions()
        options.blank_pixels = 0.0
        camera = pycolmap.undistort_camera(options, camera)
    return pinhole_from_colmap(camera)


def distort_pixels(pinhole: PinholeCamera, camera: pycolmap.Camera, xy: Float64) -> Float64:
    """Map pixels (n, 2) of the undistorted view to pixels of the original camera."""
    if is_pinhole(camera):
        return scale_pixels(xy, pinhole.size, (camera.width, camera.height))
    original: Float64 = camera.img_from_cam(rays(pinhole, xy))
    return original


def undistort_pixels(pinhole: PinholeCamera, camera: pycolmap.Camera, xy: Float64) -> Float64:
    """Map pixels (n, 2) of the original camera to pixels of the undistorted view.

    Returns:
        (n, 2) float64 undistorted pixels, NaN where the distortion has no inverse.
    """
    if is_pinhole(camera):
        return scale_pixels(xy, (camera.width, camera.height), pinhole.size)
    direction: Float64 = camera.cam_from_img(xy)
    return project(pinhole, np.concatenate([direction, np.ones((len(xy), 1))], axis=1))


class UndistortionMap:
    """Precomputed pixel map that resamples a distorted image to its undistorted view.

    ``valid``: Mask of the undistorted view, (h, w) bool, False outside of the original image.
    """

    def __init__(self, camera: pycolmap.Camera, pinhole: PinholeCamera) -> None:
        centers = pixel_centers(pinhole.width, pinhole.height)
        source = np.empty((*centers.shape[:2], 2), dtype=np.float32)
        for start in range(0, pinhole.height, _ROWS):
            block = centers[start : start + _ROWS]
            xy = distort_pixels(pinhole, camera, block.reshape(-1, 2))
            source[start : start + _ROWS] = xy.reshape(block.shape)
        self.valid: Bool = inside(source.astype(np.float64), (camera.width, camera.height))
        self._source: Float32 = source - np.float32(0.5)

    def image(self, image: UInt8) -> UInt8:
        """Undistort an image with bilinear interpolation; pixels outside the image are black."""
        warped = cv2.remap(
            image, self._source, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
        )
        warped[~self.valid] = 0
        result: UInt8 = warped
        return result

    def mask(self, mask: Bool) -> Bool:
        """Undistort a mask with nearest-neighbor sampling; pixels outside the mask are False."""
        warped = cv2.remap(
            mask.astype(np.uint8), self._source, None, cv2.INTER_NEAREST, borderValue=0
        )
        result: Bool = (warped > 0) & self.valid
        return result
