"""Write binary glTF 2.0 files (y up, units in meters)."""

from __future__ import annotations

import json
import struct
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mpsfm_core.data import Float32, Float64, Int64, UInt8

POINTS, LINES, TRIANGLES = 0, 1, 4
"""Topology codes (``mode``) of glTF primitives."""
Y_UP_FROM_Z = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
FLIP = np.diag([1.0, -1.0, -1.0])
"""Matrix between OpenCV axes (y down, z forward) and glTF axes (y up, z backward)."""
_FLOAT, _BYTE, _UINT = 5126, 5121, 5125
_LISTS = ("nodes", "meshes", "cameras", "accessors", "bufferViews")
_MATERIALS = ("materials", "textures", "images")


class Texture(NamedTuple):
    """Texture of a mesh."""

    uv: Float32
    """(n, 2) texture coordinates of the vertices in [0, 1], from the upper left corner."""
    jpeg: bytes
    """Texture image as JPEG file."""


class GltfScene:
    """Builder of a glTF scene, whose nodes, meshes and cameras are identified by number."""

    def __init__(self) -> None:
        self._data = bytearray()
        self._json: dict[str, Any] = {
            "asset": {"version": "2.0", "generator": "mpsfm"},
            "scene": 0,
            "scenes": [{"nodes": []}],
            **{name: [] for name in (*_LISTS, *_MATERIALS, "extensionsUsed")},
        }

    def add(self, node: dict[str, Any], root: bool = True) -> int:
        """Add a node, as a root of the scene unless ``root`` is False; return the node number."""
        number = len(self._json["nodes"])
        self._json["nodes"].append(node)
        if root:
            self._json["scenes"][0]["nodes"].append(number)
        return number

    def mesh(
        self,
        name: str,
        mode: int,
        points: Float64,
        colors: UInt8 | None,
        triangles: Mapping[str, Int64] | None = None,
        texture: Texture | None = None,
    ) -> int:
        """Add a mesh to the scene; return the mesh number.

        Args:
            name: name of the mesh.
            mode: primitive type :data:`POINTS`, :data:`LINES` or :data:`TRIANGLES`.
            points: (n, 3) vertices; a line has two vertices.
            colors: (n, 3) RGB colors of the vertices, or None.
            triangles: (m, 3) vertex indices of the triangles of each material, by its name.
            texture: texture of the triangles, or None.
        """
        positions = points.astype("<f4")
        bounds = {"min": positions.min(axis=0).tolist(), "max": positions.max(axis=0).tolist()}
        attributes = {"POSITION": self._accessor(positions, "VEC3", _FLOAT, bounds)}
        if colors is not None:
            opaque = np.concatenate([colors, np.full((len(colors), 1), 255, np.uint8)], axis=1)
            described = {"normalized": True}
            attributes["COLOR_0"] = self._accessor(opaque, "VEC4", _BYTE, described)
        if texture is not None:
            uv = texture.uv.astype("<f4")
            attributes["TEXCOORD_0"] = self._accessor(uv, "VEC2", _FLOAT, {})
        primitive: dict[str, Any] = {"mode": mode, "attributes": attributes}
        primitives = [primitive]
        if triangles is not None:
            number = None if texture is None else self._texture(texture)
            primitives = [
                {
                    **primitive,
                    "indices": self._accessor(part.astype("<u4").ravel(), "SCALAR", _UINT, {}),
                    "material": self._unlit_material(material, number),
                }
                for material, part in triangles.items()
            ]
        self._json["meshes"].append({"name": name, "primitives": primitives})
        return len(self._json["meshes"]) - 1

    def _texture(self, texture: Texture) -> int:
        """Add a texture; return the texture number."""
        view = self._buffer_view(texture.jpeg)
        self._json["images"].append({"bufferView": view, "mimeType": "image/jpeg"})
        self._json["textures"].append({"source": len(self._json["images"]) - 1})
        return len(self._json["textures"]) - 1

    def _unlit_material(self, name: str, texture: int | None) -> int:
        """Add an unlit, double-sided material; return the material number."""
        unlit = "KHR_materials_unlit"
        self._json["extensionsUsed"] = [unlit]
        material: dict[str, Any] = {"name": name, "doubleSided": True, "extensions": {unlit: {}}}
        if texture is not None:
            color = {"index": texture}
            material["pbrMetallicRoughness"] = {"baseColorTexture": color, "metallicFactor": 0}
        self._json["materials"].append(material)
        return len(self._json["materials"]) - 1

    def camera(self, name: str, half: Float64) -> int:
        """Add a camera with half image size ``half`` at z = -1; return the camera number."""
        described = {
            "aspectRatio": float(half[0] / half[1]),
            "yfov": float(2 * np.arctan(half[1])),
            "znear": 0.01,
        }
        camera = {"name": name, "type": "perspective", "perspective": described}
        self._json["cameras"].append(camera)
        return len(self._json["cameras"]) - 1

    def encode(self) -> bytes:
        """Return the bytes of the binary glTF file."""
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
        number = self._buffer_view(values.tobytes())
        described = {"componentType": component, "count": len(values), "type": kind}
        self._json["accessors"].append({"bufferView": number, **described, **further})
        return len(self._json["accessors"]) - 1

    def _buffer_view(self, data: bytes) -> int:
        """Append data to the buffer; return the number of the buffer view."""
        view = {"buffer": 0, "byteOffset": len(self._data), "byteLength": len(data)}
        self._data += data + bytes(-len(data) % 4)
        self._json["bufferViews"].append(view)
        return len(self._json["bufferViews"]) - 1
