"""Export a ``transforms.json`` with images, depth and points for nerfstudio and OpenSplat.

::

    transforms.json      pinhole cameras, poses, and paths of the other files
    images/NAME          undistorted images
    depths/NAME.npy      refined depth, (h, w) float32, thousandths of a unit, 0 where unknown
    maps/NAME.npz        depth and normals with std, as for gsplat
    sparse_pc.ply        colored points of the fused depth maps with normals, to start splatting
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from mpsfm_core.results.exports.gsplat import initial_points, write_maps
from mpsfm_core.results.exports.source import ExportSource
from mpsfm_core.results.original_images import exported_image_name
from mpsfm_core.results.ply import write_ply
from mpsfm_core.results.transforms_json import write_transforms

ENTRIES = ("transforms.json", "images", "depths", "maps", "sparse_pc.ply")
_STORED_UNITS = 1000
"""Integer depth value that stands for one world unit, the inverse of nerfstudio's default
``depth_unit_scale_factor``."""


def write(source: ExportSource, folder: Path) -> None:
    """Write a nerfstudio folder; raise ``InputError`` if the image files are missing."""
    source.write_photos(folder / "images")
    write_maps(source, folder / "maps")
    write_ply(folder / "sparse_pc.ply", *initial_points(source))
    depths = _write_depths(source, folder)
    names = [exported_image_name(name) for name in source.names]
    path = folder / "transforms.json"
    write_transforms(path, source.undistorted(), {name: f"images/{name}" for name in names})
    transforms: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    for frame in transforms["frames"]:
        if depths:  # nerfstudio requires depth for all frames or none
            frame["depth_file_path"] = depths[frame["file_path"]]
    transforms |= {"camera_model": "OPENCV", "ply_file_path": "sparse_pc.ply"}
    if source.z_is_up:
        transforms["orientation_override"] = "none"
    path.write_text(json.dumps(transforms, indent=2), encoding="utf-8")


def _write_depths(source: ExportSource, folder: Path) -> dict[str, str]:
    """Write depth images; return their paths by image path, empty unless all images have depth."""
    maps_of = {name: source.maps(name) for name in source.names}
    written = {}
    for name, maps in maps_of.items():
        if maps is None:
            return {}
        depth = np.where(maps.depth.valid, maps.depth.depth * _STORED_UNITS, 0)
        path = folder / "depths" / f"{name}.npy"
        path.parent.mkdir(parents=True, exist_ok=True)
        np.save(path, depth.astype(np.float32))
        written[f"images/{exported_image_name(name)}"] = f"depths/{name}.npy"
    return written
