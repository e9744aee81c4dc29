"""Binary PLY point clouds."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from mpsfm_core.data import Float64, UInt8


def write_ply(path: Path, points: Float64, colors: UInt8) -> None:
    """Write points (n, 3) with RGB colours (n, 3) as little-endian float32 and uint8."""
    vertices = np.empty(len(points), dtype=[("xyz", "<f4", 3), ("rgb", "u1", 3)])
    vertices["xyz"], vertices["rgb"] = points, colors
    header = [
        "ply",
        "format binary_little_endian 1.0",
        f"element vertex {len(points)}",
        *(f"property float {axis}" for axis in "xyz"),
        *(f"property uchar {color}" for color in ("red", "green", "blue")),
        "end_header",
    ]
    path.write_bytes("\n".join([*header, ""]).encode("ascii") + vertices.tobytes())
