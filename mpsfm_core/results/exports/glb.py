"""Export 3D points, cameras and camera frustums to binary glTF 2.0.

In glTF, y is up, units are meters, and cameras look along -z with y up and have no principal point.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from mpsfm_core.data import Float64
from mpsfm_core.results.exports.source import ExportSource
from mpsfm_core.results.gltf import FLIP, LINES, POINTS, Y_UP_FROM_Z, GltfScene

ENTRIES = ("scene.glb",)
_OUTLINE = 0.05
"""Length of a camera frustum divided by the spread of 3D points and camera centers."""
_EDGES = ((0, 1), (0, 2), (0, 3), (0, 4), (1, 2), (2, 3), (3, 4), (4, 1))


def write(source: ExportSource, folder: Path) -> None:
    """Write ``scene.glb``."""
    scene, y_up = GltfScene(), Y_UP_FROM_Z if source.z_is_up else FLIP
    points, colors = source.dense_points()
    if len(points):
        mesh = scene.mesh("points", POINTS, points @ y_up.T, np.asarray(colors))
        scene.add({"name": "points", "mesh": mesh})
    spread = _spread(np.vstack([points, [i.projection_center() for i in source.registered()]]))
    for image in source.registered():
        camera = source.model.cameras[image.camera_id]
        matrix = camera.calibration_matrix()
        half = np.array([camera.width / matrix[0, 0], camera.height / matrix[1, 1]]) / 2
        pose = image.cam_from_world().inverse()
        node = np.eye(4)
        node[:3, :3] = y_up @ pose.rotation.matrix() @ FLIP
        node[:3, 3] = y_up @ pose.translation
        name = str(image.name)
        outline = scene.mesh(f"{name} outline", LINES, _outline(half) * spread * _OUTLINE, None)
        child = scene.add({"name": f"{name} outline", "mesh": outline}, root=False)
        camera_id = scene.camera(name, half)
        place = {"matrix": node.T.ravel().tolist(), "camera": camera_id, "children": [child]}
        scene.add({"name": name, **place})
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "scene.glb").write_bytes(scene.encode())


def _spread(points: Float64) -> float:
    """Return the median distance of points from the median point, at least 1e-6."""
    distance = np.linalg.norm(points - np.median(points, axis=0), axis=1)
    return max(float(np.median(distance)), 1e-6)


def _outline(half: Float64) -> Float64:
    """Return the end points (16, 3) of the 8 edges of a camera frustum that ends at z = -1."""
    corners = np.array([[0, 0, 0], [-1, -1, -1], [1, -1, -1], [1, 1, -1], [-1, 1, -1]], np.float64)
    corners[:, :2] *= half
    edges: Float64 = corners[np.array(_EDGES).ravel()]
    return edges
