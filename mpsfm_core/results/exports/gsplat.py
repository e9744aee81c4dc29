"""Export for Gaussian splatting with gsplat, Inria's code and splatfacto.

::

    images/NAME          undistorted images
    sparse/0/            their COLMAP model: pinhole cameras, colored points
    sparse/0/points3D.ply  dense points with normals, for Inria's code
    gaussians.ply        one Gaussian for each dense point: center, color and size
    maps/NAME.npz        refined depth and normals with their std

The dense points are in the COLMAP model too, without tracks, because gsplat and OpenSplat start
from all points of the model.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pycolmap
from scipy.spatial import cKDTree

from mpsfm_core.data import Float32, Float64, UInt8
from mpsfm_core.results.colmap_model import write_model
from mpsfm_core.results.exports.source import ExportSource
from mpsfm_core.results.ply import write_ply
from mpsfm_core.support.npz import write_npz

ENTRIES = ("images", "sparse", "gaussians.ply", "maps")
_NEIGHBOURS = 3
"""Number of nearest neighbors whose RMS distance sets the Gaussian scale (Kerbl et al. 2023)."""
_OPACITY = 0.1
"""Initial opacity of a Gaussian (Kerbl et al. 2023)."""
_MAX_GAUSSIANS = 500_000
"""Maximum number of Gaussians; if a model has more 3D points, a random subset is exported."""
_SH_0 = 0.28209479177387814
"""Constant spherical harmonic of degree 0, ``1 / (2 sqrt(pi))``."""


def write(source: ExportSource, folder: Path) -> None:
    """Write a Gaussian splatting folder; raise ``InputError`` if image files are missing."""
    source.write_photos(folder / "images")
    write_maps(source, folder / "maps")
    points, colors, normals = initial_points(source)
    model = source.undistorted()
    if source.has_dense_points:
        for point, color in zip(points, colors, strict=True):
            model.add_point3D(point, pycolmap.Track(), color)
    write_model(folder / "sparse" / "0", model)
    if source.has_dense_points:
        write_ply(folder / "sparse" / "0" / "points3D.ply", points, colors, normals)
    if len(points) > _NEIGHBOURS:
        write_gaussians(folder / "gaussians.ply", points, colors)


def initial_points(source: ExportSource) -> tuple[Float64, UInt8, Float32]:
    """Return positions, colors and normals of the points from which splatting starts.

    The points are a random subset of the fused depth maps, or of the 3D points without depth maps.
    Unknown normals are zero.
    """
    points, colors = source.dense_points()
    normals = source.dense_normals()
    if len(points) <= _MAX_GAUSSIANS:
        return points, colors, normals
    chosen = np.random.default_rng(0).choice(len(points), _MAX_GAUSSIANS, replace=False)
    return points[chosen], colors[chosen], normals[chosen]


def write_maps(source: ExportSource, folder: Path) -> None:
    """Write ``folder/NAME.npz`` for each image that has refined depth.

    ``depth`` and ``depth_std`` (h, w) float32 are the z-depth and its standard deviation in world
    units. ``normals`` (h, w, 3) float32 are unit normals in the camera frame (x right, y down, z
    forward). ``normals_std`` (h, w) float32 is the standard deviation of normals in radians along
    each tangent. ``depth_valid`` and ``normals_valid`` (h, w) bool are masks. ``camera`` (4,)
    float64 is fx, fy, cx, cy of the depth grid over the undistorted image.
    """
    for name in source.names:
        maps = source.maps(name)
        if maps is None:
            continue
        assert maps.depth.variance is not None and maps.normals.variance is not None
        write_npz(
            folder / f"{name}.npz",
            depth=maps.depth.depth,
            depth_std=np.sqrt(maps.depth.variance),
            depth_valid=maps.depth.valid,
            normals=maps.normals.normals,
            normals_std=np.sqrt(maps.normals.variance),
            normals_valid=maps.normals.valid,
            camera=maps.camera.params,
        )


def write_gaussians(path: Path, points: Float64, colors: UInt8) -> None:
    """Write isotropic Gaussians in the PLY layout of 3D Gaussian splatting. (2023).

    Args:
        path: PLY file to write.
        points: (n, 3) centers of the Gaussians, more than three.
        colors: (n, 3) uint8 RGB colors of the Gaussians.
    """
    distance = cKDTree(points).query(points, k=_NEIGHBOURS + 1)[0][:, 1:]
    size = np.sqrt((distance**2).mean(axis=1))
    size = np.maximum(size, np.median(size) * 1e-3 + 1e-12)
    names = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", "opacity"]
    names += ["scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    rows = np.zeros((len(points), len(names)), dtype="<f4")
    rows[:, 0:3] = points
    rows[:, 6:9] = (colors / 255.0 - 0.5) / _SH_0
    rows[:, 9] = np.log(_OPACITY / (1 - _OPACITY))
    rows[:, 10:13] = np.log(size)[:, None]
    rows[:, 13] = 1.0
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(points)}"]
    header += [*(f"property float {name}" for name in names), "end_header", ""]
    path.write_bytes("\n".join(header).encode("ascii") + rows.tobytes())
