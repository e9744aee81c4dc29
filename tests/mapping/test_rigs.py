"""Rigs: Tests of the mapper with one pose per frame, on scenes with a known solution."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mpsfm_core.data import Float64, MappingProblem, Rig
from mpsfm_core.data.errors import DataError
from mpsfm_core.geometry import (
    angle_between_deg,
    camera_center,
    compose,
    invert,
    rotation_angle_deg,
)
from mpsfm_core.geometry.similarity import umeyama
from mpsfm_core.mapping.mapper import reconstruct
from mpsfm_core.mapping.model_selection import compute_total_score
from mpsfm_core.mapping.options import MapperOptions
from mpsfm_core.mapping.parts.part_mapping import reconstruct as reconstruct_in_parts
from mpsfm_core.mapping.parts.part_mapping import select_parts
from mpsfm_core.mapping.scene.reconstruction import Reconstruction, transform_reconstruction
from mpsfm_core.mapping.scene.scene import Scene
from mpsfm_core.results.colmap_model import build_pinhole_model
from mpsfm_core.results.evidence import describe_evidence
from mpsfm_core.testing.synthetic.problems import SyntheticNoise
from mpsfm_core.testing.synthetic.rigs import RigKind, RigProblem, make_rig_problem
from mpsfm_core.testing.synthetic.scenes import look_at, room_scene


def make_frame_poses(count: int, step_m: float = 0.4) -> list[Float64]:
    """Return poses of frames that move through the room."""
    rng = np.random.default_rng(0)
    return [
        look_at(
            [-1.5 + step_m * k, -0.6 + 0.2 * rng.normal(), 1.4],
            [2.0 + step_m * k, 0.3 * rng.normal(), 1.2],
        )
        for k in range(count)
    ]


def make_turning_poses(count: int) -> list[Float64]:
    """Return poses of frames that turn by 30 degrees each, so that outward cameras overlap."""
    return [
        look_at(eye, [eye[0] + np.cos(angle), eye[1] + np.sin(angle), 1.3])
        for angle in np.radians(30.0) * np.arange(count)
        for eye in [[-0.8 + 0.3 * angle, 0.2 * np.sin(2 * angle), 1.4 + 0.1 * np.cos(angle)]]
    ]


def make_problem(kind: RigKind, count: int, frame_poses: list[Float64] | None = None) -> RigProblem:
    """Return a rig problem with noisy keypoints, and depth with a wrong scale per image."""
    noise = SyntheticNoise(keypoints_px=0.5, scale=0.1, depth=0.01)
    frame_poses = frame_poses or make_frame_poses(count)
    return make_rig_problem(
        room_scene(), kind, frame_poses, num_points=800, map_width=60, noise=noise
    )


def incremental() -> MapperOptions:
    """Return options of the mapper without global initialization."""
    return MapperOptions(global_initialization=False)


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


def hide_sensor_poses(problem: MappingProblem) -> MappingProblem:
    """Return the problem with unknown relative poses of its rig."""
    (rig,) = problem.rigs
    return replace(problem, rigs=(replace(rig, sensor_from_rig=(None,) * len(rig.sensor_poses)),))


@pytest.mark.parametrize(
    ("kind", "max_angle_deg"), [("stereo", 0.05), ("phones", 0.1), ("around", 0.1)]
)
def test_unknown_relative_poses_are_calibrated(kind: RigKind, max_angle_deg: float) -> None:
    rig_problem = make_problem(kind, 6, make_turning_poses(6))
    result = reconstruct(hide_sensor_poses(rig_problem.problem))
    model = result.reconstructions[0]
    assert len(model.images) == len(rig_problem.poses)
    assert_rigid_frames(model)
    assert model.metric is None or model.metric.by != "rig baselines"
    (rig,), (true_rig,) = model.rigs, rig_problem.problem.rigs
    assert rig.is_estimated
    first, true_first = rig.sensor_poses[0][0], true_rig.sensor_poses[0][0]
    for (rotation, _), (true_rotation, _) in zip(
        rig.sensor_poses, true_rig.sensor_poses, strict=True
    ):
        error = rotation @ first.T @ (true_rotation @ true_first.T).T
        assert rotation_angle_deg(error) < max_angle_deg
    assert center_errors(model, rig_problem.poses)[1].max() < 0.01


@pytest.mark.parametrize("known", [True, False], ids=["known", "unknown"])
def test_rig_of_parts_gives_rigid_frames(known: bool) -> None:
    rig_problem = make_problem("stereo", 14, make_frame_poses(14, 0.15))
    problem = rig_problem.problem if known else hide_sensor_poses(rig_problem.problem)
    options = MapperOptions(parts=20)
    assert len(select_parts(problem, options)) > 1
    model = reconstruct_in_parts(problem, options).reconstructions[0]
    assert len(model.images) == 28
    assert len(model.rigs) == 1
    assert_rigid_frames(model)
    assert center_errors(model, rig_problem.poses)[1].max() < 0.02


def test_rig_without_common_frame_stays_uncalibrated() -> None:
    rig_problem = make_problem("stereo", 4)
    (rig,) = hide_sensor_poses(rig_problem.problem).rigs
    frames = tuple((a, None) if k % 2 else (None, b) for k, (a, b) in enumerate(rig.frames))
    problem = replace(rig_problem.problem, rigs=(replace(rig, frames=frames),))
    result = reconstruct(problem)
    assert result.report.runs == 1
    assert result.reconstructions[0].rigs == ()


def test_images_that_do_not_move_as_one_stay_uncalibrated() -> None:
    rig_problem = make_problem("stereo", 6, make_turning_poses(6))
    (rig,) = hide_sensor_poses(rig_problem.problem).rigs
    left, right = zip(*rig.frames, strict=True)
    frames = tuple(zip(left, right[::-1], strict=True))
    problem = replace(rig_problem.problem, rigs=(replace(rig, frames=frames),))
    result = reconstruct(problem)
    assert result.report.runs == 1
    assert result.reconstructions[0].rigs == ()
    assert center_errors(result.reconstructions[0], rig_problem.poses)[1].max() < 0.01


def test_evidence_of_a_rig_counts_only_matches_between_frames() -> None:
    problem = make_problem("panorama", 2).problem
    (model,) = reconstruct(problem).reconstructions
    within = [p for p in problem.pairs if p.image_a // 8 == p.image_b // 8]
    between = problem.pairs_between_frames()
    assert within and len(within) + len(between) == len(problem.pairs)
    evidence = describe_evidence(model, problem)
    assert [len(frame) for frame in evidence["frames"]] == [8, 8]
    images = evidence["images"]
    for frame in evidence["frames"]:
        assert len({(images[n]["points"], images[n]["explained_ratio"]) for n in frame}) == 1
    apart = replace(problem, pairs=tuple(within))
    assert compute_total_score(apart) == 0.0
    assert {i["explained_ratio"] for i in describe_evidence(model, apart)["images"].values()} == {0}


def test_distances_between_frames_are_uncertain_without_points_of_three_frames() -> None:
    problem = make_problem("panorama", 3).problem
    (model,) = reconstruct(problem).reconstructions
    certain = describe_evidence(model, problem)["relative_scale_std"]
    assert certain < 0.01
    seen = np.zeros((3, len(model.points)), dtype=bool)
    for image in model.images:
        seen[image.index // 8, image.point_ids[image.point_ids >= 0]] = True
    # Points of odd rows connect the frames 0 and 1, all other points the frames 1 and 2.
    odd = np.arange(len(model.points)) % 2 == 1
    hidden = np.stack([~odd, np.zeros_like(odd), odd])
    images = tuple(
        replace(
            image,
            point_ids=np.where(hidden[image.index // 8][image.point_ids], -1, image.point_ids),
        )
        for image in model.images
    )
    evidence = describe_evidence(replace(model, images=images), problem)
    assert evidence["relative_scale_std"] > 0.2
    two = make_problem("panorama", 2).problem
    (pair,) = reconstruct(two).reconstructions
    assert describe_evidence(pair, two)["relative_scale_std"] is None


def test_pose_errors_by_matches_grow_if_common_points_fill_a_narrow_cone() -> None:
    problem = make_problem("panorama", 2).problem
    (model,) = reconstruct(problem).reconstructions
    errors = []
    first, second = (model.poses[frame[0]] for frame in problem.rigs[0].frames)
    rays = model.points - camera_center(*first)
    angles_deg = angle_between_deg(rays, camera_center(*second) - camera_center(*first))
    for max_angle_deg in (180.0, 25.0, 10.0):
        is_kept = np.append(angles_deg < max_angle_deg, False)
        images = tuple(
            replace(image, point_ids=np.where(is_kept[image.point_ids], image.point_ids, -1))
            for image in model.images
        )
        evidence = describe_evidence(replace(model, images=images), problem)
        errors.append([image["match_pose_error_deg"] for image in evidence["images"].values()])
    assert np.all(np.diff(errors, axis=0) > 0)
    assert np.max(errors[0]) < 0.1


def test_pose_errors_by_matches_of_an_unconnected_frame_are_unbounded() -> None:
    problem = make_problem("panorama", 3).problem
    (model,) = reconstruct(problem).reconstructions
    (rig,) = problem.rigs
    images = tuple(
        replace(image, point_ids=np.full_like(image.point_ids, -1))
        if image.name in rig.frames[2]
        else image
        for image in model.images
    )
    evidence = describe_evidence(replace(model, images=images), problem)
    assert evidence["relative_scale_std"] is None
    assert {evidence["images"][name]["match_pose_error_deg"] for name in rig.frames[2]} == {180.0}


def test_depth_disagreement_of_frames_counts_standard_deviations() -> None:
    problem = make_problem("panorama", 2).problem
    (model,) = reconstruct(problem).reconstructions
    assert describe_evidence(model, problem)["depth_disagreement"] < 1
    (rig,) = problem.rigs
    images = tuple(
        replace(image, scale=1.5 * image.scale) if image.name in rig.frames[1] else image
        for image in model.images
    )
    stds = [
        np.median(np.sqrt(image.depth.variance) / image.depth.depth) for image in problem.images
    ]
    evidence = describe_evidence(replace(model, images=images), problem)
    expected = np.log(1.5) / (np.sqrt(2) * np.median(stds))
    assert evidence["depth_disagreement"] == pytest.approx(expected, rel=0.5)


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
