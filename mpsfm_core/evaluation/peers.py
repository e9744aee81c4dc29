"""COLMAP mappers that the benchmark runs on the verified matches of mpsfm.

All COLMAP mappers use the keypoints, verified matches and fixed intrinsics of mpsfm, and a fixed
seed. COLMAP models with only two images are accepted, as in mpsfm. COLMAP is not deterministic with
several threads, so accuracy tables use one thread.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from types import MappingProxyType

import numpy as np
import pycolmap

from mpsfm_core.data import Float64, MappingProblem, Pose, Rig, VerifiedPair
from mpsfm_core.geometry import compose, invert
from mpsfm_core.geometry.pycolmap_conversion import colmap_from_pinhole
from mpsfm_core.inputs.models import reconstruction_poses
from mpsfm_core.support.threads import thread_limit

Models = Mapping[int, pycolmap.Reconstruction]

_TUNED_ANGLE_DEG = 0.001
"""Minimum triangulation angle of COLMAP tuned for low parallax, in degrees [paper, baselines]."""


def _incremental(*, tuned: bool, structure_less: bool) -> Callable[[Path, Path], Models]:
    """Configure COLMAP's incremental mapper.

    Args:
        tuned: True to use the minimum triangulation angles of the paper's tuned baselines.
        structure_less: True to allow registration from 2D-2D matches as fallback, the default of
            pycolmap 4.2.
    """

    def run(database: Path, output: Path) -> Models:
        options = set_incremental_options(
            pycolmap.IncrementalPipelineOptions(), structure_less=structure_less
        )
        if tuned:
            options.mapper.init_min_tri_angle = _TUNED_ANGLE_DEG
            options.mapper.ba_local_min_tri_angle = _TUNED_ANGLE_DEG
            options.mapper.filter_min_tri_angle = _TUNED_ANGLE_DEG
            options.triangulation.min_angle = _TUNED_ANGLE_DEG
            options.triangulation.ignore_two_view_tracks = False
        models: Models = pycolmap.incremental_mapping(database, output, output, options)
        return models

    return run


def set_incremental_options(
    options: pycolmap.IncrementalPipelineOptions,
    *,
    structure_less: bool = True,
    refine_rigs: bool = False,
) -> pycolmap.IncrementalPipelineOptions:
    """Set the options of all incremental mappers of COLMAP, and return the same object.

    Args:
        options: Options to change.
        structure_less: Allow registration from 2D-2D matches, the default of pycolmap 4.2.
        refine_rigs: Refine the relative poses of rigs.
    """
    options.structure_less_registration_fallback = structure_less
    options.min_model_size = 2
    options.extract_colors = False
    options.num_threads = thread_limit()
    options.random_seed = 0
    options.ba_refine_focal_length = False
    options.ba_refine_extra_params = False
    options.ba_refine_sensor_from_rig = refine_rigs
    options.mapper.abs_pose_refine_focal_length = False
    options.mapper.abs_pose_refine_extra_params = False
    return options


def _hierarchical(database: Path, output: Path) -> Models:
    """Run COLMAP's hierarchical mapper, in parts of at most 500 images with 50 common images."""
    options = pycolmap.HierarchicalPipelineOptions()
    options.num_threads = options.num_workers = thread_limit()
    set_incremental_options(options.incremental_options, structure_less=False)
    models: Models = pycolmap.hierarchical_mapping(database, output, output, options)
    return models


def _global(database: Path, output: Path) -> Models:
    """Run COLMAP's global mapper (GLOMAP)."""
    options = pycolmap.GlobalPipelineOptions()
    options.min_model_size = 2
    options.num_threads = thread_limit()
    options.random_seed = 0
    options.mapper.bundle_adjustment.refine_focal_length = False
    options.mapper.bundle_adjustment.refine_extra_params = False
    models: Models = pycolmap.global_mapping(database, output, output, options)
    return models


PEERS: Mapping[str, Callable[[Path, Path], Models]] = MappingProxyType(
    {
        "colmap": _incremental(tuned=False, structure_less=False),
        "colmap-tuned": _incremental(tuned=True, structure_less=False),
        "colmap-structureless": _incremental(tuned=False, structure_less=True),
        "colmap-tuned-structureless": _incremental(tuned=True, structure_less=True),
        "colmap-global": _global,
        "colmap-hierarchical": _hierarchical,
    }
)
"""Function ``run(database, output)`` of each COLMAP mapper, by mapper name. The mapper
``colmap-structureless`` has the defaults of pycolmap 4.2."""


def run_peer(name: str, problem: MappingProblem) -> list[dict[str, Pose]]:
    """Run a COLMAP mapper and return ``cam_from_world`` by image name of each model."""
    with tempfile.TemporaryDirectory(prefix="mpsfm-peer-") as folder:
        output = Path(folder)
        database = output / "database.db"
        write_database(problem, database)
        models = [reconstruction_poses(model) for model in PEERS[name](database, output).values()]
        return sorted(models, key=lambda model: -len(model))


