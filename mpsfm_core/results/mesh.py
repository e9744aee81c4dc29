"""Write the files of a surface mesh."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from mpsfm_core.data import Float64
from mpsfm_core.data.result_layout import MESH_GLB, MESH_OBJ, MESH_PLY
from mpsfm_core.dense.mesh import TriangleMesh
from mpsfm_core.dense.texture import TexturedMesh
from mpsfm_core.results.exports.source import ExportSource
from mpsfm_core.results.gltf import FLIP, TRIANGLES, Y_UP_FROM_Z, GltfScene, Texture
from mpsfm_core.results.obj import split_by_material, write_obj
from mpsfm_core.results.ply import write_ply


def write_mesh(
    folder: Path, mesh: TriangleMesh, textured: TexturedMesh | None, source: ExportSource
) -> None:
    """Write the files :data:`~mpsfm_core.data.result_layout.MESH` of a mesh.

    The vertices in closed holes have the property ``filled`` in the PLY file, and their triangles
    the material ``closed_holes`` in the other files. The PLY and OBJ files are in the world frame
    of the COLMAP model, and the GLB file has y up.

    Args:
        folder: Folder of the written files.
        mesh: Mesh with vertex colors, for the PLY file.
        textured: The same mesh with a texture for the GLB and OBJ files, or None: the GLB file gets
            vertex colors, and no OBJ file is written.
        source: Model of the mesh.
    """
    marks = {"filled": mesh.filled.astype(np.uint8)}
    write_ply(folder / MESH_PLY, mesh.vertices, mesh.colors, None, marks, mesh.triangles)
    scene = GltfScene()
    if textured is None:
        points = _with_y_up(mesh.vertices, source)
        parts = split_by_material(mesh.triangles, mesh.filled_triangles)
        number = scene.mesh("surface", TRIANGLES, points, mesh.colors, parts)
    else:
        points = _with_y_up(textured.vertices, source)
        parts = split_by_material(textured.triangles, textured.filled)
        jpeg = write_obj(folder / MESH_OBJ, textured)
        texture = Texture(textured.uv, jpeg)
        number = scene.mesh("surface", TRIANGLES, points, None, parts, texture)
    scene.add({"name": "surface", "mesh": number})
    (folder / MESH_GLB).write_bytes(scene.encode())


def _with_y_up(vertices: Float64, source: ExportSource) -> Float64:
    turned = source if source.is_georeferenced else source.turned()
    axes = Y_UP_FROM_Z if turned.z_is_up else FLIP
    points: Float64 = (turned.world_from_model * vertices) @ axes.T
    return points
