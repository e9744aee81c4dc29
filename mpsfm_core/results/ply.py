"""Binary PLY files: point clouds and meshes."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mpsfm_core.data import Float32, Float64, Int64, UInt8
from mpsfm_core.dense.fusion import Cloud
from mpsfm_core.errors import InputError

_TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "<i2", "ushort": "<u2", "int": "<i4", "uint": "<u4"},
    **{"int8": "i1", "uint8": "u1", "int16": "<i2", "uint16": "<u2", "int32": "<i4"},
    **{"uint32": "<u4", "float": "<f4", "double": "<f8", "float32": "<f4", "float64": "<f8"},
}
_LONGEST_HEADER = 1 << 16
_FACE = np.dtype([("count", "u1"), ("rows", "<i4", 3)])


def write_ply(
    path: Path,
    points: Float64,
    colors: UInt8,
    normals: Float32 | None = None,
    further: Mapping[str, NDArray[Any]] = MappingProxyType({}),
    triangles: Int64 | None = None,
) -> None:
    """Write points (n, 3) with RGB colours (n, 3) as little-endian float32 and uint8.

    ``normals``: (n, 3). ``further``: properties (n,) by name, float32 or uint8. ``triangles``:
    (m, 3), rows of the points.
    """
    columns: dict[str, NDArray[Any]] = dict(zip("xyz", points.T.astype("<f4"), strict=True))
    if normals is not None:
        columns |= zip(("nx", "ny", "nz"), normals.T.astype("<f4"), strict=True)
    columns |= zip(("red", "green", "blue"), colors.T, strict=True)
    columns |= further
    kinds = {name: "uchar" if x.dtype == np.uint8 else "float" for name, x in columns.items()}
    layout = [(name, _TYPES[kind]) for name, kind in kinds.items()]
    vertices = np.empty(len(points), dtype=layout)
    for name, values in columns.items():
        vertices[name] = values
    header = [
        "ply",
        "format binary_little_endian 1.0",
        f"element vertex {len(points)}",
        *(f"property {kind} {name}" for name, kind in kinds.items()),
    ]
    faces = np.empty(0 if triangles is None else len(triangles), _FACE)
    if triangles is not None:
        faces["count"], faces["rows"] = 3, triangles
        header += [f"element face {len(faces)}", "property list uchar int vertex_indices"]
    text = "\n".join([*header, "end_header", ""]).encode("ascii")
    path.write_bytes(text + vertices.tobytes() + faces.tobytes())


def write_cloud(path: Path, cloud: Cloud) -> None:
    """Write a fused cloud, with ``std`` and ``views`` as properties of that name."""
    further: dict[str, NDArray[Any]] = {"std": cloud.std, "views": cloud.views}
    write_ply(path, cloud.points, cloud.colors, cloud.normals, further)


def read_ply(path: Path) -> tuple[Float64, UInt8]:
    """Points (n, 3) and RGB colours (n, 3) of a binary little-endian PLY; grey without colours.

    Raises :class:`InputError` when it is another kind of file, or cut off.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror or error}") from error
    end = data.find(b"end_header\n", 0, _LONGEST_HEADER)
    lines = data[: max(end, 0)].decode("ascii", "replace").splitlines()
    if lines[:2] != ["ply", "format binary_little_endian 1.0"]:
        raise InputError(f"{path}: is no binary little-endian PLY file")
    layout: list[tuple[str, str]] = []
    count = 0
    for line in lines[2:]:
        match line.split():
            case ["element", "vertex", number] if number.isdecimal():
                count = int(number)
            case ["element", *_]:
                break  # vertices come first
            case ["property", kind, name] if kind in _TYPES:
                layout.append((name, _TYPES[kind]))
    names = [name for name, _ in layout]
    if not {"x", "y", "z"} <= set(names) or len(set(names)) < len(names):
        raise InputError(f"{path}: its points have no x, y and z, or have them twice")
    vertex = np.dtype(layout)
    body = memoryview(data)[end + len(b"end_header\n") :]
    if len(body) < count * vertex.itemsize:
        raise InputError(f"{path}: is cut off, {count} points are announced")
    vertices = np.frombuffer(body, vertex, count)
    points = np.stack([vertices[axis] for axis in "xyz"], axis=1).astype(np.float64)
    if not np.isfinite(points).all():
        raise InputError(f"{path}: has points that are not finite")
    rgb = ("red", "green", "blue")
    if not set(rgb) <= set(names):
        return points, np.full((count, 3), 128, np.uint8)
    return points, np.stack([vertices[color] for color in rgb], axis=1).astype(np.uint8)
