"""Tests of the registration of frames: one pose from the matches of all images of a rig."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mpsfm_core.data import Float64, MappingProblem
from mpsfm_core.geometry import camera_center, compose, invert, rotation_angle_deg
from mpsfm_core.mapping.consistency.misregistration import count_pair_matches
from mpsfm_core.mapping.mapper import reconstruct
from mpsfm_core.mapping.options import MapperOptions, RegistrationOptions
from mpsfm_core.mapping.refinement.refinement import Refiner
from mpsfm_core.mapping.registration.correspondences import find_correspondences
from mpsfm_core.mapping.registration.image_selection import (
    compute_pair_scores,
    rank_next_images,
)
from mpsfm_core.mapping.registration.pose_estimation import AbsolutePoseEstimator
from mpsfm_core.mapping.registration.pose_hypotheses import PoseHypothesisGenerator
from mpsfm_core.mapping.registration.pose_support import ScoredPose, score_pose
from mpsfm_core.mapping.registration.rig_scale import set_frame_scales
from mpsfm_core.mapping.scene.scene import Scene
from mpsfm_core.testing.synthetic.problems import SyntheticNoise
from mpsfm_core.testing.synthetic.rigs import RigKind, RigProblem, make_rig_problem
from mpsfm_core.testing.synthetic.scenes import look_at, room_scene

OPTIONS = RegistrationOptions()
FRAME_POSES = [look_at([-0.8, -0.5, 1.4], [2.0, 0.3, 1.2]), look_at([0.4, 0.3, 1.3], [2.0, 1.0, 1])]
NOISE = SyntheticNoise(keypoints_px=0.3, depth=0.01)


def make_problem(kind: RigKind, frame_poses: list[Float64] | None = None) -> RigProblem:
    """Return a rig problem with depth in meters, by default of two frames."""
    frame_poses = frame_poses or FRAME_POSES
    return make_rig_problem(room_scene(), kind, frame_poses, num_points=600, noise=NOISE)


def keep_matches(problem: MappingProblem, max_matches: int) -> MappingProblem:
    """Return the problem with at most ``max_matches`` matches of each pair between two frames."""
    between = problem.pairs_between_frames()
    pairs = [
        replace(p, matches=p.matches[:max_matches], scores=p.scores[:max_matches])
        if p in between
        else p
        for p in problem.pairs
    ]
    return replace(problem, pairs=tuple(pairs))


def register_first_frame(rig_problem: RigProblem, problem: MappingProblem) -> Scene:
    """Return a scene that has only the first frame of the rig registered, in its true pose."""
    scene, (pose, *_) = Scene(problem), rig_problem.poses
    scene.register(0, pose[:, :3], pose[:, 3])
    scene.maps[0].set_scale(1.0)
    set_frame_scales(scene, 0)
    return scene


def make_pose_estimator(scene: Scene) -> AbsolutePoseEstimator:
    """Return a pose estimator of a scene."""
    options = MapperOptions()
    refiner = Refiner(scene, options, compute_pair_scores(scene))
    return AbsolutePoseEstimator(scene, refiner, options)


def measure_pose_error(pose: ScoredPose, truth: Float64) -> tuple[float, float]:
    """Return the errors of a pose in degrees and meters."""
    center = camera_center(pose.rotation, pose.translation)
    shift = np.linalg.norm(center - camera_center(truth[:, :3], truth[:, 3]))
    return float(rotation_angle_deg(pose.rotation @ truth[:, :3].T)), float(shift)


@pytest.mark.parametrize("kind", ["stereo", "around", "panorama"])
def test_set_frame_scales_gives_all_images_scale_of_first_image(kind: RigKind) -> None:
    rig_problem = make_problem(kind)
    scene = register_first_frame(rig_problem, rig_problem.problem)
    members = scene.rigs.images_of(0)
    assert len(members) == len(rig_problem.poses) // 2
    np.testing.assert_allclose(scene.scales()[members], 1.0, rtol=0.02)


@pytest.mark.parametrize("kind", ["around", "panorama"])
def test_images_with_few_matches_register_together(kind: RigKind) -> None:
    rig_problem = make_problem(kind)
    problem = keep_matches(rig_problem.problem, 12)
    assert max(map(len, problem.pairs_between_frames())) < OPTIONS.min_inliers
    scene = register_first_frame(rig_problem, problem)
    image = len(rig_problem.poses) // 2
    correspondences = find_correspondences(scene, image, [0], OPTIONS)
    assert correspondences.max_frame_weight(scene) > OPTIONS.min_inliers
    best = make_pose_estimator(scene).estimate_poses(correspondences, attempt=0)[0]
    assert best.num_inliers > OPTIONS.min_inliers
    angle_deg, shift = measure_pose_error(best, rig_problem.poses[image])
    assert angle_deg < 0.3
    assert shift < 0.03


@pytest.mark.parametrize(("kind", "limit_m"), [("around", 0.5), ("panorama", 0.05)])
def test_generalized_hypotheses_are_near_true_pose(kind: RigKind, limit_m: float) -> None:
    rig_problem = make_problem(kind)
    scene = register_first_frame(rig_problem, rig_problem.problem)
    image = len(rig_problem.poses) // 2
    correspondences = find_correspondences(scene, image, [0], OPTIONS)
    generator = PoseHypothesisGenerator(scene, correspondences, OPTIONS, 0)
    made = {h.source: h for estimate in generator.generate_from_all() if (h := estimate())}
    for source in ("generalized PnP", "generalized relative pose"):
        pose = score_pose(scene, correspondences, made[source], OPTIONS)
        angle_deg, shift = measure_pose_error(pose, rig_problem.poses[image])
        assert angle_deg < 1.0, source
        assert shift < limit_m, source


def test_support_of_frame_is_equal_for_each_of_its_images() -> None:
    rig_problem = make_problem("around")
    scene = register_first_frame(rig_problem, rig_problem.problem)
    estimator = make_pose_estimator(scene)
    first = len(rig_problem.poses) // 2
    supports = []
    for image in (first, first + 2):
        correspondences = find_correspondences(scene, image, [0], OPTIONS)
        pose = estimator.estimate_unrefined_poses(correspondences, attempt=0)[0]
        first_pose = scene.rigs.derive_pose(image, (pose.rotation, pose.translation), first)
        hypothesis = pose.hypothesis._replace(rotation=first_pose[0], translation=first_pose[1])
        of_first = find_correspondences(scene, first, [0], OPTIONS)
        supports.append(score_pose(scene, of_first, hypothesis, OPTIONS).support)
        assert supports[-1] == pytest.approx(
            score_pose(scene, correspondences, pose.hypothesis, OPTIONS).support
        )
    assert supports[0] == pytest.approx(supports[1], rel=0.01)


def test_depth_of_nearer_new_frame_determines_pose() -> None:
    """The points are twice as far from the registered frame, so its depth errors weigh more."""
    frame_poses = [FRAME_POSES[0], look_at([1.2, 0.3, 1.3], [2.0, 1.0, 1.2])]
    noise = SyntheticNoise(keypoints_px=0.3, depth=0.05)
    rig_problem = make_rig_problem(
        room_scene(), "panorama", frame_poses, num_points=3000, noise=noise
    )
    count = len(rig_problem.poses) // 2
    scene, pairs = Scene(rig_problem.problem), []
    for pair in rig_problem.problem.pairs_between_frames():
        far, near = (
            scene.keypoint_prior[rows + scene.graph.offsets[image]]
            for image, rows in zip((pair.image_a, pair.image_b), pair.matches.T, strict=True)
        )
        rows = near < 0.5 * far
        pairs.append(replace(pair, matches=pair.matches[rows], scores=pair.scores[rows]))
    problem = replace(rig_problem.problem, pairs=tuple(pairs))
    scene = register_first_frame(rig_problem, problem)
    before = scene.snapshot()
    correspondences = find_correspondences(scene, count, [0], OPTIONS)
    best = make_pose_estimator(scene).estimate_unrefined_poses(correspondences, attempt=0)[0]
    forward = score_pose(scene, correspondences, best.hypothesis, OPTIONS)
    assert best.support > 1.2 * forward.support
    angle_deg, shift = measure_pose_error(best, rig_problem.poses[count])
    assert angle_deg < 0.5
    assert shift < 0.05
    np.testing.assert_array_equal(scene.registered, before.registered)
    np.testing.assert_array_equal(scene.rotations, before.rotations)


def test_rank_next_images_returns_one_image_of_each_frame() -> None:
    frame_poses = [*FRAME_POSES, look_at([1.5, 0.8, 1.3], [2.0, -1.0, 1])]
    rig_problem = make_problem("around", frame_poses)
    scene = register_first_frame(rig_problem, rig_problem.problem)
    scores = compute_pair_scores(scene)
    ranked = rank_next_images(scene, scores, ~scene.registered)
    frames = scene.rigs.frame_of[[image for image, _ in ranked]].tolist()
    assert sorted(frames) == [4, 8]
    dense = scores.toarray()
    between = [dense[frame : frame + 4, :4].sum() for frame in frames]
    assert between[0] >= between[1]
    for image, best_match in ranked:
        frame = scene.rigs.frame_of[image]
        assert dense[image, best_match] == dense[frame : frame + 4, :4].max()


def test_count_pair_matches_sums_matches_of_frames() -> None:
    rig_problem = make_problem("around")
    counts = count_pair_matches(Scene(rig_problem.problem))
    total = sum(map(len, rig_problem.problem.pairs_between_frames()))
    assert (counts.a.tolist(), counts.b.tolist()) == ([0], [4])
    assert counts.contradicting.tolist() == [total]


def test_frames_with_few_matches_of_each_pair_are_reconstructed() -> None:
    frame_poses = [*FRAME_POSES, look_at([-0.1, 0.8, 1.3], [2.0, -0.4, 1])]
    rig_problem = make_problem("panorama", frame_poses)
    problem = keep_matches(rig_problem.problem, 12)
    (model,) = reconstruct(problem, MapperOptions(global_initialization=False)).reconstructions
    assert len(model.images) == len(rig_problem.poses)
    poses = [(image.rotation, image.translation) for image in model.images]
    for a, b in ((0, 8), (8, 16)):
        rotation, _ = compose(poses[b], invert(*poses[a]))
        true = rig_problem.poses[b][:, :3] @ rig_problem.poses[a][:, :3].T
        assert rotation_angle_deg(rotation @ true.T) < 0.3
