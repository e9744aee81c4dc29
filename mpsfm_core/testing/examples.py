"""Views of analytic scenes together with the truth about them: what the checks ask about."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

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
"""``painted``: colours say depth and normals, see :mod:`mpsfm_core.testing.painted_views`.
``textured``: colours of a photo, with corners to find and match."""

_SKY = ((120, 170, 235), (200, 220, 245))
"""Colours at the upper and lower border of where a textured view shows no surface."""
_CREASE = np.cos(np.deg2rad(20.0))
"""Between neighbours whose normals differ by more than 20 degrees lies an edge."""


@dataclass(frozen=True, eq=False)
class TrueMaps:
    """The exact answer on a grid (h, w) that covers the view.

    ``depth``: (h, w), z in metres, 0 where there is no surface. ``normals``: (h, w, 3).
    ``valid``: where there is a surface. ``smooth``: where one goes on for two pixels of the grid
    in all directions and is not seen at a grazing angle, so that interpolation does no harm.
    ``edge_free``: the same for having or not having a surface at all.
    """

    depth: Float64
    normals: Float64
    valid: Bool
    smooth: Bool
    edge_free: Bool


@dataclass(frozen=True, eq=False)
class Example:
    """One view of a scene and everything that is true of it.

    ``pose``: ``cam_from_world`` (3, 4). ``mirrored``: left and right are swapped in the image and,
    therefore, in the truth.
    """

    name: str
    scene: AnalyticScene
    camera: PinholeCamera
    pose: Float64
    look: Appearance
    mirrored: bool = False

    @cached_property
    def view(self) -> View:
        """What the provider is shown."""
        if self.look == "painted":
            truth = self.truth()
            return View(self.name, paint(truth.depth, truth.normals, truth.valid), self.camera)
        rendering = self.scene.render(self._camera, self.pose)
        image = _with_sky(rendering.rgb, rendering.depth > 0)
        return View(self.name, np.ascontiguousarray(self._turned(image)), self.camera)

    def truth(
        self, shape: tuple[int, int] | None = None, offset_px: tuple[float, float] = (0.0, 0.0)
    ) -> TrueMaps:
        """The exact answer on a grid of ``(rows, columns)``, by default one pixel a pixel.

        ``offset_px``: moves the grid by so many pixels of the view.
        """
        rows, columns = shape or (self.camera.height, self.camera.width)
        scale = self.camera.width / columns, self.camera.height / rows
        offset = (-offset_px[0] if self.mirrored else offset_px[0], offset_px[1])
        xy = pixel_centers(columns, rows) * scale + offset
        seen = self.scene.sample(self._camera, self.pose, xy)
        valid = seen.valid.reshape(rows, columns)
        surface = np.where(valid, seen.surface.reshape(rows, columns), -1)
        normals = seen.normals.reshape(rows, columns, 3)
        steep = np.abs(normals[..., :2]).max(axis=-1) > 0.9 * MAX_SLOPE * -normals[..., 2]
        smooth = valid & _continues(surface, normals) & ~steep
        depth, normals = seen.depth.reshape(rows, columns), np.where(valid[..., None], normals, 0)
        edge_free = _continues(valid.astype(np.int64), np.zeros_like(normals))
        if self.mirrored:
            normals = normals * (-1.0, 1.0, 1.0)
        parts = (depth, normals, valid, smooth, edge_free)
        return TrueMaps(*(np.ascontiguousarray(self._turned(part)) for part in parts))

    def correspondences(self, other: Example, xy: Float64) -> TrueCorrespondences:
        """Where points seen through pixels (n, 2) of this view lie in the other one."""
        return self.scene.correspondences(self.camera, self.pose, other.camera, other.pose, xy)

    @cached_property
    def partner(self) -> Example:
        """The same surfaces from a little to the side, with the same camera."""
        return replace(self, name=f"beside/{self.name}", pose=_beside(self.pose))

    def mirror(self) -> Example:
        """The view and the truth as a mirror shows them."""
        camera = replace(self.camera, cx=self.camera.width - self.camera.cx)
        name = f"mirrored/{self.name}"
        return replace(self, name=name, camera=camera, mirrored=not self.mirrored)

    def sized(self, width: int, height: int) -> Example:
        """The scene from the same place with the same focal length over height, on another
        grid, which may show more or less of it."""
        focal = self.camera.fy * height / self.camera.height
        camera = PinholeCamera(width, height, focal, focal, width / 2, height / 2)
        return replace(self, name=f"{width}x{height}/{self.name}", camera=camera)

    @property
    def _camera(self) -> PinholeCamera:
        """The camera of the scene as it is, before the mirror."""
        if not self.mirrored:
            return self.camera
        return replace(self.camera, cx=self.camera.width - self.camera.cx)

    def _turned(self, values: np.ndarray) -> np.ndarray:
        return values[:, ::-1] if self.mirrored else values


def outdoor_example(look: Appearance, size: tuple[int, int] = (192, 144)) -> Example:
    """Ground, a slanted wall and two balls below an open sky: everything a map can get wrong.

    The camera looks down and to the side and is rolled, so that no axis of the world is one of
    the camera's and nothing is symmetric, and its field of view is wide: at the corners a ray is
    1.3 times as long as its z.
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
    width, height = size
    focal = 0.75 * width
    camera = PinholeCamera(width, height, focal, focal, width / 2, height / 2)
    pose = look_at((0.0, 0.0, 1.6), (4.0, 0.3, 1.6 - 4.0 * np.tan(np.deg2rad(20.0))))
    return Example("outdoor.png", scene, camera, _rolled(pose, 15.0), look)


