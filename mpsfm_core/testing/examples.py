"""Synthetic views with exact ground truth, the inputs of all contract checks."""

from __future__ import annotations

from collections.abc import Hashable
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Literal, NamedTuple

import numpy as np

from mpsfm_core.data import Bool, Float64, Int64, PinholeCamera, UInt8, View
from mpsfm_core.geometry import pixel_centers
from mpsfm_core.testing.painted_views import MAX_SLOPE, paint
from mpsfm_core.testing.synthetic.scenes import (
    AnalyticScene,
    Box,
    Plane,
    Sphere,
    Texture,
    TrueCorrespondences,
    arc_poses,
    look_at,
    room_scene,
)

Appearance = Literal["painted", "textured"]
"""Colors of a synthetic view, which either encode depth and normals (``painted``, see
:mod:`mpsfm_core.testing.painted_views`) or show a random texture with corners to match
(``textured``)."""

FOCAL_RATIO = 0.75
"""Ratio of the mean of ``fx`` and ``fy`` to the image width of the outdoor views. A test network
for focal lengths returns ``FOCAL_RATIO`` times the longer side of the image."""
_FY_RATIO = 0.75
"""Ratio ``fy / fx`` of example views, far from 1 so that swapped focal lengths are measurable."""
_SKY = ((120, 170, 235), (200, 220, 245))
"""RGB of the sky at the upper and lower border of a textured synthetic view."""
_HOLES = ((-0.42, -0.05, -0.28, 0.12), (0.33, 0.21, 0.52, 0.34), (-0.1, 0.38, 0.04, 0.47))
"""Rectangles (left, top, right, bottom) without ground truth in example views, in normalized image
coordinates x / z and y / z."""
_TILT_DEG = 20.0
"""Upward tilt in degrees of the camera of :func:`tilted_example`."""
_NUM_CACHED = 96
"""Number of images, and of ground-truth maps, that a process stores. Many contract checks and all
providers of a kind use the same synthetic views of about 1 MB each."""
_COS_MAX_CREASE = np.cos(np.deg2rad(20.0))
"""Smallest cosine of the angle between neighboring normals on a smooth surface, for 20 degrees."""


@dataclass(frozen=True, eq=False)
class TrueMaps:
    """Ground truth of a synthetic view on a grid (h, w) that covers the view."""

    depth: Float64
    """z-depth (h, w) in meters, 0 where there is no surface."""
    normals: Float64
    """Unit normals (h, w, 3) in the camera frame, 0 where there is no surface."""
    valid: Bool
    """Validity mask (h, w), True where the pixel shows a surface."""
    smooth: Bool
    """Mask (h, w) of smooth pixels, True where the surface continues for two pixels in all
    directions and is not seen at a grazing angle. Interpolating a depth or normal map causes no
    large error at smooth pixels."""
    edge_free: Bool
    """Mask (h, w), True where all pixels up to two away are valid, or all are invalid."""