def write_database(problem: MappingProblem, path: Path) -> None:
    """Write keypoints, verified matches and two-view geometries as a COLMAP database.

    A COLMAP image id is the image index in the mapping problem plus one. In the COLMAP database,
    each image has its own camera, except that the images of one sensor of a rig share a camera.
    """
    in_rig = {name for rig in problem.rigs for name in rig.image_names}
    with pycolmap.Database.open(path) as database:
        for rig in problem.rigs:
            _write_rig(database, problem, rig)
        for number, image in enumerate(problem.images, start=1):
            if image.name in in_rig:
                database.write_keypoints(number, image.keypoints.astype(np.float32))
                continue
            camera = colmap_from_pinhole(image.camera)
            camera.camera_id = number
            camera.has_prior_focal_length = True
            database.write_camera(camera, use_camera_id=True)
            own_rig = pycolmap.Rig(rig_id=number)
            own_rig.add_ref_sensor(camera.sensor_id)
            database.write_rig(own_rig, use_rig_id=True)
            row = pycolmap.Image(name=image.name, camera_id=number, image_id=number)
            database.write_image(row, use_image_id=True)
            frame = pycolmap.Frame(frame_id=number, rig_id=number)
            frame.add_data_id(row.data_id)
            database.write_frame(frame, use_frame_id=True)
            database.write_keypoints(number, image.keypoints.astype(np.float32))
        for pair in problem.pairs:
            ids = pair.image_a + 1, pair.image_b + 1
            database.write_matches(*ids, pair.matches.astype(np.uint32))
            database.write_two_view_geometry(*ids, _geometry(problem, pair))


def _write_rig(database: pycolmap.Database, problem: MappingProblem, rig: Rig) -> None:
    """Write the cameras, images and frames of a rig, whose first sensor is the reference.

    The id of a camera, rig or frame is the id of its first image.
    """
    numbers = {image.name: number for number, image in enumerate(problem.images, start=1)}
    members = [[numbers.get(name or "", 0) for name in frame] for frame in rig.frames]
    cameras = [min(filter(None, column)) for column in zip(*members, strict=True)]
    colmap_rig = pycolmap.Rig(rig_id=cameras[0])
    rig_from_reference = invert(*rig.sensor_poses[0])
    for camera_id, pose in zip(cameras, rig.sensor_poses, strict=True):
        camera = colmap_from_pinhole(problem.images[camera_id - 1].camera)
        camera.camera_id = camera_id
        camera.has_prior_focal_length = True
        database.write_camera(camera, use_camera_id=True)
        if camera_id == cameras[0]:
            colmap_rig.add_ref_sensor(camera.sensor_id)
        else:
            relative = np.column_stack(compose(pose, rig_from_reference))
            colmap_rig.add_sensor(camera.sensor_id, pycolmap.Rigid3d(relative))
    database.write_rig(colmap_rig, use_rig_id=True)
    for images in members:
        present = [(n, camera) for n, camera in zip(images, cameras, strict=True) if n]
        frame = pycolmap.Frame(frame_id=min(n for n, _ in present), rig_id=colmap_rig.rig_id)
        for number, camera_id in present:
            name = problem.images[number - 1].name
            row = pycolmap.Image(name=name, camera_id=camera_id, image_id=number)
            database.write_image(row, use_image_id=True)
            frame.add_data_id(row.data_id)
        database.write_frame(frame, use_frame_id=True)


def _geometry(problem: MappingProblem, pair: VerifiedPair) -> pycolmap.TwoViewGeometry:
    """Build COLMAP's two-view geometry: essential matrix, or homography for zero baseline."""
    geometry = pycolmap.TwoViewGeometry()
    geometry.inlier_matches = pair.matches.astype(np.uint32)
    pose = np.column_stack([pair.rotation, pair.translation])
    geometry.cam2_from_cam1 = pycolmap.Rigid3d(pose)
    first, second = (problem.images[i].camera.matrix for i in (pair.image_a, pair.image_b))
    if pair.translation.any():
        geometry.config = pycolmap.TwoViewGeometryConfiguration.CALIBRATED
        geometry.E = _cross(pair.translation) @ pair.rotation
        geometry.F = np.linalg.inv(second).T @ geometry.E @ np.linalg.inv(first)
    else:
        geometry.config = pycolmap.TwoViewGeometryConfiguration.PANORAMIC
        geometry.H = second @ pair.rotation @ np.linalg.inv(first)
    return geometry


def _cross(t: Float64) -> Float64:
    """Return the skew-symmetric cross product matrix of a vector."""
    return np.array([[0, -t[2], t[1]], [t[2], 0, -t[0]], [-t[1], t[0], 0]])
