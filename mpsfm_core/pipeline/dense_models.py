"""Dense depth maps and meshes of existing models (``mpsfm dense`` and ``mpsfm mesh``)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pycolmap

from mpsfm_core.data import DepthPrior, Float64, Pose
from mpsfm_core.data.errors import InputError
from mpsfm_core.data.result_layout import DENSE, DEPTH, MESH, SPARSE
from mpsfm_core.dense.densify import DenseReport, densify
from mpsfm_core.dense.depth_range import depth_prior_from_points
from mpsfm_core.dense.fusion import fuse_depth_maps
from mpsfm_core.dense.mesh import TriangleMesh, mesh_depth_maps
from mpsfm_core.dense.options import DenseOptions, MeshOptions
from mpsfm_core.dense.texture import build_texture
from mpsfm_core.extraction.cache import cache_folder
from mpsfm_core.geometry import transform
from mpsfm_core.inputs.image_search import find_images
from mpsfm_core.inputs.images import ImageSet, load_images
from mpsfm_core.inputs.models import match_names, read_model, read_poses, reconstruction_poses
from mpsfm_core.mapping.scene.reconstruction import Reconstruction, RegisteredImage
from mpsfm_core.results.colmap_model import write_model
from mpsfm_core.results.depth_maps import read_depth_map, write_depth_maps
from mpsfm_core.results.exports.source import ExportSource
from mpsfm_core.results.mesh import write_mesh
from mpsfm_core.results.ply import write_cloud
from mpsfm_core.support.disk_arrays import current_store, store_fields, store_on_disk
from mpsfm_core.support.files import lock_output_folder, replace_entries
from mpsfm_core.support.threads import limit_threads

PathLike = str | Path


def densify_model(
    model: PathLike,
    images: PathLike,
    output: PathLike,
    options: DenseOptions | None = None,
) -> DenseReport:
    """Compute and write depth maps of a posed model by multi-view stereo.

    The depth search of an image starts from its map in ``model/depth`` of a result folder. For an
    image without depth map, the search starts from the depth range of the image's 3D points. Images
    without depth map and without 3D points are omitted.

    Args:
        model: COLMAP model, ``transforms.json`` or result folder.
        images: Folder of the original photos.
        output: Output folder for the depth maps, ``dense.ply`` and the model.
        options: Options of the dense stage.

    Returns:
        Report of the dense stage as plain data.

    Raises:
        InputError: model or photos cannot be read, image names do not match, the model has no
            points, or ``output`` cannot be written.
    """
    with lock_output_folder(Path(output)), limit_threads(None), store_on_disk(cache_folder()):
        return _densify_model(Path(model), Path(images), Path(output), options)


def _densify_model(
    model: Path, images: Path, output: Path, options: DenseOptions | None
) -> DenseReport:
    colmap, poses = read_model(model, images), read_poses(model, images)
    matched = match_names(find_images(images), poses)
    if len(matched) < 2:
        raise InputError(
            f"{images}: the folder contains {len(matched)} of the photos of model {model}; stereo "
            f"needs two photos"
        )
    photos = load_images(images, model=model, names=list(matched))
    points = {str(image.name): _point_depths(colmap, image) for image in colmap.images.values()}
    depths, poses_use_depth = [], True
    for photo in photos:
        found = matched[photo.name]
        file = model / DEPTH / f"{found}.npz"
        poses_use_depth &= file.is_file()
        depths.append(
            read_depth_map(file)[1] if file.is_file() else depth_prior_from_points(points[found])
        )
    posed = _reconstruction_of_maps(
        photos, [poses[matched[photo.name]] for photo in photos], depths
    )
    if not posed.images:
        raise InputError(
            f"{model}: the model has no points, from which the depth range is computed"
        )
    dense, report = densify(
        posed, photos.view_of, options or DenseOptions(), poses_use_depth=poses_use_depth
    )
    with replace_entries(output, (SPARSE, DENSE, DEPTH)) as folder:
        write_model(folder / SPARSE, colmap)
        write_depth_maps(folder / DEPTH, dense)
        write_cloud(folder / DENSE, fuse_depth_maps(dense, photos.view_of))
    return report


def _reconstruction_of_maps(
    photos: ImageSet, poses: Sequence[Pose], depths: Sequence[DepthPrior | None]
) -> Reconstruction:
    """Build a reconstruction without points from the posed images that have a depth map."""
    none = np.zeros(0, np.int64)
    found = enumerate(zip(photos, poses, depths, strict=True))
    images = tuple(
        RegisteredImage(index, photo.name, photo.pinhole, *pose, none, depth, 1.0)
        for index, (photo, pose, depth) in found
        if depth is not None
    )
    return Reconstruction(images, np.zeros((0, 3)), np.zeros(0))


def _point_depths(model: pycolmap.Reconstruction, image: pycolmap.Image) -> Float64:
    """Return the camera-frame depths (n,) of the 3D points that an image observes."""
    seen = [point.point3D_id for point in image.points2D if point.has_point3D()]
    seen = [number for number in seen if model.exists_point3D(number)]
    if not seen or not image.has_pose:
        return np.zeros(0)
    xyz = np.array([model.points3D[number].xyz for number in seen])
    matrix = np.asarray(image.cam_from_world().matrix())
    return transform(matrix[:, :3], matrix[:, 3], xyz)[:, 2]


def mesh_model(
    folder: PathLike,
    photos: PathLike | None = None,
    options: MeshOptions | None = None,
) -> TriangleMesh:
    """Mesh the depth maps of a result folder, texture the mesh with the photos, and write both.

    The function writes ``mesh.ply`` with vertex colors, ``mesh.glb`` with a texture, and
    ``mesh.obj`` with ``mesh.mtl`` and ``mesh.jpg``. The vertices of the PLY and OBJ files are in
    the world frame of the COLMAP model. The GLB file is rotated so that gravity points down.

    Args:
        folder: Result folder with depth maps.
        photos: Folder of the original photos; default: the folder recorded by the run.
        options: Options of meshing.

    Returns:
        The mesh in the frame of the model.

    Raises:
        InputError: folder or photos cannot be read, depth maps are missing or give no surface, or
            the libraries for meshes are not installed.
    """
    with lock_output_folder(Path(folder)), limit_threads(None), store_on_disk(cache_folder()):
        source = ExportSource.read(Path(folder), None if photos is None else Path(photos))
        poses = reconstruction_poses(source.model)
        files = [source.folder / DEPTH / f"{name}.npz" for name in source.names]
        depths = [
            store_fields(read_depth_map(file)[1], current_store())
            if file.is_file() and name not in source.held_out
            else None
            for name, file in zip(source.names, files, strict=True)
        ]
        posed = _reconstruction_of_maps(
            source.images, [poses[name] for name in source.names], depths
        )
        if not posed.images:
            raise InputError(
                f"{folder}: the result folder has no depth maps: run mpsfm dense first"
            )
        options = options or MeshOptions()
        view_of = source.images.view_of
        mesh = mesh_depth_maps(posed, view_of, options)
        textured = None
        if options.max_texture_size:
            textured = build_texture(mesh, posed, view_of, options.max_texture_size)
        with replace_entries(source.folder, MESH) as written:
            write_mesh(written, mesh, textured, source)
    return mesh
