"""A binary glTF 2.0 scene: the points, and a camera with its outline for each photo.

glTF has y up and metres; its cameras look along -z with y up, and have no principal point.
"""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mpsfm_core.data import Float64
from mpsfm_core.results.exports.source import Source

ENTRIES = ("scene.glb",)
_Y_UP_FROM_Z = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
_FLIP = np.diag([1.0, -1.0, -1.0])
"""Between our axes of cameras and glTF's; of the world too, if it is as COLMAP leaves it."""
_OUTLINE = 0.05
"""Length of the outline of a camera, as a share of the spread of points and cameras."""
_FLOAT, _BYTE = 5126, 5121
_POINTS, _LINES = 0, 1
_EDGES = ((0, 1), (0, 2), (0, 3), (0, 4), (1, 2), (2, 3), (3, 4), (4, 1))


def write(source: Source, folder: Path) -> None:
    """Write ``scene.glb``."""
    scene, y_up = _Scene(), _Y_UP_FROM_Z if source.z_is_up else _FLIP
    points, colors = source.dense_points()
    if len(points):
        mesh = scene.mesh("points", _POINTS, points @ y_up.T, np.asarray(colors))
        scene.add({"name": "points", "mesh": mesh})
    spread = _spread(np.vstack([points, [i.projection_center() for i in source.registered()]]))
    for image in source.registered():
        camera = source.model.cameras[image.camera_id]
        matrix = camera.calibration_matrix()
        half = np.array([camera.width / matrix[0, 0], camera.height / matrix[1, 1]]) / 2
        pose = image.cam_from_world().inverse()
        node = np.eye(4)
        node[:3, :3] = y_up @ pose.rotation.matrix() @ _FLIP
        node[:3, 3] = y_up @ pose.translation
        name = str(image.name)
        outline = scene.mesh(f"{name} outline", _LINES, _outline(half) * spread * _OUTLINE, None)
        child = scene.add({"name": f"{name} outline", "mesh": outline}, root=False)
        camera_id = scene.camera(name, half)
        place = {"matrix": node.T.ravel().tolist(), "camera": camera_id, "children": [child]}
        scene.add({"name": name, **place})
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "scene.glb").write_bytes(scene.encode())


def _spread(points: Float64) -> float:
    """Median distance from the middle, at least a little."""
    distance = np.linalg.norm(points - np.median(points, axis=0), axis=1)
    return max(float(np.median(distance)), 1e-6)


def _outline(half: Float64) -> Float64:
    """Edges of a pyramid (16, 3), two ends each, from the camera's centre to z = -1."""
    corners = np.array([[0, 0, 0], [-1, -1, -1], [1, -1, -1], [1, 1, -1], [-1, 1, -1]], np.float64)
    corners[:, :2] *= half
    edges: Float64 = corners[np.array(_EDGES).ravel()]
    return edges


class _Scene:
    """Collects nodes and their numbers."""

    def __init__(self) -> None:
        self._data = bytearray()
        self._json: dict[str, Any] = {
            "asset": {"version": "2.0", "generator": "mpsfm"},
            "scene": 0,
            "scenes": [{"nodes": []}],
            **{name: [] for name in ("nodes", "meshes", "cameras", "accessors", "bufferViews")},
        }

    def add(self, node: dict[str, Any], root: bool = True) -> int:
        """A node, of the scene itself or of another node; its number."""
        number = len(self._json["nodes"])
        self._json["nodes"].append(node)
        if root:
            self._json["scenes"][0]["nodes"].append(number)
        return number

    def mesh(self, name: str, mode: int, points: Float64, colors: NDArray[np.uint8] | None) -> int:
        """Points (n, 3), or the ends of lines, maybe with RGB colours (n, 3); its number."""
        positions = points.astype("<f4")
        bounds = {"min": positions.min(axis=0).tolist(), "max": positions.max(axis=0).tolist()}
        attributes = {"POSITION": self._accessor(positions, "VEC3", _FLOAT, bounds)}
        if colors is not None:
            opaque = np.concatenate([colors, np.full((len(colors), 1), 255, np.uint8)], axis=1)
            described = {"normalized": True}
            attributes["COLOR_0"] = self._accessor(opaque, "VEC4", _BYTE, described)
        primitive = {"mode": mode, "attributes": attributes}
        self._json["meshes"].append({"name": name, "primitives": [primitive]})
        return len(self._json["meshes"]) - 1

    def camera(self, name: str, half: Float64) -> int:
        """A camera that sees so far to the sides and up at z = -1; its number."""
        described = {
            "aspectRatio": float(half[0] / half[1]),
            "yfov": float(2 * np.arctan(half[1])),
            "znear": 0.01,
        }
        camera = {"name": name, "type": "perspective", "perspective": described}
        self._json["cameras"].append(camera)
        return len(self._json["cameras"]) - 1

    def encode(self) -> bytes:
        """The file."""
        self._json["buffers"] = [{"byteLength": len(self._data)}]
        parts = {name: value for name, value in self._json.items() if value != []}
        text = json.dumps(parts, separators=(",", ":")).encode("utf-8")
        text += b" " * (-len(text) % 4)
        chunks = struct.pack("<I4s", len(text), b"JSON") + text
        chunks += struct.pack("<I4s", len(self._data), b"BIN\0") + bytes(self._data)
        return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks

    def _accessor(
        self, values: NDArray[Any], kind: str, component: int, further: dict[str, Any]
    ) -> int:
        view = {"buffer": 0, "byteOffset": len(self._data), "byteLength": values.nbytes}
        self._data += values.tobytes() + bytes(-values.nbytes % 4)
        self._json["bufferViews"].append(view)
        number = len(self._json["bufferViews"]) - 1
        described = {"componentType": component, "count": len(values), "type": kind}
        self._json["accessors"].append({"bufferView": number, **described, **further})
        return len(self._json["accessors"]) - 1
