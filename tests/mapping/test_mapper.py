"""Tests of the whole mapper on analytic scenes with a known solution."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mpsfm_core.data import Float64, MappingProblem, PinholeCamera
from mpsfm_core.data.decisions import ImageReason
from mpsfm_core.geometry import angle_between_deg, rotation_angle_deg
from mpsfm_core.mapping.mapper import reconstruct
from mpsfm_core.mapping.options import MapperOptions
from mpsfm_core.mapping.scene.reconstruction import MappingResult, Reconstruction
from mpsfm_core.optimize import bundle_problem
from mpsfm_core.testing.synthetic.halls import CALIBRATED_PRIORS, make_hall_problem
from mpsfm_core.testing.synthetic.problems import SyntheticNoise, make_mapping_problem
from mpsfm_core.testing.synthetic.scenes import arc_poses, look_at, room_scene

CAMERA = PinholeCamera(640, 480, 520.0, 520.0, 320.0, 240.0)


def relative_errors_deg(reconstruction: Reconstruction, poses: list[Float64]) -> Float64:
    """Return the larger of rotation and translation direction error of each pair of registered
    views."""
    errors = []
    for a in reconstruction.images:
        for b in reconstruction.images:
            if a.index >= b.index:
                continue
            rotation = b.rotation @ a.rotation.T
            translation = b.translation - rotation @ a.translation
            true_rotation = poses[b.index][:, :3] @ poses[a.index][:, :3].T
            true_translation = poses[b.index][:, 3] - true_rotation @ poses[a.index][:, 3]
            turn = rotation_angle_deg(rotation @ true_rotation.T)
            swing = angle_between_deg(translation, true_translation)
            errors.append(max(float(turn), float(swing)))
    return np.array(errors)


def depth_errors(result: Reconstruction, problem: MappingProblem, poses: list[Float64]) -> Float64:
    """Return the median relative error of each refined depth map."""
    scene = room_scene()
    errors = []
    for image in result.images:
        rows, columns = image.depth.shape
        truth = scene.render(CAMERA.resized(columns, rows), poses[image.index]).depth
        valid = image.depth.valid
        ratio = image.depth.depth[valid] / truth[valid]
        errors.append(np.median(np.abs(ratio / np.median(ratio) - 1)))
    return np.array(errors)


@pytest.fixture(scope="module")
def exact() -> tuple[MappingProblem, list[Float64], MappingResult]:
    poses = arc_poses(5, 14.0)
    problem = make_mapping_problem(room_scene(), CAMERA, poses)
    return problem, poses, reconstruct(problem)


def test_exact_input_gives_exact_poses_and_depth(
    exact: tuple[MappingProblem, list[Float64], MappingResult],
) -> None:
    problem, poses, result = exact
    reconstruction = result.reconstructions[0]
    assert len(reconstruction.images) == 5
    assert relative_errors_deg(reconstruction, poses).max() < 0.05
    assert depth_errors(reconstruction, problem, poses).max() < 0.005
    assert np.median(reconstruction.errors_px) < 0.1


def test_reconstruction_has_metric_scale(
    exact: tuple[MappingProblem, list[Float64], MappingResult],
) -> None:
    _, poses, result = exact
    reconstruction = result.reconstructions[0]
    metric = reconstruction.metric
    assert metric is not None
    assert metric.trusted
    centers = [-i.rotation.T @ i.translation for i in reconstruction.images]
    truth = [-p[:, :3].T @ p[:, 3] for p in poses]
    found = np.linalg.norm(centers[0] - centers[-1])
    assert found == pytest.approx(np.linalg.norm(truth[0] - truth[-1]), rel=0.01)


def test_result_is_bitwise_reproducible(monkeypatch: pytest.MonkeyPatch) -> None:
    """Results of repeated runs are identical, with one thread and with two."""
    monkeypatch.setattr(bundle_problem, "RANGE_SIZE", 300)  # several ranges, so several threads
    poses = arc_poses(4, 12.0)
    noise = SyntheticNoise(keypoints_px=0.7, scale=0.05, depth=0.02)
    problem = make_mapping_problem(
        room_scene(), CAMERA, poses, noise=noise, declared_depth_std=0.03
    )
    defaults = MapperOptions().refinement
    runs = []
    for threads in (1, 2, 2):
        bundle = defaults.bundle.model_copy(update={"threads": threads})
        refinement = defaults.model_copy(update={"bundle": bundle})
        runs.append(reconstruct(problem, MapperOptions(refinement=refinement)).reconstructions[0])
    first = runs[0]
    for other in runs[1:]:
        assert np.array_equal(first.points, other.points)
        for a, b in zip(first.images, other.images, strict=True):
            assert np.array_equal(a.rotation, b.rotation)
            assert np.array_equal(a.depth.depth, b.depth.depth)


def test_chain_with_two_view_overlap_is_registered_by_lifting() -> None:
    """No three views observe a common point, so COLMAP could not propagate the scale."""
    poses = arc_poses(4, 20.0)
    noise = SyntheticNoise(keypoints_px=0.5, scale=0.03, depth=0.01)
    problem = make_mapping_problem(
        room_scene(),
        CAMERA,
        poses,
        points_per_view=400,
        noise=noise,
        declared_depth_std=0.03,
        links=[(0, 1), (1, 2), (2, 3)],
        two_view_tracks=True,
    )
    result = reconstruct(problem)
    assert len(result.reconstructions[0].images) == 4
    assert relative_errors_deg(result.reconstructions[0], poses).max() < 2.0

    unlifted = MapperOptions.model_validate({"registration": {"lifting": False}})
    without = reconstruct(problem, unlifted)
    assert not without.reconstructions or len(without.reconstructions[0].images) < 4


def test_pure_rotation_is_solved_by_depth() -> None:
    eye = (-1.5, 0.0, 1.5)
    poses = [look_at(eye, (1.5, y, 0.9)) for y in (-0.6, 0.0, 0.6)]
    problem = make_mapping_problem(
        room_scene(), CAMERA, poses, noise=SyntheticNoise(keypoints_px=0.3), declared_depth_std=0.01
    )
    reconstruction = reconstruct(problem).reconstructions[0]
    assert len(reconstruction.images) == 3
    for image in reconstruction.images:
        true_center = -poses[image.index][:, :3].T @ poses[image.index][:, 3]
        assert np.allclose(true_center, eye)
    centers = np.array([-i.rotation.T @ i.translation for i in reconstruction.images])
    assert np.ptp(centers, axis=0).max() < 0.02


def test_unconnected_images_become_components_largest_first() -> None:
    poses = arc_poses(5, 14.0)
    problem = make_mapping_problem(
        room_scene(), CAMERA, poses, links=[(0, 1), (2, 3), (3, 4), (2, 4)]
    )
    result = reconstruct(problem)
    sizes = [[i.index for i in r.images] for r in result.reconstructions]
    assert sizes == [[2, 3, 4], [0, 1]]
    assert not result.report.image_reasons


def test_unmatched_images_are_reported() -> None:
    poses = arc_poses(3, 14.0)
    problem = make_mapping_problem(room_scene(), CAMERA, poses, links=[(0, 1)])
    result = reconstruct(problem)
    assert list(result.report.image_reasons) == ["view_2.png"]


def test_unregistered_images_have_the_reason() -> None:
    poses = arc_poses(6, 14.0)
    links = [(0, 1), (1, 2), (0, 2), (3, 4)]
    problem = make_mapping_problem(room_scene(), CAMERA, poses, links=links)
    last = problem.images[5]
    nowhere = replace(last.depth, valid=np.zeros_like(last.depth.valid))
    problem = replace(problem, images=(*problem.images[:5], replace(last, depth=nowhere)))
    reasons = reconstruct(problem, MapperOptions(min_model_size=3)).report.image_reasons
    assert reasons["view_3.png"] == ImageReason.COMPONENT_TOO_SMALL.because(
        num_images=2, min_images=3
    )
    assert reasons["view_5.png"] == ImageReason.NO_VALID_DEPTH.because()
    reasons = reconstruct(problem, MapperOptions(max_components=1)).report.image_reasons
    assert reasons["view_3.png"] == ImageReason.COMPONENT_LIMIT.because(max_components=1)


def test_no_pairs_give_no_reconstruction() -> None:
    problem = make_mapping_problem(room_scene(), CAMERA, arc_poses(2, 14.0), links=[])
    result = reconstruct(problem)
    assert result.reconstructions == ()
    assert len(result.report.image_reasons) == 2


def test_estimated_focal_length_is_refined_and_shared() -> None:
    poses = arc_poses(5, 14.0)
    problem = make_mapping_problem(
        room_scene(), CAMERA, poses, noise=SyntheticNoise(keypoints_px=0.3)
    )
    guess = replace(CAMERA, fx=1.08 * CAMERA.fx, fy=1.08 * CAMERA.fy)
    images = tuple(replace(i, camera=guess, focal_known=False) for i in problem.images)
    guessed = MappingProblem(images, problem.pairs)
    reconstruction = reconstruct(guessed).reconstructions[0]
    focal = {image.camera.fx for image in reconstruction.images}
    assert len(focal) == 1
    assert focal.pop() == pytest.approx(CAMERA.fx, rel=0.002)

    kept = MapperOptions.model_validate({"refinement": {"refine_focal": False}})
    for image in reconstruct(guessed, kept).reconstructions[0].images:
        assert image.camera.fx == guess.fx


def test_depth_that_is_wrong_in_whole_regions_loses_no_image() -> None:
    """Wrong depth in regions with few 3D points contradicts correct poses."""
    errors = replace(CALIBRATED_PRIORS, patch=0.5)
    hall = make_hall_problem(49, errors, seed=4, points_per_view=25)
    result = reconstruct(hall.problem)
    assert [len(model.images) for model in result.reconstructions] == [49]