@dataclass(frozen=True, eq=False)
class Example:
    """Synthetic view of a scene with its exact ground truth."""

    name: str
    scene: AnalyticScene
    camera: PinholeCamera
    pose: Float64
    """Pose ``cam_from_world`` (3, 4) of the view, in meters."""
    look: Appearance
    """Colors of the view, painted or textured."""
    mirrored: bool = False
    """True if left and right are swapped in the image and in the ground truth."""
    holes: bool = False
    """True if the ground truth has no value in some rectangles on the surfaces, like the depth of
    glass and mirrors."""

    @cached_property
    def view(self) -> View:
        """View that the provider under test receives."""
        # A provider may modify the image in place, so each example has an image of its own.
        return View(self.name, _render(self._content).copy(), self.camera)

    def truth(
        self,
        shape: tuple[int, int] | None = None,
        offset_px: tuple[float, float] = (0.0, 0.0),
        step: int = 1,
    ) -> TrueMaps:
        """Compute the ground truth of the synthetic view on a grid.

        Args:
            shape: Numbers of rows and columns of the grid, by default those of the image.
            offset_px: Translation of the grid in pixels of the view (x, y).
            step: Mean distance of the computed rows and columns, see :func:`thin`.

        Returns:
            Ground-truth depth, normals and masks at the centers of the grid cells, as read-only
            arrays.
        """
        rows, columns = shape or (self.camera.height, self.camera.width)
        return _compute_truth(self._content, rows, columns, offset_px, step)

    def correspondences(self, other: Example, xy: Float64) -> TrueCorrespondences:
        """Project the points seen at pixels (n, 2) of this view into another synthetic view."""
        return self.scene.correspondences(self.camera, self.pose, other.camera, other.pose, xy)

    @cached_property
    def partner(self) -> Example:
        """Synthetic view of the same surfaces from 0.3 m to the right, with the same camera."""
        return replace(self, name=f"shifted/{self.name}", pose=_shift_right(self.pose))

    def mirror(self) -> Example:
        """Return the synthetic view with left and right swapped."""
        camera = replace(self.camera, cx=self.camera.width - self.camera.cx)
        name = f"mirrored/{self.name}"
        return replace(self, name=name, camera=camera, mirrored=not self.mirrored)

    def sized(self, width: int, height: int) -> Example:
        """Return the synthetic view with another image size.

        The pose, the ratio of focal length to image height and the relative principal point stay
        the same. The resized view may therefore show more or less of the scene.

        Args:
            width: Width in pixels.
            height: Height in pixels.
        """
        camera, scale = self.camera, height / self.camera.height
        cx, cy = camera.cx / camera.width * width, camera.cy * scale
        sized = PinholeCamera(width, height, scale * camera.fx, scale * camera.fy, cx, cy)
        return replace(self, name=f"{width}x{height}/{self.name}", camera=sized)

    def turned(self) -> Example:
        """Return the synthetic view of the same camera in portrait format."""
        camera = self.camera
        turned = PinholeCamera(
            camera.height, camera.width, camera.fy, camera.fx, camera.cy, camera.cx
        )
        return replace(self, name=f"turned/{self.name}", camera=turned)

    def with_common_camera(self) -> Example:
        """Return the synthetic view with a centered principal point and square pixels.

        Networks that estimate a focal length predict one value for cameras with square pixels.
        """
        width, height = self.camera.size
        focal = (self.camera.fx + self.camera.fy) / 2
        camera = PinholeCamera(width, height, focal, focal, width / 2, height / 2)
        return replace(self, name=f"common/{self.name}", camera=camera)

    def crop(self, left: int, top: int, width: int, height: int) -> Example:
        """Return a rectangle of the synthetic view, which shows the scene at the same scale.

        Args:
            left: First column of the rectangle in pixels.
            top: First row of the rectangle in pixels.
            width: Width in pixels.
            height: Height in pixels.
        """
        camera = self.camera
        cropped = PinholeCamera(
            width, height, camera.fx, camera.fy, camera.cx - left, camera.cy - top
        )
        return replace(self, name=f"{left}-{top}-{width}x{height}/{self.name}", camera=cropped)

    @property
    def key(self) -> Hashable:
        """Value that is equal for synthetic views of the same name, image and ground truth."""
        return self.name, self._content

    @property
    def _content(self) -> _Content:
        """Fields that determine the rendered image and its ground truth, as keys of the caches."""
        parts = self.scene, self.camera, self.pose.tobytes(), self.look, self.mirrored, self.holes
        return _Content(*parts)


class _Content(NamedTuple):
    """Fields of an :class:`Example` that determine its image and ground truth."""

    scene: AnalyticScene
    camera: PinholeCamera
    pose_data: bytes
    look: Appearance
    mirrored: bool
    holes: bool

    @property
    def pose(self) -> Float64:
        """Pose ``cam_from_world`` of the rendered view, (3, 4) float64."""
        return np.frombuffer(self.pose_data).reshape(3, 4)

    @property
    def unmirrored_camera(self) -> PinholeCamera:
        """Camera of the synthetic view before left and right are swapped."""
        if not self.mirrored:
            return self.camera
        return replace(self.camera, cx=self.camera.width - self.camera.cx)

    def is_hole(self, xy: Float64) -> Bool:
        """Return a mask (n,) of the pixels (n, 2) in rectangles without ground truth."""
        camera = self.unmirrored_camera
        slopes = (xy.reshape(-1, 2) - (camera.cx, camera.cy)) / (camera.fx, camera.fy)
        inside = [
            ((slopes >= (left, top)) & (slopes < (right, bottom))).all(axis=1)
            for left, top, right, bottom in (_HOLES if self.holes else ())
        ]
        return np.any(inside, axis=0) if inside else np.zeros(len(slopes), np.bool_)

    def flip_if_mirrored(self, values: np.ndarray) -> np.ndarray:
        """Swap left and right of an array (h, w, ...) if the synthetic view is mirrored."""
        return np.ascontiguousarray(values[:, ::-1] if self.mirrored else values)


