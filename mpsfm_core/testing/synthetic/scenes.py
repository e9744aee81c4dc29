"""Analytic scenes rendered by ray casting: exact depth, normals, colors and correspondences.

The world frame of a scene is metric with z up. Cameras follow COLMAP: x right, y down, z forward,
pixel centers at half integers. A camera pose is a (3, 4) matrix ``cam_from_world``.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike

from mpsfm_core import geometry
from mpsfm_core.data import Bool, Float32, Float64, Int64, PinholeCamera, UInt8

_EPSILON = 1e-9
"""Smallest distance in meters between the origin of a ray and an intersection. Closer intersections
are on the surface at which the ray starts."""
_GROUP = 16
"""Number of surfaces that rays are tested against at the same time."""


class Surface(Protocol):
    """Surface of a scene that can be intersected with rays."""

    @property
    def bounding_sphere(self) -> tuple[tuple[float, float, float], float]:
        """Center and radius of a sphere around the surface, ``inf`` for an infinite surface."""
        ...

    def intersect(self, origin: Float64, directions: Float64) -> tuple[Float64, Float64]:
        """Intersect rays ``origin + t * direction`` with the surface.

        Args:
            origin: Common origin (3,).
            directions: Ray directions (n, 3) in the world frame, of any length.

        Returns:
            Parameters t (n,) of the first intersections, inf without an intersection, and unit
            normals (n, 3) that face the origin of the ray. Normals of rays without an intersection
            are arbitrary.
        """
        ...


@dataclass(frozen=True)
class Plane:
    """Infinite plane through ``point`` with a ``normal`` of any non-zero length."""

    point: tuple[float, float, float]
    normal: tuple[float, float, float]

    @property
    def bounding_sphere(self) -> tuple[tuple[float, float, float], float]:
        """A point of the plane, and the radius ``inf``."""
        return self.point, np.inf

    def intersect(self, origin: Float64, directions: Float64) -> tuple[Float64, Float64]:
        """Intersect rays ``origin + t * direction`` with the surface."""
        normal = np.asarray(self.normal) / np.linalg.norm(self.normal)
        t = (np.asarray(self.point) - origin) @ normal / _away_from_zero(directions @ normal)
        facing = np.where(directions @ normal > 0, -1.0, 1.0)
        return np.where(t > _EPSILON, t, np.inf), facing[:, None] * normal


@dataclass(frozen=True)
class Box:
    """Box rotated about the world's z axis, or a room for cameras inside of the box."""

    center: tuple[float, float, float]
    half_size: tuple[float, float, float]
    yaw_deg: float = 0.0

    @property
    def bounding_sphere(self) -> tuple[tuple[float, float, float], float]:
        """Center and radius of the smallest sphere around the box."""
        return self.center, math.hypot(*self.half_size)

    def intersect(self, origin: Float64, directions: Float64) -> tuple[Float64, Float64]:
        """Intersect rays ``origin + t * direction`` with the surface."""
        cos, sin = np.cos(np.deg2rad(self.yaw_deg)), np.sin(np.deg2rad(self.yaw_deg))
        world_from_box = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
        start = (origin - np.asarray(self.center)) @ world_from_box
        # Each row is one component of all rays, because numpy reduces long axes faster.
        rays = np.ascontiguousarray(_away_from_zero(directions @ world_from_box).T)
        half_size, start = np.asarray(self.half_size)[:, None], start[:, None]
        t_low = (-np.sign(rays) * half_size - start) / rays
        t_high = (np.sign(rays) * half_size - start) / rays
        t_enter, t_leave = t_low.max(0), t_high.min(0)
        outside = t_enter > _EPSILON
        axis = np.where(outside, t_low.argmax(0), t_high.argmin(0))
        t = np.where(outside, t_enter, t_leave)
        t = np.where((t_leave >= t_enter) & (t > _EPSILON), t, np.inf)
        facing = -np.sign(np.take_along_axis(rays, axis[None], 0))[0][:, None]
        return t, facing * world_from_box.T[axis]


