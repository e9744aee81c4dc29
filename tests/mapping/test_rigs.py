"""Rigs: Tests of the mapper with one pose per frame, on scenes with a known solution."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mpsfm_core.data import Float64, Rig
from mpsfm_core.data.errors import DataError
from mpsfm_core.evaluation.alignment import umeyama
from mpsfm_core.geometry import camera_center, compose, invert
from mpsfm_core.mapping.mapper import reconstruct
from mpsfm_core.mapping.options import MapperOptions
from mpsfm_core.mapping.scene.reconstruction import Reconstruction, transform_reconstruction
from mpsfm_core.mapping.scene.scene import Scene
from mpsfm_core.results.colmap_model import build_pinhole_model
from mpsfm_core.testing.synthetic.problems import SyntheticNoise
from mpsfm_core.testing.synthetic.rigs import RigKind, RigProblem, make_rig_problem
from mpsfm_core.testing.synthetic.scenes import look_at, room_scene


def make_frame_poses(count: int) -> list[Float64]:
    """Return poses of frames that move through the room."""
    rng = np.random.default_rng(0)
    return [
        look_at(
            [-1.5 + 0.4 * k, -0.6 + 0.2 * rng.normal(), 1.4],
            [2.0 + 0.4 * k, 0.3 * rng.normal(), 1.2],
        )
        for k in range(count)
    ]


def make_problem(kind: RigKind, count: int) -> RigProblem:
    """Return a rig problem with noisy keypoints, and depth with a wrong scale per image."""
    noise = SyntheticNoise(keypoints_px=0.5, scale=0.1, depth=0.01)
    return make_rig_problem(
        room_scene(), kind, make_frame_poses(count), num_points=800, map_width=60, noise=noise
    )


def incremental() -> MapperOptions:
    """Return options of the mapper without global initialization."""
    options = MapperOptions()
    initialization = options.initialization.model_copy(update={"global_initialization": False})
    return options.model_copy(update={"initialization": initialization})


def assert_rigid_frames(reconstruction: Reconstruction) -> None:
    """Assert that the images of each frame have the relative poses of the rig."""
    poses = reconstruction.poses
    for rig in reconstruction.rigs:
        for frame in rig.frames:
            of_frame = [
                compose(invert(*sensor), poses[name])
                for sensor, name in zip(rig.sensor_from_rig, frame, strict=True)
                if name is not None
            ]
            for rotation, translation in of_frame[1:]:
                np.testing.assert_allclose(rotation, of_frame[0][0], atol=1e-9)
                np.testing.assert_allclose(translation, of_frame[0][1], atol=1e-9)


def center_errors(reconstruction: Reconstruction, poses: list[Float64]) -> tuple[float, Float64]:
    """Return the scale of the alignment to the true centers, and the remaining errors in meters."""
    images = reconstruction.images
    ours = np.array([camera_center(i.rotation, i.translation) for i in images])
    truth = np.array([camera_center(poses[i.index][:, :3], poses[i.index][:, 3]) for i in images])
    aligned = umeyama(ours, truth)
    return aligned.scale, np.linalg.norm(aligned.apply(ours) - truth, axis=1)


@pytest.mark.parametrize("options", [MapperOptions(), incremental()], ids=["global", "incremental"])
def test_stereo_rig_gives_rigid_frames_in_meters(options: MapperOptions) -> None:
    rig_problem = make_problem("stereo", 4)
    result = reconstruct(rig_problem.problem, options)
    (model,) = result.reconstructions
    assert len(model.images) == 8
    assert_rigid_frames(model)
    assert model.metric is not None
    assert model.metric.by == "rig baselines"
    scale, errors = center_errors(model, rig_problem.poses)
    assert scale == pytest.approx(1.0, abs=0.01)
    assert errors.max() < 0.01


def test_four_outward_cameras_are_registered_as_frames() -> None:
    rig_problem = make_problem("around", 4)
    (model,) = reconstruct(rig_problem.problem).reconstructions
    assert len(model.images) == 16
    assert_rigid_frames(model)
    assert center_errors(model, rig_problem.poses)[1].max() < 0.01


def test_panorama_views_share_one_center() -> None:
    rig_problem = make_problem("panorama", 3)
    (model,) = reconstruct(rig_problem.problem).reconstructions
    assert len(model.images) == 24
    assert_rigid_frames(model)
    assert center_errors(model, rig_problem.poses)[1].max() < 0.01


def test_colmap_model_has_rigs_and_frames() -> None:
    rig_problem = make_problem("stereo", 3)
    (model,) = reconstruct(rig_problem.problem).reconstructions
    colmap = build_pinhole_model(model, rig_problem.problem)
    assert (colmap.num_rigs(), colmap.num_frames(), colmap.num_cameras()) == (1, 3, 2)
    for image in colmap.images.values():
        matrix = image.cam_from_world().matrix()
        rotation, translation = model.poses[image.name]
        np.testing.assert_allclose(matrix, np.column_stack([rotation, translation]), atol=1e-9)
    (rig,) = colmap.rigs.values()
    (sensor_from_rig,) = rig.non_ref_sensors.values()
    np.testing.assert_allclose(sensor_from_rig.translation, [-0.2, 0, 0], atol=0.002)


def test_reconstruction_with_rigs_survives_checkpoint_and_scaling() -> None:
    rig_problem = make_problem("stereo", 3)
    (model,) = reconstruct(rig_problem.problem).reconstructions
    restored = Reconstruction.from_state_dict(model.state_dict())
    scaled = transform_reconstruction(restored, 2.0, np.eye(3), np.ones(3), None)
    assert_rigid_frames(scaled)
    assert scaled.rigs[0].frames == model.rigs[0].frames


def test_registering_an_image_registers_its_frame() -> None:
    scene = Scene(make_problem("around", 2).problem)
    scene.register(5, np.eye(3), np.zeros(3))
    np.testing.assert_array_equal(scene.registered_images(), [4, 5, 6, 7])
    scene.deregister(7)
    assert not scene.registered.any()


def test_image_of_two_frames_is_an_error() -> None:
    problem = make_problem("stereo", 2).problem
    with pytest.raises(DataError, match="one frame of one rig"):
        replace(problem, rigs=problem.rigs * 2)


def test_rig_with_a_matrix_that_is_no_rotation_is_an_error() -> None:
    with pytest.raises(DataError, match="rigid transform"):
        Rig(((2 * np.eye(3), np.zeros(3)),), (("a.jpg",),))
