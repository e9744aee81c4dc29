"""Write the files of a surface mesh."""

from __future__ import annotations

from pathlib import Path

from mpsfm_core.data.result_layout import MESH
from mpsfm_core.dense.mesh import TriangleMesh
from mpsfm_core.results.exports.source import ExportSource
from mpsfm_core.results.gltf import FLIP, TRIANGLES, Y_UP_FROM_Z, GltfScene
from mpsfm_core.results.ply import write_ply


def write_mesh(folder: Path, mesh: TriangleMesh, source: ExportSource) -> None:
    """Write ``mesh.ply`` in the world frame of the COLMAP model and ``mesh.glb`` with y up."""
    ply, glb = MESH
    write_ply(folder / ply, mesh.vertices, mesh.colors, triangles=mesh.triangles)
    turned = source if source.is_georeferenced else source.turned()
    upright = (turned.world_from_model * mesh.vertices) @ (
        Y_UP_FROM_Z if turned.z_is_up else FLIP
    ).T
    scene = GltfScene()
    number = scene.mesh("surface", TRIANGLES, upright, mesh.colors, mesh.triangles)
    scene.add({"name": "surface", "mesh": number})
    (folder / glb).write_bytes(scene.encode())