@dataclass(frozen=True)
class Sphere:
    """Sphere that is visible from outside and inside."""

    center: tuple[float, float, float]
    radius: float

    @property
    def bounding_sphere(self) -> tuple[tuple[float, float, float], float]:
        """Center and radius of the sphere."""
        return self.center, self.radius

    def intersect(self, origin: Float64, directions: Float64) -> tuple[Float64, Float64]:
        """Intersect rays ``origin + t * direction`` with the surface."""
        start = origin - np.asarray(self.center)
        a = np.einsum("ni,ni->n", directions, directions)
        b = directions @ start
        discriminant = b * b - a * (start @ start - self.radius**2)
        root = np.sqrt(np.maximum(discriminant, 0.0))
        near, far = (-b - root) / a, (-b + root) / a
        t = np.where(near > _EPSILON, near, far)
        t = np.where((discriminant >= 0) & (t > _EPSILON), t, np.inf)
        outward = start + np.where(np.isfinite(t), t, 0.0)[:, None] * directions
        outward /= np.maximum(np.linalg.norm(outward, axis=1, keepdims=True), _EPSILON)
        inside = np.einsum("ni,ni->n", outward, directions) > 0
        return t, np.where(inside, -1.0, 1.0)[:, None] * outward


@dataclass(frozen=True)
class Texture:
    """Random 3D color texture, a sum of plane waves with random direction and phase.

    The color texture has no visible repetitions. The argument ``footprint``, the size of a pixel on
    the surface in meters, limits the frequencies of the texture. Images rendered with this texture
    therefore have no aliasing.
    """

    longest_wave: float = 1.2
    """Longest wavelength of the texture in meters."""
    octaves: int = 6
    waves_per_octave: int = 24
    decay: float = 0.85
    """Amplitude ratio between an octave of the texture and the previous, coarser octave."""
    contrast: float = 0.7
    """Standard deviation of texture values before these are softly clipped to [-1, 1]."""
    seed: int = 0

    def colors(self, points: Float64, surface: Int64, footprint: Float64) -> UInt8:
        """Compute the colors of surface points from the texture.

        Args:
            points: Surface points (n, 3) in the world frame.
            surface: Index (n,) of the surface of each point; every surface has its own texture.
            footprint: Size (n,) of a pixel on the surface in meters.

        Returns:
            Colors RGB (n, 3) uint8.
        """
        rng = np.random.default_rng(self.seed)
        amplitudes = self.decay ** np.arange(self.octaves)
        amplitudes *= self.contrast / np.sqrt(0.5 * self.waves_per_octave * (amplitudes**2).sum())
        shifts = rng.uniform(-20.0, 20.0, (256, 3))
        where = (points + shifts[surface % 256]).astype(np.float32)
        value = rng.uniform(-0.4, 0.4, (256, 3))[surface % 256]
        for octave, amplitude in enumerate(amplitudes):
            frequency = 2.0**octave / self.longest_wave
            vectors = rng.normal(size=(3, self.waves_per_octave))
            vectors *= 2 * np.pi * frequency / np.linalg.norm(vectors, axis=0)
            phase = rng.uniform(0, 2 * np.pi, self.waves_per_octave)
            mix = rng.normal(1.0, 0.5, (self.waves_per_octave, 3))
            waves = np.sin(where @ vectors.astype(np.float32) + phase.astype(np.float32))
            # Each wave is filtered by a Gaussian pixel with a std of half a footprint.
            attenuated = amplitude * np.exp(-0.5 * (np.pi * frequency * footprint) ** 2)
            value += attenuated[:, None] * (waves @ mix.astype(np.float32))
        return np.round(127.5 + 127.5 * np.tanh(value)).astype(np.uint8)


@dataclass(frozen=True, eq=False)
class Rendering:
    """Rendered depth, normals and colors of a pinhole camera, zero at pixels without a surface.

    Normals face the camera along the ray, so n_z can be positive at grazing angles off the axis.
    """

    depth: Float32
    """Depth (h, w) along the optical axis in meters."""
    normals: Float32
    """Unit normals (h, w, 3) in the camera frame."""
    _colors: Callable[[], UInt8]

    @cached_property
    def rgb(self) -> UInt8:
        """Colors RGB (h, w, 3) uint8."""
        return self._colors()


class SurfaceSamples(NamedTuple):
    """Surface points seen at given pixels, with zeros where ``valid`` is false."""

    points: Float64
    """Surface points (n, 3) in the world frame in meters."""
    depth: Float64
    """Depths (n,) of the surface points along the optical axis in meters."""
    normals: Float64
    """Unit normals (n, 3) in the camera frame that face the camera."""
    surface: Int64
    """Indices (n,) of the surfaces of the scene on which the points lie."""
    valid: Bool
    """Validity (n,) of the samples, True where the pixel shows a surface."""