@lru_cache(maxsize=_NUM_CACHED)
def _render(content: _Content) -> UInt8:
    """Render the image (h, w, 3) of a synthetic view."""
    camera = content.camera
    if content.look == "painted":
        truth = _compute_truth(content, camera.height, camera.width, (0.0, 0.0), 1)
        return paint(truth.depth, truth.normals, truth.valid)
    rendering = content.scene.render(content.unmirrored_camera, content.pose)
    return content.flip_if_mirrored(_with_sky(rendering.rgb, rendering.depth > 0))


@lru_cache(maxsize=_NUM_CACHED)
def _compute_truth(
    content: _Content, rows: int, columns: int, offset_px: tuple[float, float], step: int
) -> TrueMaps:
    """Compute the true depth, normals and mask of a synthetic view at the pixels of a grid."""
    camera = content.camera
    offset = (-offset_px[0] if content.mirrored else offset_px[0], offset_px[1])
    xy = pixel_centers(columns, rows) * (camera.width / columns, camera.height / rows) + offset
    xy = thin(xy, step)
    rows, columns = xy.shape[:2]
    seen = content.scene.sample(content.unmirrored_camera, content.pose, xy)
    valid = seen.valid.reshape(rows, columns) & ~content.is_hole(xy).reshape(rows, columns)
    surface = np.where(valid, seen.surface.reshape(rows, columns), -1)
    normals = seen.normals.reshape(rows, columns, 3)
    x, y, z = np.moveaxis(normals, -1, 0)
    steep = np.maximum(abs(x), abs(y)) > 0.9 * MAX_SLOPE * -z
    smooth = valid & _is_smooth(surface, normals) & ~steep
    depth = np.where(valid, seen.depth.reshape(rows, columns), 0.0)
    normals = np.where(valid[..., None], normals, 0)
    edge_free = _is_smooth(valid.astype(np.int64))
    if content.mirrored:
        normals = normals * (-1.0, 1.0, 1.0)
    maps = [content.flip_if_mirrored(part) for part in (depth, normals, valid, smooth, edge_free)]
    for part in maps:
        part.flags.writeable = False
    return TrueMaps(*maps)


