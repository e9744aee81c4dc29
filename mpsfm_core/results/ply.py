"""Reader and writer of PLY files: point clouds and meshes."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mpsfm_core.data import Float32, Float64, Int64, UInt8
from mpsfm_core.data.errors import InputError
from mpsfm_core.dense.fusion import FusedPointCloud

_TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"},
    **{"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4"},
    **{"float": "f4", "double": "f8", "float32": "f4", "float64": "f8"},
}
_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": "="}
_LONGEST_HEADER = 1 << 16
_FACE = np.dtype([("count", "u1"), ("rows", "<i4", 3)])


def write_ply(
    path: Path,
    points: Float64,
    colors: UInt8,
    normals: Float32 | None = None,
    extra: Mapping[str, NDArray[Any]] = MappingProxyType({}),
    triangles: Int64 | None = None,
) -> None:
    """Write a point cloud or mesh as binary little-endian PLY.

    Args:
        path: PLY file to write.
        points: (n, 3) vertex positions, written as float32.
        colors: (n, 3) uint8 RGB colors of the vertices.
        normals: (n, 3), optional.
        extra: further vertex properties (n,) by name, float32 or uint8.
        triangles: (m, 3) vertex indices of the triangles of a mesh, optional.
    """
    columns: dict[str, NDArray[Any]] = dict(zip("xyz", points.T.astype("<f4"), strict=True))
    if normals is not None:
        columns |= zip(("nx", "ny", "nz"), normals.T.astype("<f4"), strict=True)
    columns |= zip(("red", "green", "blue"), colors.T, strict=True)
    columns |= extra
    kinds = {name: "uchar" if x.dtype == np.uint8 else "float" for name, x in columns.items()}
    layout = [(name, "<" + _TYPES[kind]) for name, kind in kinds.items()]
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


def write_cloud(path: Path, cloud: FusedPointCloud) -> None:
    """Write a fused point cloud with the properties ``std`` and ``views``."""
    extra: dict[str, NDArray[Any]] = {"std": cloud.std, "views": cloud.views}
    write_ply(path, cloud.points, cloud.colors, cloud.normals, extra)


class _PlyFile(NamedTuple):
    """Content of a PLY file after its header was parsed."""

    encoding: str
    """Key of :data:`_ORDERS`."""
    header: list[str]
    """Lines of the header after the format line."""
    vertex: np.dtype[Any]
    """Layout of a vertex."""
    num_vertices: int
    """Number of vertices."""
    body: bytes
    """Bytes after the header."""


def read_ply(path: Path) -> tuple[Float64, UInt8]:
    """Read the vertices of a text or binary PLY file.

    Returns:
        Points (n, 3) float64 and RGB colors (n, 3) uint8, gray if the file has no colors.

    Raises:
        InputError: the file is not a PLY file, is cut off, or has points that are not finite.
    """
    return _read_vertices(path, _parse_ply(path))


def read_normals(path: Path) -> Float32 | None:
    """Read the normals (n, 3) of the points of a PLY file, None if the file has none.

    Raises:
        InputError: as :func:`read_ply`.
    """
    vertices = _read_vertex_table(path, _parse_ply(path))
    axes = ("nx", "ny", "nz")
    if not set(axes) <= set(vertices.dtype.names or ()):
        return None
    return np.stack([vertices[axis] for axis in axes], axis=1).astype(np.float32)


def read_mesh(path: Path) -> tuple[Float64, UInt8, Int64]:
    """Read the vertices and triangles of a text or binary PLY file.

    Returns:
        Points (n, 3) float64 and RGB colors (n, 3) uint8 as of :func:`read_ply`, and vertex indices
        (m, 3) int64 of the triangles, (0, 3) for a point cloud.

    Raises:
        InputError: as :func:`read_ply`; or the file has faces that are not triangles, or the index
            of a missing vertex.
    """
    file = _parse_ply(path)
    return *_read_vertices(path, file), _read_triangles(path, file)


def _read_vertex_table(path: Path, file: _PlyFile) -> NDArray[Any]:
    """Return the vertices (n,) as a structured array."""
    encoding, _, vertex, count, body = file
    if encoding == "ascii":
        return _read_text(path, body, vertex, count)
    if len(body) < count * vertex.itemsize:
        raise InputError(f"PLY file {path} is cut off: the header has {count} points")
    return np.frombuffer(body, vertex, count)


def _read_vertices(path: Path, file: _PlyFile) -> tuple[Float64, UInt8]:
    vertices = _read_vertex_table(path, file)
    points = np.stack([vertices[axis] for axis in "xyz"], axis=1).astype(np.float64)
    if not np.isfinite(points).all():
        raise InputError(f"PLY file {path} has points that are not finite")
    rgb = ("red", "green", "blue")
    if not set(rgb) <= set(vertices.dtype.names or ()):
        return points, np.full((len(points), 3), 128, np.uint8)
    return points, np.stack([vertices[color] for color in rgb], axis=1).astype(np.uint8)


def _read_triangles(path: Path, file: _PlyFile) -> Int64:
    encoding, header, vertex, count, body = file
    match [line.split() for line in header if line.startswith(("element", "property list"))]:
        case [["element", "vertex", _]]:
            return np.zeros((0, 3), np.int64)
        case [
            ["element", "vertex", _],
            ["element", "face", number],
            ["property", "list", size, index, _],
            *_,
        ] if {size, index} <= _TYPES.keys() and number.isdecimal():
            order = _ORDERS[encoding]
            face = np.dtype([("count", order + _TYPES[size]), ("rows", order + _TYPES[index], 3)])
        case _:
            raise InputError(
                f"{path}: the PLY header has elements other than vertices and triangles"
            )
    if encoding == "ascii":
        lines = body.decode("ascii", "replace").splitlines()[count : count + int(number)]
        rows = [line.split()[:4] for line in lines]
        if len(rows) < int(number) or any(row[:1] != ["3"] or len(row) < 4 for row in rows):
            raise InputError(f"PLY file {path} is cut off or has faces that are not triangles")
        triangles = np.array(rows, np.int64).reshape(-1, 4)[:, 1:]
    else:
        try:
            faces = np.frombuffer(body, face, int(number), count * vertex.itemsize)
        except ValueError as error:
            raise InputError(
                f"PLY file {path} is cut off: the header has {number} faces"
            ) from error
        if (faces["count"] != 3).any():
            raise InputError(f"{path}: the PLY file has faces that are not triangles")
        triangles = faces["rows"].astype(np.int64)
    if triangles.size and not (triangles.min() >= 0 and triangles.max() < count):
        raise InputError(f"{path}: a face of the PLY file has the index of a missing vertex")
    return triangles


def _parse_ply(path: Path) -> _PlyFile:
    """Read a PLY file and parse its header."""
    try:
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror or error}") from error
    end = data.find(b"end_header", 0, _LONGEST_HEADER)
    start = data.find(b"\n", end) + 1 if end >= 0 else 0
    lines = data[: max(end, 0)].decode("ascii", "replace").splitlines()
    match [line.split() for line in lines[:2]]:
        case [["ply"], ["format", encoding, *_]] if encoding in _ORDERS and start:
            vertex, count = _layout(path, lines[2:], _ORDERS[encoding])
        case _:
            raise InputError(f"{path} is not a PLY file")
    return _PlyFile(encoding, lines[2:], vertex, count, data[start:])


def _layout(path: Path, header: list[str], order: str) -> tuple[np.dtype[Any], int]:
    """Parse the PLY header; return the dtype and the number of the vertices."""
    layout: list[tuple[str, str]] = []
    count: int | None = None
    for line in header:
        match line.split():
            case ["element", "vertex", number] if number.isdecimal() and count is None:
                count = int(number)
            case ["element", *_]:
                break  # vertices come first
            case ["property", kind, name] if kind in _TYPES:
                layout.append((name, order + _TYPES[kind]))
            case ["property", *_]:
                raise InputError(f"{path}: a vertex property has an unknown type: {line}")
    names = [name for name, _ in layout]
    if count is None or not {"x", "y", "z"} <= set(names) or len(set(names)) < len(names):
        raise InputError(f"{path}: the vertices need x, y and z once each in the PLY header")
    return np.dtype(layout), count


def _read_text(path: Path, body: bytes, vertex: np.dtype[Any], count: int) -> NDArray[Any]:
    lines = body.decode("ascii", "replace").splitlines()[:count]
    if len(lines) < count:
        raise InputError(f"PLY file {path} is cut off: the header has {count} points")
    try:
        return np.array([tuple(map(float, line.split())) for line in lines], dtype=vertex)
    except (ValueError, OverflowError) as error:
        raise InputError(f"PLY file {path} has a point that cannot be read: {error}") from error