class TrueCorrespondences(NamedTuple):
    """Exact positions in view b of surface points that are seen in view a."""

    xy_b: Float64
    """Pixel positions (n, 2) of the points in view b, 0 where view b does not see the point."""
    points: Float64
    """Surface points (n, 3) in the world frame in meters."""
    visible: Bool
    """Visibility (n,) of the points, True where view b sees the point without occlusion."""


@dataclass(frozen=True)
class AnalyticScene:
    """Scene of opaque surfaces with a texture."""

    surfaces: tuple[Surface, ...]
    texture: Texture = Texture()

    def first_hit(self, origin: Float64, directions: Float64) -> tuple[Float64, Float64, Int64]:
        """Intersect rays (n, 3) with all surfaces of the scene.

        Returns:
            Ray parameters t (n,) of the nearest intersections, inf without an intersection, normals
            (n, 3), and indices (n,) of the intersected surfaces.
        """
        t = np.full(len(directions), np.inf)
        normals = np.zeros((len(directions), 3))
        surface = np.zeros(len(directions), np.int64)
        centers, radii = self.bounding_spheres
        distances = np.linalg.norm(origin - centers, axis=1) - radii
        lengths = np.linalg.norm(directions, axis=1)
        nearest_first = np.argsort(distances, kind="stable")
        for start in range(0, len(nearest_first), _GROUP):
            group = nearest_first[start : start + _GROUP]
            # rays that end in front of all surfaces of the group cannot hit them first
            rays = np.flatnonzero(t * lengths >= distances[group[0]])
            for index, near in self._select_rays(origin, directions, rays, group):
                t_new, normals_new = self.surfaces[index].intersect(origin, directions[near])
                nearer = (t_new < t[near]) | ((t_new == t[near]) & (index < surface[near]))
                rows = near[nearer]
                t[rows], normals[rows], surface[rows] = t_new[nearer], normals_new[nearer], index
        return t, normals, surface

    @cached_property
    def bounding_spheres(self) -> tuple[Float64, Float64]:
        """Centers (m, 3) and radii (m,) of the bounding spheres of all surfaces, in meters."""
        spheres = [surface.bounding_sphere for surface in self.surfaces]
        centers = np.array([center for center, _ in spheres], np.float64).reshape(-1, 3)
        return centers, np.array([radius for _, radius in spheres], np.float64)

    def _select_rays(
        self, origin: Float64, directions: Float64, rays: Int64, group: Int64
    ) -> Iterator[tuple[int, Int64]]:
        """Yield surfaces of a group, each with those of the rays that meet its bounding sphere."""
        centers, radii = self.bounding_spheres
        start = origin - centers[group]
        outside = np.einsum("mi,mi->m", start, start) - radii[group] ** 2
        length = np.einsum("ni,ni->n", directions[rays], directions[rays])
        along = directions[rays] @ start.T
        meets = (along < 0) & (along * along >= outside * length[:, None])
        meets |= outside <= 0
        for column in map(int, np.flatnonzero(meets.any(axis=0))):
            yield int(group[column]), rays[meets[:, column]]

    def sample(
        self, camera: PinholeCamera, cam_from_world: ArrayLike, xy: ArrayLike
    ) -> SurfaceSamples:
        """Intersect the rays through pixels ``xy`` (n, 2) of a camera with the scene."""
        rotation, origin = _split_pose(cam_from_world)
        pixels = np.asarray(xy, np.float64).reshape(-1, 2)
        directions = geometry.rays(camera, pixels) @ rotation
        depth, normals, surface = self.first_hit(origin, directions)
        valid = np.isfinite(depth)
        depth = np.where(valid, depth, 0.0)
        points = np.where(valid[:, None], origin + depth[:, None] * directions, 0.0)
        return SurfaceSamples(points, depth, normals @ rotation.T, surface, valid)

    def render(self, camera: PinholeCamera, cam_from_world: ArrayLike) -> Rendering:
        """Render depth, normals and colors of the scene at every pixel center."""
        xy = geometry.pixel_centers(camera.width, camera.height)
        seen = self.sample(camera, cam_from_world, xy)
        shape = (camera.height, camera.width)

        def colors() -> UInt8:
            rgb = self.texture.colors(seen.points, seen.surface, seen.depth / camera.fx)
            rgb[~seen.valid] = 0
            return rgb.reshape(*shape, 3)

        return Rendering(
            seen.depth.reshape(shape).astype(np.float32),
            seen.normals.reshape(*shape, 3).astype(np.float32),
            colors,
        )

    def correspondences(
        self,
        camera_a: PinholeCamera,
        a_from_world: ArrayLike,
        camera_b: PinholeCamera,
        b_from_world: ArrayLike,
        xy_a: ArrayLike,
    ) -> TrueCorrespondences:
        """Project the surface points seen at pixels ``xy_a`` (n, 2) of view a into view b."""
        seen = self.sample(camera_a, a_from_world, xy_a)
        xy_b, depth_b = project(camera_b, b_from_world, seen.points)
        _, origin = _split_pose(b_from_world)
        t, _, _ = self.first_hit(origin, seen.points - origin)
        visible = seen.valid & (depth_b > 0) & geometry.inside(xy_b, camera_b.size)
        visible &= np.abs(t - 1.0) < 1e-6
        return TrueCorrespondences(np.where(visible[:, None], xy_b, 0.0), seen.points, visible)