def thin(values: np.ndarray, step: int) -> np.ndarray:
    """Return one of ``step`` rows and columns of an array (h, w, ...).

    The rows and columns are not equidistant, because each pixel of a network's output is repeated
    in an enlarged map, and equidistant rows would be the upper row of each repetition.
    """
    rows, columns = (np.arange(count // step) for count in values.shape[:2])
    thinned: np.ndarray = values[np.ix_(rows * step + rows % step, columns * step + columns % step)]
    return thinned


def outdoor_example(
    look: Appearance, size: tuple[int, int] = (192, 144), *, holes: bool = False
) -> Example:
    """Return a synthetic view of ground, a slanted wall and two balls below an open sky.

    The camera is pitched, turned and rolled, so that no camera axis is parallel to a world axis and
    the image has no symmetry. The field of view is so wide that the ray length is 1.3 times z at
    the corners. The principal point is off-centre, and ``fx`` differs from ``fy``.

    Args:
        look: Colors of the view, painted or textured.
        size: Width and height of the view in pixels.
        holes: True removes the ground truth in some rectangles on the surfaces.
    """
    scene = AnalyticScene(
        (
            Plane((0.0, 0.0, 0.0), (0.0, 0.0, 1.0)),
            Box((7.7, 0.0, 0.95), (0.2, 9.0, 0.95), yaw_deg=-13.0),
            Sphere((4.6, 1.1, 0.9), 0.9),
            Sphere((3.4, -1.0, 0.7), 0.7),
        ),
        Texture(waves_per_octave=8),
    )
    pose = look_at((0.0, 0.0, 1.6), (4.0, 0.3, 1.6 - 4.0 * np.tan(np.deg2rad(20.0))))
    camera = _off_centre_camera(size, FOCAL_RATIO)
    return Example("outdoor.png", scene, camera, _rolled(pose, 15.0), look, holes=holes)


def tilted_example(size: tuple[int, int] = (192, 144)) -> Example:
    """Return a synthetic view whose camera is tilted upwards above a floor.

    The z component of the normals of the floor is positive, although the floor faces the camera.

    Args:
        size: Width and height of the view in pixels.
    """
    scene = replace(outdoor_example("painted").scene, texture=Texture(waves_per_octave=8))
    pose = look_at((0.0, 0.0, 1.6), (4.0, 0.3, 1.6 + 4.0 * np.tan(np.deg2rad(_TILT_DEG))))
    width, height = size
    camera = PinholeCamera(width, height, 0.4 * width, 0.4 * width, 0.47 * width, 0.45 * height)
    return Example("tilted.png", scene, camera, _rolled(pose, 10.0), "painted")


def distant_example(look: Appearance, size: tuple[int, int] = (192, 144)) -> Example:
    """Return a synthetic view with depth from 0.2 to 80 m: two balls before a wall far away.

    Args:
        look: Kind of colors of the view; painted colors encode depth up to 10 m only.
        size: Width and height of the view in pixels.
    """
    scene = AnalyticScene(
        (
            Plane((0.0, 0.0, 0.0), (0.0, 0.0, 1.0)),
            Box((66.0, 0.0, 25.0), (1.0, 200.0, 25.0), yaw_deg=-11.0),
            Sphere((0.42, 0.12, 1.55), 0.16),
            Sphere((14.0, -4.0, 2.5), 2.5),
        ),
        Texture(waves_per_octave=8),
    )
    pose = look_at((0.0, 0.0, 1.6), (10.0, 0.4, 1.2))
    camera = _off_centre_camera(size, FOCAL_RATIO)
    return Example("distant.png", scene, camera, _rolled(pose, 8.0), look)


def indoor_example(look: Appearance, size: tuple[int, int] = (192, 144)) -> Example:
    """Return a synthetic view of a furnished room with texture everywhere.

    Args:
        look: Colors that encode depth and normals (``painted``), or a random texture
            (``textured``).
        size: Width and height of the view in pixels.
    """
    scene = replace(room_scene(), texture=Texture(waves_per_octave=8))
    camera = _off_centre_camera(size, 0.9)
    return Example("indoor.png", scene, camera, arc_poses(1, 0.0)[0], look)


def _off_centre_camera(size: tuple[int, int], focal_ratio: float) -> PinholeCamera:
    """Return a camera whose principal point is not the image center, with fx != fy."""
    width, height = size
    fx = 2 * focal_ratio * width / (1 + _FY_RATIO)
    return PinholeCamera(width, height, fx, _FY_RATIO * fx, 0.45 * width, 0.54 * height)


def _rolled(pose: Float64, degrees: float) -> Float64:
    """Rotate a camera pose about the optical axis of the camera."""
    cos, sin = np.cos(np.deg2rad(degrees)), np.sin(np.deg2rad(degrees))
    rolled: Float64 = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]]) @ pose
    return rolled


def _shift_right(pose: Float64) -> Float64:
    """Move a camera to the right by 0.3 m and rotate the camera back by 4 degrees.

    Every matcher can match two views that are only 0.3 m and 4 degrees apart.
    """
    cos, sin = np.cos(np.deg2rad(4.0)), np.sin(np.deg2rad(4.0))
    turn = np.array([[cos, 0.0, sin], [0.0, 1.0, 0.0], [-sin, 0.0, cos]])
    moved = np.column_stack([pose[:, :3], pose[:, 3] - (0.3, 0.0, 0.0)])
    return turn @ moved


def _is_smooth(surface: Int64, normals: Float64 | None = None) -> Bool:
    """Return the pixels (h, w) with no surface border or normal edge within two pixels."""
    same = np.ones(surface.shape, dtype=np.bool_)
    for axis, size in enumerate(surface.shape):
        for distance in range(1, min(3, size)):
            parts = [slice(0, size - distance), slice(distance, size)]
            near, far = (part if axis == 0 else (slice(None), part) for part in parts)
            joined = surface[near] == surface[far]
            if normals is not None:
                x, y, z = np.moveaxis(normals[near] * normals[far], -1, 0)
                cosine = x + y + z
                joined &= (cosine > _COS_MAX_CREASE) | (cosine == 0)
            same[near] &= joined
            same[far] &= joined
    return same


def _with_sky(rgb: UInt8, valid: Bool) -> UInt8:
    """Fill pixels without a surface with the color gradient of a sky."""
    rows = np.linspace(0.0, 1.0, len(rgb))[:, None, None]
    sky = np.round((1 - rows) * np.array(_SKY[0]) + rows * np.array(_SKY[1])).astype(np.uint8)
    return np.where(valid[..., None], rgb, sky)
