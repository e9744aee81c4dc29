"""Write the files of a surface mesh."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from mpsfm_core.data import Float64, UInt8
from mpsfm_core.data.result_layout import MESH
from mpsfm_core.dense.mesh import TriangleMesh
from mpsfm_core.dense.texture import TexturedMesh
from mpsfm_core.results.exports.source import ExportSource
from mpsfm_core.results.gltf import FLIP, TRIANGLES, Y_UP_FROM_Z, GltfScene, Texture
from mpsfm_core.results.ply import write_ply

_JPEG_QUALITY = 92


def write_mesh(
    folder: Path, mesh: TriangleMesh, textured: TexturedMesh | None, source: ExportSource
) -> None:
    """Write the files :data:`~mpsfm_core.data.result_layout.MESH` of a mesh.

    The PLY and OBJ files are in the world frame of the COLMAP model, and the GLB file has y up.

    Args:
        folder: Folder of the written files.
        mesh: Mesh with vertex colors, for the PLY file.
        textured: The same mesh with a texture for the GLB and OBJ files, or None: the GLB file gets
            vertex colors, and no OBJ file is written.
        source: Model of the mesh.
    """
    ply, glb, obj, material, image = (folder / name for name in MESH)
    write_ply(ply, mesh.vertices, mesh.colors, triangles=mesh.triangles)
    scene = GltfScene()
    if textured is None:
        points = _with_y_up(mesh.vertices, source)
        number = scene.mesh("surface", TRIANGLES, points, mesh.colors, mesh.triangles)
    else:
        points = _with_y_up(textured.vertices, source)
        jpeg = _encode_jpeg(textured.texture)
        texture = Texture(textured.uv, jpeg)
        number = scene.mesh("surface", TRIANGLES, points, None, textured.triangles, texture)
        image.write_bytes(jpeg)
        material.write_text(f"newmtl photos\nKd 1 1 1\nillum 0\nmap_Kd {image.name}\n", "utf-8")
        _write_obj(obj, textured, material.name)
    scene.add({"name": "surface", "mesh": number})
    glb.write_bytes(scene.encode())


def _with_y_up(vertices: Float64, source: ExportSource) -> Float64:
    turned = source if source.is_georeferenced else source.turned()
    axes = Y_UP_FROM_Z if turned.z_is_up else FLIP
    points: Float64 = (turned.world_from_model * vertices) @ axes.T
    return points


def _encode_jpeg(texture: UInt8) -> bytes:
    bgr = cv2.cvtColor(texture, cv2.COLOR_RGB2BGR)
    return cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])[1].tobytes()


def _write_obj(path: Path, mesh: TexturedMesh, material: str) -> None:
    """Write a Wavefront OBJ file, whose texture coordinates start at the lower left corner."""
    with path.open("w", encoding="utf-8") as file:
        file.write(f"mtllib {material}\nusemtl photos\n")
        np.savetxt(file, mesh.vertices, "v %.9g %.9g %.9g")
        np.savetxt(file, mesh.uv * (1, -1) + (0, 1), "vt %.7g %.7g")
        np.savetxt(file, np.repeat(mesh.triangles + 1, 2, axis=1), "f %d/%d %d/%d %d/%d")
