"""Reader and writer of Wavefront OBJ files with one texture."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from mpsfm_core.data import Bool, Int64
from mpsfm_core.data.errors import InputError
from mpsfm_core.dense.texture import TexturedMesh
from mpsfm_core.geometry.statistics import unique_rows
from mpsfm_core.support.jpeg import encode_jpeg

MEASURED, CLOSED_HOLES = "measured", "closed_holes"
"""Names of the materials of measured triangles and of triangles in closed holes."""


def split_by_material(triangles: Int64, filled: Bool) -> dict[str, Int64]:
    """Return the triangles of each material by its name, without materials that nothing uses.

    Args:
        triangles: (m, 3) vertex indices.
        filled: (m,) mask of the triangles in closed holes.
    """
    parts = {MEASURED: triangles[~filled], CLOSED_HOLES: triangles[filled]}
    return {name: part for name, part in parts.items() if len(part)}


def write_obj(path: Path, mesh: TexturedMesh) -> bytes:
    """Write an OBJ file, with materials (``.mtl``) and texture (``.jpg``) in the same folder.

    Triangles in closed holes have a material of their own, with the same texture.

    Args:
        path: OBJ file to write.
        mesh: Mesh with texture.

    Returns:
        Bytes of the JPEG file.
    """
    material, image = path.with_suffix(".mtl"), path.with_suffix(".jpg")
    jpeg = encode_jpeg(np.asarray(cv2.cvtColor(mesh.texture, cv2.COLOR_RGB2BGR), np.uint8))
    image.write_bytes(jpeg)
    parts = split_by_material(mesh.triangles, mesh.filled)
    described = f"Kd 1 1 1\nillum 0\nmap_Kd {image.name}\n"
    material.write_text("".join(f"newmtl {name}\n{described}" for name in parts), "utf-8")
    with path.open("w", encoding="utf-8") as file:
        file.write(f"mtllib {material.name}\n")
        np.savetxt(file, mesh.vertices, "v %.9g %.9g %.9g")
        # Texture coordinates of OBJ files start at the lower left corner.
        np.savetxt(file, mesh.uv * (1, -1) + (0, 1), "vt %.7g %.7g")
        for name, triangles in parts.items():
            file.write(f"usemtl {name}\n")
            np.savetxt(file, np.repeat(triangles + 1, 2, axis=1), "f %d/%d %d/%d %d/%d")
    return jpeg


def read_obj(path: Path) -> TexturedMesh:
    """Read a triangle mesh with one texture from an OBJ file.

    Faces with more than three corners are divided into triangles. Normals are ignored.

    Args:
        path: OBJ file, whose material file names the texture by ``map_Kd``.

    Raises:
        InputError: The file cannot be read, has no texture coordinates or faces, or its texture
            cannot be read.
    """
    try:
        text = path.read_text(encoding="utf-8", errors="replace")
    except OSError as error:
        raise InputError(f"{path}: {error.strerror}") from error
    rows: dict[str, list[list[str]]] = {"v": [], "vt": [], "f": []}
    library, filled, in_hole = "", [], False
    for line in text.splitlines():
        key, *words = line.split() or [""]
        if key in rows:
            rows[key].append(words)
        elif key == "mtllib":
            library = " ".join(words)
        elif key == "usemtl":
            in_hole = words == [CLOSED_HOLES]
        filled += [in_hole] * (len(words) - 2) if key == "f" else []
    try:
        vertices = np.array([row[:3] for row in rows["v"]], np.float64).reshape(-1, 3)
        uv = np.array([row[:2] for row in rows["vt"]], np.float64).reshape(-1, 2)
        corners = _read_corners(rows["f"], len(vertices), len(uv))
    except (ValueError, IndexError) as error:
        raise InputError(f"{path}: not an OBJ file with texture coordinates: {error}") from error
    if not len(corners):
        raise InputError(f"{path}: the file has no faces")
    pairs = corners.reshape(-1, 2)
    first, numbers = unique_rows(pairs)
    vertex, coordinate = pairs[first].T
    flipped = (uv[coordinate] * (1, -1) + (0, 1)).astype(np.float32)
    image = _find_texture(path, library)
    texture = cv2.imread(str(image), cv2.IMREAD_COLOR_RGB)
    if texture is None:
        raise InputError(f"{image}: the texture cannot be read")
    triangles, rgb = numbers.reshape(-1, 3), np.asarray(texture, np.uint8)
    return TexturedMesh(vertices[vertex], triangles, flipped, rgb, np.array(filled, np.bool_))


def _read_corners(faces: list[list[str]], num_vertices: int, num_uv: int) -> Int64:
    """Return the vertex and texture coordinate (m, 3, 2) of the corners of each triangle."""
    triangles = []
    for face in faces:
        corners = [word.split("/")[:2] for word in face]
        triangles += [(corners[0], corners[k], corners[k + 1]) for k in range(1, len(corners) - 1)]
    indices = np.array(triangles, np.int64).reshape(-1, 3, 2)
    counts = np.array([num_vertices, num_uv])
    # Indices start at 1; negative indices count from the end.
    indices = np.where(indices > 0, indices - 1, indices + counts)
    if ((indices < 0) | (indices >= counts)).any():
        raise IndexError("a face has an index without vertex or texture coordinate")
    return indices


def _find_texture(path: Path, library: str) -> Path:
    """Return the path of the texture that the material file of an OBJ file names."""
    material = path.parent / library
    try:
        lines = material.read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError as error:
        raise InputError(f"{material}: {error.strerror} (the material file of {path})") from error
    names = [line.split(maxsplit=1)[1] for line in lines if line.strip().startswith("map_Kd ")]
    if not names:
        raise InputError(f"{material}: the material file names no texture (map_Kd)")
    return path.parent / names[0].strip()
