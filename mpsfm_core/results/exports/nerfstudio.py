"""``transforms.json`` with what nerfstudio reads beside it.

::

    transforms.json      pinhole cameras, poses, and where the rest is
    images/NAME          undistorted photos
    depths/NAME.npy      refined depth, (h, w) float32, thousandths of a unit, 0 where unknown
    maps/NAME.npz        depth and normals with their std, as for gsplat
    sparse_pc.ply        points with colour
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from mpsfm_core.results.exports.gsplat import write_maps
from mpsfm_core.results.exports.source import ExportSource
from mpsfm_core.results.original_images import exported_image_name
from mpsfm_core.results.ply import write_ply
from mpsfm_core.results.transforms_json import write_transforms

ENTRIES = ("transforms.json", "images", "depths", "maps", "sparse_pc.ply")
_STORED_UNITS = 1000
"""nerfstudio multiplies depth by its depth_unit_scale_factor, 0.001 by default."""


def write(source: ExportSource, folder: Path) -> None:
    """Write the folder. Raises :class:`~mpsfm_core.data.errors.InputError` without the photos."""
    source.write_photos(folder / "images")
    write_maps(source, folder / "maps")
    write_ply(folder / "sparse_pc.ply", *source.points())
    depths = _write_depths(source, folder)
    names = [exported_image_name(name) for name in source.names]
    path = folder / "transforms.json"
    write_transforms(path, source.undistorted(), {name: f"images/{name}" for name in names})
    transforms: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    for frame in transforms["frames"]:
        if depths:  # all frames must have one, or none
            frame["depth_file_path"] = depths[frame["file_path"]]
    transforms |= {"camera_model": "OPENCV", "ply_file_path": "sparse_pc.ply"}
    if source.z_is_up:
        transforms["orientation_override"] = "none"
    path.write_text(json.dumps(transforms, indent=2), encoding="utf-8")


def _write_depths(source: ExportSource, folder: Path) -> dict[str, str]:
    """File of the photo -> file of its depth; empty unless all photos have depth."""
    found = {name: source.maps(name) for name in source.names}
    written = {}
    for name, maps in found.items():
        if maps is None:
            return {}
        depth = np.where(maps.depth.valid, maps.depth.depth * _STORED_UNITS, 0)
        path = folder / "depths" / f"{name}.npy"
        path.parent.mkdir(parents=True, exist_ok=True)
        np.save(path, depth.astype(np.float32))
        written[f"images/{exported_image_name(name)}"] = f"depths/{name}.npy"
    return written