def project(
    camera: PinholeCamera, cam_from_world: ArrayLike, points: Float64
) -> tuple[Float64, Float64]:
    """Project world points (n, 3); return pixels (n, 2), 0 behind the camera, and depths (n,)."""
    pose = np.asarray(cam_from_world, np.float64)
    local = geometry.transform(pose[:3, :3], pose[:3, 3], points)
    return np.nan_to_num(geometry.project(camera, local), nan=0.0), local[:, 2]


def look_at(eye: ArrayLike, target: ArrayLike, up: ArrayLike = (0.0, 0.0, 1.0)) -> Float64:
    """Return ``cam_from_world`` (3, 4) of an upright camera at ``eye`` that looks at ``target``.

    The viewing direction from ``eye`` to ``target`` must not be parallel to ``up``.
    """
    position = np.asarray(eye, np.float64)
    forward = np.asarray(target, np.float64) - position
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, np.asarray(up, np.float64))
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    return np.column_stack([rotation, -rotation @ position])


def room_scene(seed: int = 0) -> AnalyticScene:
    """Return a furnished room of 6 x 5 x 2.6 m around the origin with its floor at z = 0."""
    room = Box((0.0, 0.0, 1.3), (3.0, 2.5, 1.3))
    furniture: Sequence[Surface] = (
        Box((0.6, 0.5, 0.35), (0.6, 0.4, 0.35), yaw_deg=25.0),  # table
        Box((2.7, -1.0, 0.9), (0.3, 0.7, 0.9)),  # cupboard
        Box((2.3, 1.6, 0.45), (0.4, 0.5, 0.45), yaw_deg=-15.0),
        Box((-1.2, 1.9, 0.3), (0.7, 0.4, 0.3), yaw_deg=8.0),
        Sphere((0.5, 0.5, 0.95), 0.25),  # on the table
        Sphere((1.5, -1.2, 0.4), 0.4),
        Sphere((0.0, -1.6, 0.3), 0.3),
        Sphere((2.3, 1.6, 1.15), 0.25),
    )
    return AnalyticScene((room, *furniture), Texture(seed=seed))


def arc_poses(
    count: int,
    step_deg: float,
    *,
    target: tuple[float, float, float] = (1.2, 0.0, 0.8),
    radius: float = 3.4,
    height: float = 1.6,
) -> list[Float64]:
    """Return camera poses that look at ``target`` from an arc, ``step_deg`` apart.

    With the default values the cameras stay inside :func:`room_scene` up to 60 degrees to either
    side of the middle of the arc.
    """
    angles = np.deg2rad(180.0 + step_deg * (np.arange(count) - (count - 1) / 2))
    eyes = np.asarray(target) + radius * np.column_stack(
        [np.cos(angles), np.sin(angles), np.zeros(count)]
    )
    eyes[:, 2] = height
    return [look_at(eye, target) for eye in eyes]


def _split_pose(cam_from_world: ArrayLike) -> tuple[Float64, Float64]:
    """Return the rotation (3, 3) and the camera center (3,) in the world frame."""
    pose = np.asarray(cam_from_world, np.float64)
    return pose[:3, :3], geometry.camera_center(pose[:3, :3], pose[:3, 3])


def _away_from_zero(values: Float64) -> Float64:
    return np.where(np.abs(values) < 1e-12, 1e-12, values)
