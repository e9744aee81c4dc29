"""Rig basis: Tests of bundle adjustment with one pose per frame, against Ceres (pycolmap)."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pycolmap
import pytest
from scipy.spatial.transform import Rotation

from mpsfm_core.data import Float64
from mpsfm_core.data.errors import DataError
from mpsfm_core.optimize.bundle_adjustment import BundleProblem, BundleResult, adjust_bundle
from mpsfm_core.optimize.bundle_problem import prepare_bundle
from mpsfm_core.optimize.options import Loss
from mpsfm_core.optimize.rig_basis import RigBasis, RigConstraint, measure_rig_scale
from tests.optimize.bundle_reference import FOCAL, SIZE, rotation, soft_l1

TIGHT = soft_l1(
    reprojection_loss=Loss.TRIVIAL,
    depth_loss=Loss.TRIVIAL,
    function_tolerance=1e-14,
    max_iterations=500,
)
SENSORS = 3


def make_rig_problem(num_frames: int = 5, num_points: int = 80, noise_px: float = 1.0) -> Any:
    """Create frames of three cameras with known relative poses; the first frame is constant.

    Returns the problem and its true rig constraint.
    """
    rng = np.random.default_rng(3)
    turns = np.stack([np.eye(3), rotation([0, 0.3, 0.02]), rotation([0.1, -0.3, 0])])
    shifts = np.array([[0.0, 0, 0], [-0.4, 0.05, 0.02], [0.3, 0, 0.1]])
    frame_turns = np.stack([rotation(t) for t in rng.normal(0, 0.05, (num_frames, 3))])
    frame_shifts = np.stack(
        [-0.3 * np.arange(num_frames), *rng.normal(0, 0.1, (2, num_frames))], axis=1
    )
    frame = np.repeat(np.arange(num_frames), SENSORS)
    sensor = np.tile(np.arange(SENSORS), num_frames)
    rig = RigConstraint(
        frame, turns[sensor], shifts[sensor], variable_frame=np.arange(num_frames) > 0
    )
    rotations, translations = compose(rig, frame_turns, frame_shifts)
    points = rng.uniform([-4, -1, 3.0], [5, 1, 8.0], (num_points, 3))
    in_camera = np.einsum("nij,pj->npi", rotations, points) + translations[:, None]
    xy = FOCAL * in_camera[..., :2] / in_camera[..., 2:] + np.array(SIZE) / 2
    visible = (in_camera[..., 2] > 0) & ((xy > 0) & (xy < SIZE)).all(axis=-1)
    visible &= visible.sum(axis=0) >= 3
    obs_image, obs_point = np.nonzero(visible)
    problem = BundleProblem(
        rotations=rotations,
        translations=translations,
        intrinsics=np.array([[FOCAL, FOCAL, SIZE[0] / 2, SIZE[1] / 2]]),
        camera_of_image=np.zeros(len(frame), dtype=np.int64),
        points=points,
        obs_image=obs_image,
        obs_point=obs_point,
        obs_xy=xy[visible] + rng.normal(0, noise_px, (len(obs_image), 2)),
        rig=rig,
    )
    return problem, frame_turns, frame_shifts


def compose(rig: RigConstraint, turns: Float64, shifts: Float64) -> tuple[Float64, Float64]:
    """Return the poses of images from poses (f, 3, 3), (f, 3) of frames."""
    rotations = rig.rotations @ turns[rig.frame_of_image]
    moved = np.einsum("nij,nj->ni", rig.rotations, shifts[rig.frame_of_image])
    return rotations, moved + rig.scale * rig.translations


def perturb_frames(problem: BundleProblem, turns: Float64, shifts: Float64) -> BundleProblem:
    """Perturb the poses of all frames except the first, and all points."""
    rng = np.random.default_rng(0)
    moved = np.arange(len(turns)) > 0
    turns = (
        np.stack(
            [rotation(m * v) for m, v in zip(moved, rng.normal(0, 0.01, shifts.shape), strict=True)]
        )
        @ turns
    )
    shifts = shifts + moved[:, None] * rng.normal(0, 0.03, shifts.shape)
    assert problem.rig is not None
    rotations, translations = compose(problem.rig, turns, shifts)
    points = problem.points + rng.normal(0, 0.03, problem.points.shape)
    return replace(problem, rotations=rotations, translations=translations, points=points)


def build_colmap_rig(problem: BundleProblem) -> pycolmap.Reconstruction:
    """Build a COLMAP model of the problem, with one rig of three cameras."""
    assert problem.rig is not None
    rig = problem.rig
    model, colmap_rig = pycolmap.Reconstruction(), pycolmap.Rig(rig_id=1)
    for sensor in range(SENSORS):
        model.add_camera(
            pycolmap.Camera(
                camera_id=sensor + 1,
                model="PINHOLE",
                width=SIZE[0],
                height=SIZE[1],
                params=problem.intrinsics[0],
            )
        )
        sensor_id = model.cameras[sensor + 1].sensor_id
        if sensor == 0:
            colmap_rig.add_ref_sensor(sensor_id)
        else:
            pose = np.column_stack([rig.rotations[sensor], rig.translations[sensor]])
            colmap_rig.add_sensor(sensor_id, pycolmap.Rigid3d(pose))
    model.add_rig(colmap_rig)
    turns, shifts = rig.frame_poses(problem.rotations, problem.translations)
    for number in range(int(rig.frame_of_image.max()) + 1):
        frame = pycolmap.Frame(frame_id=number + 1, rig_id=1)
        rows = np.flatnonzero(rig.frame_of_image == number)
        images = []
        for sensor, row in enumerate(rows):
            image = pycolmap.Image(
                name=f"{row:03d}",
                keypoints=problem.obs_xy[problem.obs_image == row],
                camera_id=sensor + 1,
                image_id=int(row) + 1,
            )
            frame.add_data_id(image.data_id)
            image.frame_id = number + 1
            images.append(image)
        frame.rig_from_world = pycolmap.Rigid3d(np.column_stack([turns[rows[0]], shifts[rows[0]]]))
        model.add_frame(frame)
        for image in images:
            model.add_image(image)
        model.register_frame(number + 1)
    index = np.zeros(len(problem.obs_image), dtype=np.int64)
    for row in range(len(problem.rotations)):
        of_image = problem.obs_image == row
        index[of_image] = np.arange(of_image.sum())
    for point, xyz in enumerate(problem.points):
        of_point = np.flatnonzero(problem.obs_point == point)
        if len(of_point):
            elements = [
                pycolmap.TrackElement(int(problem.obs_image[k]) + 1, int(index[k]))
                for k in of_point
            ]
            model.add_point3D_with_id(
                point + 1, pycolmap.Point3D(xyz=xyz, track=pycolmap.Track(elements))
            )
    return model


def adjust_with_ceres(
    model: pycolmap.Reconstruction, *, refine_sensor_from_rig: bool = False
) -> None:
    """Adjust the frames, and the relative poses if asked, with constant intrinsics."""
    options = pycolmap.BundleAdjustmentOptions(
        refine_focal_length=False,
        refine_extra_params=False,
        refine_sensor_from_rig=refine_sensor_from_rig,
        print_summary=False,
    )
    options.ceres.solver_options.max_num_iterations = 500
    options.ceres.solver_options.function_tolerance = 1e-15
    options.ceres.solver_options.gradient_tolerance = 1e-14
    options.ceres.solver_options.parameter_tolerance = 1e-14
    config = pycolmap.BundleAdjustmentConfig()
    for image_id in model.images:
        config.add_image(image_id)
    for camera_id in model.cameras:
        config.set_constant_cam_intrinsics(camera_id)
    config.set_constant_rig_from_world_pose(1)
    pycolmap.create_default_bundle_adjuster(options, config, model).solve()


def assert_keeps_rig(problem: BundleProblem, result: BundleResult) -> None:
    """Assert that the images of each frame keep their relative poses."""
    assert problem.rig is not None
    for poses in problem.rig.frame_poses(result.rotations, result.translations):
        by_frame = poses.reshape(-1, SENSORS, *poses.shape[1:])
        np.testing.assert_allclose(by_frame, by_frame[:, :1].repeat(SENSORS, axis=1), atol=1e-9)


@pytest.mark.parametrize("dense_poses", [500, 0])
def test_adjust_bundle_with_rig_has_same_optimum_as_ceres(dense_poses: int) -> None:
    start = perturb_frames(*make_rig_problem())
    model = build_colmap_rig(start)
    adjust_with_ceres(model)
    result = adjust_bundle(start, TIGHT.model_copy(update={"dense_poses": dense_poses}))
    assert result.converged
    assert_keeps_rig(start, result)
    poses = [model.images[row + 1].cam_from_world() for row in range(len(start.rotations))]
    turns = np.stack([pose.rotation.matrix() for pose in poses])
    np.testing.assert_allclose(result.rotations, turns, atol=1e-6)
    shifts = np.stack([pose.translation for pose in poses])
    np.testing.assert_allclose(result.translations, shifts, atol=1e-5)


def free_sensors(problem: BundleProblem) -> RigConstraint:
    """Return the rig of a problem, with variable poses of all sensors except the first."""
    assert problem.rig is not None
    sensors = np.tile(np.arange(SENSORS), len(problem.rotations) // SENSORS) - 1
    return replace(problem.rig, variable_sensor=sensors)


def perturb_sensors(problem: BundleProblem) -> BundleProblem:
    """Perturb the relative poses of all sensors except the first."""
    rig = free_sensors(problem)
    assert rig.variable_sensor is not None
    turns, shifts = rig.frame_poses(problem.rotations, problem.translations)
    rotations, translations = rig.rotations.copy(), rig.translations.copy()
    for sensor, (turn, shift) in enumerate([([0.01, -0.02, 0], 0.03), ([0, 0.015, 0.01], -0.02)]):
        rows = rig.variable_sensor == sensor
        rotations[rows] = rotation(turn) @ rotations[rows]
        translations[rows] += shift
    rig = replace(rig, rotations=rotations, translations=translations)
    moved = rotations @ turns, np.einsum("nij,nj->ni", rotations, shifts) + translations
    return replace(problem, rotations=moved[0], translations=moved[1], rig=rig)


@pytest.mark.parametrize("dense_poses", [500, 0])
def test_adjust_bundle_with_variable_sensors_has_same_optimum_as_ceres(dense_poses: int) -> None:
    start = perturb_sensors(perturb_frames(*make_rig_problem()))
    start = replace(start, scale_anchor=SENSORS)
    model = build_colmap_rig(start)
    adjust_with_ceres(model, refine_sensor_from_rig=True)
    result = adjust_bundle(start, TIGHT.model_copy(update={"dense_poses": dense_poses}))
    assert result.converged
    assert result.rig is not None
    adjusted = replace(start, rig=result.rig)
    assert_keeps_rig(adjusted, result)
    (rig,) = model.rigs.values()
    scale = np.linalg.norm(result.rig.translations[1])
    for sensor, pose in enumerate(rig.non_ref_sensors.values(), start=1):
        np.testing.assert_allclose(result.rig.rotations[sensor], pose.rotation.matrix(), atol=1e-5)
        if sensor == 1:
            scale /= np.linalg.norm(pose.translation)
        np.testing.assert_allclose(
            result.rig.translations[sensor], scale * pose.translation, atol=1e-4
        )


def test_reduced_system_of_variable_sensors_is_the_derivative_of_the_retraction() -> None:
    """Finite differences of the poses of images by steps of frames, sensors and scale."""
    problem, *_ = make_rig_problem()
    rig = replace(free_sensors(problem), variable_scale=True, scale=1.2)
    rotations = problem.rotations
    translations = problem.translations + (rig.scale - 1) * rig.translations
    start = replace(problem, rotations=rotations, translations=translations, rig=rig)
    layout = prepare_bundle(start, TIGHT).bundle.layout
    basis = RigBasis.build(rig, layout, None, translations)
    slots = layout.pose_slot
    step = 1e-6
    matrix = basis.matrix.toarray()
    for parameter in range(basis.matrix.shape[1]):
        steps = np.zeros(basis.matrix.shape[1])
        steps[parameter] = step
        _, moved, shifted = rig.retract(rotations, translations, basis, steps)
        turned = Rotation.from_matrix(moved @ rotations.transpose(0, 2, 1)).as_rotvec()
        expected = np.hstack([turned, shifted - translations]) / step
        rows = matrix[:, parameter].reshape(-1, 7)[:, :6]
        actual = np.where((slots >= 0)[:, None], rows[slots], 0.0)
        np.testing.assert_allclose(actual, expected, atol=1e-4)


def test_adjust_bundle_with_rig_recovers_exact_poses_and_depth_scales() -> None:
    problem, *poses = make_rig_problem(noise_px=0.0)
    z = (
        np.einsum(
            "mj,mj->m", problem.rotations[problem.obs_image, 2], problem.points[problem.obs_point]
        )
        + problem.translations[problem.obs_image, 2]
    )
    off = np.random.default_rng(1).normal(0, 0.1, len(problem.rotations))
    problem = replace(
        problem,
        obs_log_depth=np.log(z) + off[problem.obs_image],
        obs_std_log_depth=0.05,
        variable_scale=np.ones(len(off), dtype=np.bool_),
    )
    result = adjust_bundle(perturb_frames(problem, *poses), TIGHT)
    np.testing.assert_allclose(result.rotations, problem.rotations, atol=1e-6)
    np.testing.assert_allclose(result.translations, problem.translations, atol=1e-6)
    observed = np.unique(problem.obs_image)
    np.testing.assert_allclose(result.log_scales[observed], -off[observed], atol=1e-6)


def test_variable_rig_scale_is_recovered_from_a_wrong_unit() -> None:
    """The depth of the first image fixes the world unit, so the rig is 1.3 times too large."""
    problem, turns, shifts = make_rig_problem(noise_px=0.0)
    assert problem.rig is not None
    factor = 1.3
    z = (
        np.einsum(
            "mj,mj->m", problem.rotations[problem.obs_image, 2], problem.points[problem.obs_point]
        )
        + problem.translations[problem.obs_image, 2]
    )
    log_depth = np.where(problem.obs_image == 0, np.log(z), np.nan)
    rig = replace(problem.rig, scale=factor, variable_scale=True)
    rotations, translations = compose(rig, turns, shifts)
    start = replace(
        problem,
        rotations=rotations,
        translations=translations,
        rig=rig,
        obs_log_depth=log_depth,
        obs_std_log_depth=0.01,
    )
    result = adjust_bundle(start, TIGHT)
    scale = measure_rig_scale(rig, result.translations)
    assert scale == pytest.approx(1.0, abs=1e-5)
    assert 0 < result.std_rig_scale < 0.02
    np.testing.assert_allclose(result.rotations, problem.rotations, atol=1e-6)


def test_scale_anchor_of_rig_without_baseline_keeps_a_coordinate_of_the_frame() -> None:
    problem, turns, shifts = make_rig_problem()
    assert problem.rig is not None
    rig = replace(problem.rig, translations=np.zeros_like(problem.rig.translations))
    rotations, translations = compose(rig, turns, shifts)
    start = replace(problem, rotations=rotations, translations=translations, rig=rig)
    frame, parameter = rig.find_gauge(SENSORS, rotations, translations)
    result = adjust_bundle(replace(start, scale_anchor=SENSORS), TIGHT)
    _, moved = rig.frame_poses(result.rotations, result.translations)
    assert moved[SENSORS * frame, parameter - 3] == pytest.approx(shifts[frame, parameter - 3])
    assert result.final_cost < 0.9 * result.initial_cost


def test_measure_rig_scale_without_baseline_returns_none() -> None:
    problem, *_ = make_rig_problem()
    assert problem.rig is not None
    rig = replace(problem.rig, translations=np.zeros_like(problem.rig.translations))
    assert measure_rig_scale(rig, problem.translations) is None


def test_poses_that_differ_from_the_rig_are_an_error() -> None:
    problem, *_ = make_rig_problem()
    wrong = problem.translations.copy()
    wrong[4] += 0.1
    with pytest.raises(DataError, match="differ from the relative poses"):
        adjust_bundle(replace(problem, translations=wrong), TIGHT)
