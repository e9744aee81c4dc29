"""Simple solids for the open Blender scene, in meters, world z up."""

from __future__ import annotations

from collections.abc import Sequence

import bpy
import numpy as np
from numpy.typing import NDArray

BOX_FACES = [(0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5)]
SEGMENTS = 64

Vector = Sequence[float]
Profile = Sequence[tuple[float, float]]


def add_mesh(
    vertices: NDArray[np.float64],
    faces: Sequence[Sequence[int]],
    material: bpy.types.Material,
    *,
    at: Vector = (0, 0, 0),
    turn_deg: float = 0,
) -> None:
    """Add a mesh whose vertices (n, 3) are rotated about z by ``turn_deg`` and moved to ``at``."""
    c, s = np.cos(np.radians(turn_deg)), np.sin(np.radians(turn_deg))
    turned = vertices @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]) + np.asarray(at)
    mesh = bpy.data.meshes.new("part")
    mesh.from_pydata(turned.tolist(), [], [list(f) for f in faces])
    mesh.materials.append(material)
    bpy.context.collection.objects.link(bpy.data.objects.new("part", mesh))


def add_box(material: bpy.types.Material, size: Vector, at: Vector, *, turn_deg: float = 0) -> None:
    """Add a box of ``size`` whose bottom face is centered at ``at``."""
    corners = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (0, 1)])
    add_mesh(corners * size, BOX_FACES, material, at=at, turn_deg=turn_deg)


def add_turned(
    material: bpy.types.Material, profile: Profile, at: Vector, *, stretch: Vector = (1, 1, 1)
) -> None:
    """Add a solid of revolution whose ``profile`` lists (radius, height) from bottom to top."""
    angle = np.arange(SEGMENTS) * 2 * np.pi / SEGMENTS
    rings = [np.stack([r * np.cos(angle), r * np.sin(angle), 0 * angle + z], 1) for r, z in profile]
    faces = _grid_faces(len(rings), SEGMENTS)
    add_mesh(np.concatenate(rings) * stretch, faces, material, at=at)


def add_cylinder(material: bpy.types.Material, radius: float, height: float, at: Vector) -> None:
    """Add an upright closed cylinder at ``at``."""
    add_turned(material, [(0, 0), (radius, 0), (radius, height), (0, height)], at)


def add_ellipsoid(material: bpy.types.Material, radii: Vector, at: Vector) -> None:
    """Add an ellipsoid with half axes ``radii`` centered at ``at``."""
    polar = np.linspace(0, np.pi, SEGMENTS // 2 + 1)
    add_turned(material, list(zip(np.sin(polar), -np.cos(polar), strict=True)), at, stretch=radii)


def add_sheet(material: bpy.types.Material, points: NDArray[np.float64]) -> None:
    """Add a surface through a (rows, columns, 3) grid of world points (curtain, leaf)."""
    rows, columns = points.shape[:2]
    faces = _grid_faces(rows, columns, closed=False)
    add_mesh(points.reshape(-1, 3), faces, material)


def _grid_faces(rows: int, columns: int, closed: bool = True) -> list[tuple[int, int, int, int]]:
    return [
        (r * columns + c, r * columns + d, (r + 1) * columns + d, (r + 1) * columns + c)
        for r in range(rows - 1)
        for c in range(columns if closed else columns - 1)
        for d in [(c + 1) % columns]
    ]