def indoor_example(look: Appearance, size: tuple[int, int] = (192, 144)) -> Example:
    """The furnished room, full of texture."""
    width, height = size
    focal = 0.9 * width
    camera = PinholeCamera(width, height, focal, focal, width / 2, height / 2)
    scene = replace(room_scene(), texture=Texture(waves_per_octave=8))
    return Example("indoor.png", scene, camera, arc_poses(1, 0.0)[0], look)


def _rolled(pose: Float64, degrees: float) -> Float64:
    """The pose with the camera turned about its optical axis."""
    cos, sin = np.cos(np.deg2rad(degrees)), np.sin(np.deg2rad(degrees))
    rolled: Float64 = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]]) @ pose
    return rolled


def _beside(pose: Float64) -> Float64:
    """The pose moved to the right by 0.3 m and turned back by 4 degrees: well within what any
    matcher can match."""
    cos, sin = np.cos(np.deg2rad(4.0)), np.sin(np.deg2rad(4.0))
    turn = np.array([[cos, 0.0, sin], [0.0, 1.0, 0.0], [-sin, 0.0, cos]])
    moved = np.column_stack([pose[:, :3], pose[:, 3] - (0.3, 0.0, 0.0)])
    return turn @ moved


def _continues(surface: Int64, normals: Float64) -> Bool:
    """Whether all pixels up to two away are of the same surface and of similar normals."""
    same = np.ones(surface.shape, dtype=np.bool_)
    rows, columns = surface.shape
    for axis, size in ((0, rows), (1, columns)):
        for distance in (1, 2):
            if distance >= size:
                continue
            near = np.arange(size - distance)
            here, there = (np.take(surface, i, axis) for i in (near, near + distance))
            cosine = (np.take(normals, near, axis) * np.take(normals, near + distance, axis)).sum(
                -1
            )
            joined = (here == there) & ((cosine > _CREASE) | (cosine == 0))
            for index in (near, near + distance):
                place = (index, slice(None)) if axis == 0 else (slice(None), index)
                same[place] &= joined
    return same


def _with_sky(rgb: UInt8, valid: Bool) -> UInt8:
    rows = np.linspace(0.0, 1.0, len(rgb))[:, None, None]
    sky = np.round((1 - rows) * np.array(_SKY[0]) + rows * np.array(_SKY[1])).astype(np.uint8)
    return np.where(valid[..., None], rgb, sky)
