"""Evaluation of clouds and meshes without a scan, by rendering held-out photos.

A held-out photo has a pose, but does not contribute to the dense geometry. The geometry is rendered
at the pose of the photo and compared with the photo, as for novel view synthesis.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mpsfm_core.data import Bool, DepthPrior, Float32, Pose, View
from mpsfm_core.data.errors import InputError, did_you_mean
from mpsfm_core.data.result_layout import DENSE, DEPTH, MESH_OBJ, MESH_PLY
from mpsfm_core.geometry import resize_map
from mpsfm_core.geometry.rendering import Geometry, Rendering, render, splat_radii
from mpsfm_core.inputs.models import reconstruction_poses
from mpsfm_core.results.depth_maps import read_depth_map
from mpsfm_core.results.exports.source import ExportSource
from mpsfm_core.results.obj import read_obj
from mpsfm_core.results.ply import read_mesh

_MAX_SIZE = 640
"""Maximum length of the longer side of rendered images in pixels, as of depth maps."""
_SSIM_STD_PX = 1.5
"""Standard deviation of the Gaussian window of SSIM in pixels [Wang et al. 2004]."""
_CLOSE_DEPTH = 0.05
"""Relative depth difference below which rendered depth and depth map agree."""


def evaluate_held_out(
    model: Path,
    photos: Path | None = None,
    names: Sequence[str] | None = None,
    geometry: Path | None = None,
) -> dict[str, Any]:
    """Render the dense geometry at the poses of photos, and compare with the photos.

    Args:
        model: Result folder or COLMAP model.
        photos: Folder of the photos; default: the folder that the run recorded.
        names: Names of the photos to render; default: the held-out images of the run
            (``dense.hold_out_every``), else all images.
        geometry: PLY file of a cloud or mesh, or OBJ file of a textured mesh, in the frame of the
            model; default: ``dense.ply``, ``mesh.ply`` and ``mesh.obj`` of the result folder.

    Returns:
        Plain data for JSON. ``independent`` is True if no rendered photo contributed to the
        geometry, False if one did, and None if unknown. ``geometries`` maps each PLY file to the
        means over images of ``covered`` (ratio of pixels), ``psnr`` in dB and ``ssim`` (over
        covered pixels, after a linear color correction per channel), ``depth_error`` (median
        relative difference from the depth map of the photo) and ``depth_close`` (ratio of pixels
        within 5 %), and to the same values per image.

    Raises:
        InputError: Model or geometry cannot be read, a name is unknown, the model has no geometry,
            or scikit-image is not installed.
    """
    source = ExportSource.read(model, photos)
    recorded = source.held_out
    names = _select_names(source, recorded, names)
    files = [geometry] if geometry else [model / name for name in (DENSE, MESH_PLY, MESH_OBJ)]
    files = [path for path in files if path == geometry or path.is_file()]
    if not files:
        raise InputError(
            f"{model}: no dense.ply or mesh.ply; name a PLY or OBJ file with --geometry"
        )
    independent = set(names) <= set(recorded) if recorded and geometry is None else None
    poses = reconstruction_poses(source.model)
    rows = {name: row for row, name in enumerate(source.names)}
    views = {name: reduce_view(source.images.view(rows[name])) for name in names}
    depths = {name: _read_depth(source.folder, name) for name in names}
    return {
        "images": list(names),
        "independent": independent,
        "geometries": {
            path.name: evaluate_geometry(read_geometry(path), views, poses, depths)
            for path in files
        },
    }


def read_geometry(path: Path) -> Geometry:
    """Read a colored point cloud or mesh (PLY), or a textured mesh (OBJ).

    Raises:
        InputError: The file is not a PLY or OBJ file, is damaged or has no points.
    """
    if path.suffix.lower() == ".obj":
        mesh = read_obj(path)
        gray = np.full((len(mesh.vertices), 3), 128, np.uint8)
        geometry = Geometry(mesh.vertices, gray, mesh.triangles, mesh.uv, mesh.texture)
    else:
        geometry = Geometry(*read_mesh(path))
    if not len(geometry.points):
        raise InputError(f"{path}: the file has no points to render")
    return geometry


def compare_rendering(
    rendering: Rendering, view: View, depth: DepthPrior | None = None
) -> dict[str, float | None]:
    """Compare a rendering with the photo.

    Exposure and white balance differ between photos, so each channel of the rendering is fitted to
    the photo with a linear function first.

    Args:
        rendering: Rendering in the size of ``view``.
        view: Undistorted photo.
        depth: Depth map of the photo in world units, on a grid of any size over the whole view.

    Returns:
        The metrics of :func:`evaluate_held_out`; None where nothing can be compared.
    """
    usable = np.ones(rendering.depth.shape, np.bool_) if view.mask is None else view.mask
    covered = rendering.covered & usable
    metrics: dict[str, float | None] = {
        "covered": float(covered.sum() / max(1, usable.sum())),
        **dict.fromkeys(("psnr", "ssim", "depth_error", "depth_close")),
    }
    if covered.sum() < 2:
        return metrics
    photo: Float32 = view.image.astype(np.float32) / np.float32(255)
    corrected = _correct_colors(rendering.colors / np.float32(255), photo, covered)
    error = float(np.mean((corrected - photo)[covered].astype(np.float64) ** 2))
    metrics["psnr"] = -10 * float(np.log10(max(error, 1e-10)))
    metrics["ssim"] = _ssim(corrected, photo, covered)
    if depth is not None:
        height, width = depth.shape
        rendered = resize_map(rendering.depth, width, height, linear=False)
        both = depth.valid & np.isfinite(rendered)
        if both.any():
            relative = np.abs(rendered[both] / depth.depth[both] - 1)
            metrics["depth_error"] = float(np.median(relative))
            metrics["depth_close"] = float((relative < _CLOSE_DEPTH).mean())
    return metrics


def _select_names(
    source: ExportSource, recorded: Sequence[str], names: Sequence[str] | None
) -> list[str]:
    known = source.names
    for name in names or ():
        if name not in known:
            raise InputError(
                f"{source.folder}: no pose for photo {name!r}{did_you_mean(name, known)}"
            )
    return list(names or [name for name in recorded if name in known] or known)


def reduce_view(view: View) -> View:
    """Reduce a view to at most :data:`_MAX_SIZE` pixels."""
    width, height = view.camera.size
    factor = min(1.0, _MAX_SIZE / max(width, height))
    size = max(1, round(width * factor)), max(1, round(height * factor))
    mask = None if view.mask is None else resize_map(view.mask, *size, linear=False) > 0
    image = np.round(resize_map(view.image, *size)).astype(np.uint8)
    return View(view.name, image, view.camera.resized(*size), mask)


def _read_depth(folder: Path, name: str) -> DepthPrior | None:
    path = folder / DEPTH / f"{name}.npz"
    return read_depth_map(path)[1] if path.is_file() else None


def evaluate_geometry(
    geometry: Geometry,
    views: Mapping[str, View],
    poses: Mapping[str, Pose],
    depths: Mapping[str, DepthPrior | None],
) -> dict[str, Any]:
    """Render a geometry at the poses of photos, and compare with the photos.

    Args:
        geometry: Cloud or mesh, world frame.
        views: Undistorted photos in the size of the renderings, by image name.
        poses: ``cam_from_world`` by image name.
        depths: Depth maps in world units by image name, None without depth map.

    Returns:
        The means over images and the values ``per_image`` of :func:`evaluate_held_out`.
    """
    radii = None if len(geometry.triangles) else splat_radii(geometry.points)
    per_image = {
        name: compare_rendering(
            render(geometry, view.camera, poses[name], radii), view, depths[name]
        )
        for name, view in views.items()
    }
    means: dict[str, float | None] = {}
    for metric in next(iter(per_image.values())):
        values = [v for image in per_image.values() if (v := image[metric]) is not None]
        means[metric] = float(np.mean(values)) if values else None
    return {**means, "per_image": per_image}


def _correct_colors(rendered: Float32, photo: Float32, covered: Bool) -> Float32:
    """Fit gain and offset of each channel by least squares over the covered pixels, and apply."""
    corrected = np.zeros_like(photo)
    for channel in range(3):
        x, y = rendered[covered, channel], photo[covered, channel]
        gain, offset = np.polyfit(x, y, 1) if np.ptp(x) > 0 else (0.0, float(y.mean()))
        corrected[..., channel] = np.clip(gain * rendered[..., channel] + offset, 0, 1)
    return corrected


def _ssim(rendered: Float32, photo: Float32, covered: Bool) -> float | None:
    """Compute the mean SSIM [Wang et al. 2004] over covered pixels, None for tiny images."""
    try:
        from skimage.metrics import structural_similarity
    except ImportError as error:
        raise InputError(
            f"cannot compute SSIM: scikit-image is missing ({error}); run pip install "
            "'mpsfm-core[mesh]'"
        ) from error
    filled = np.where(covered[..., None], rendered, photo)
    window = 2 * round(3.5 * _SSIM_STD_PX) + 1
    if min(covered.shape) < window:
        return None
    _, similarity = structural_similarity(
        filled,
        photo,
        channel_axis=2,
        data_range=1.0,
        gaussian_weights=True,
        sigma=_SSIM_STD_PX,
        use_sample_covariance=False,
        full=True,
    )
    return float(similarity[covered].mean())
