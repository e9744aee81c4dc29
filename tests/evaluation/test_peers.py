"""Tests of COLMAP's mappers on an analytic scene with known poses."""

from __future__ import annotations

import numpy as np
import pycolmap
import pytest

from mpsfm_core.data import MappingProblem, PinholeCamera
from mpsfm_core.evaluation import CONVENTIONS, pose_errors_deg
from mpsfm_core.evaluation.peers import PEERS, run_peer, write_database
from mpsfm_core.support.threads import limit_threads
from mpsfm_core.testing.synthetic.problems import SyntheticNoise, make_mapping_problem
from mpsfm_core.testing.synthetic.rigs import make_rig_problem
from mpsfm_core.testing.synthetic.scenes import arc_poses, room_scene

CAMERA = PinholeCamera(640, 480, 520.0, 515.0, 318.0, 242.0)
POSES = arc_poses(6, 9.0)


@pytest.fixture(scope="module")
def problem() -> MappingProblem:
    return make_mapping_problem(
        room_scene(), CAMERA, POSES, map_width=16, noise=SyntheticNoise(keypoints_px=0.2), seed=3
    )


def test_write_database_contains_problem(problem: MappingProblem, tmp_path) -> None:
    write_database(problem, tmp_path / "database.db")
    with pycolmap.Database.open(tmp_path / "database.db") as database:
        assert database.num_images() == database.num_cameras() == database.num_frames() == 6
        assert database.num_verified_image_pairs() == len(problem.pairs)
        camera = database.read_camera(2)
        assert camera.has_prior_focal_length
        np.testing.assert_array_equal(camera.params, CAMERA.params)
        np.testing.assert_allclose(
            database.read_keypoints(3)[:, :2], problem.images[2].keypoints, atol=1e-4
        )
        pair = problem.pairs[0]
        geometry = database.read_two_view_geometry(pair.image_a + 1, pair.image_b + 1)
        np.testing.assert_array_equal(geometry.inlier_matches, pair.matches)
        # Exact geometry satisfies x_b^T F x_a = 0 for all matches up to keypoint noise.
        a = problem.images[pair.image_a].keypoints[pair.matches[:, 0]]
        b = problem.images[pair.image_b].keypoints[pair.matches[:, 1]]
        lines = np.column_stack([a, np.ones(len(a))]) @ np.asarray(geometry.F).T
        distance = (lines[:, :2] * b).sum(1) + lines[:, 2]
        assert np.median(np.abs(distance) / np.linalg.norm(lines[:, :2], axis=1)) < 0.5


def test_write_database_with_rig_contains_relative_poses_and_frames(tmp_path) -> None:
    problem = make_rig_problem(room_scene(), "stereo", POSES[:2], num_points=100).problem
    write_database(problem, tmp_path / "database.db")
    with pycolmap.Database.open(tmp_path / "database.db") as database:
        assert (database.num_rigs(), database.num_frames(), database.num_cameras()) == (1, 2, 2)
        ((pose,),) = [rig.non_ref_sensors.values() for rig in database.read_all_rigs()]
    np.testing.assert_allclose(pose.translation, [-0.2, 0.0, 0.0])


@pytest.mark.parametrize("name", PEERS)
def test_run_peer_reconstructs_easy_scene(name: str, problem: MappingProblem) -> None:
    with limit_threads(1):  # COLMAP is deterministic with one thread.
        (estimated,) = run_peer(name, problem)
    truth = {f"view_{i}.png": (pose[:, :3], pose[:, 3]) for i, pose in enumerate(POSES)}
    errors = pose_errors_deg(estimated, truth, CONVENTIONS["paper"])
    assert set(estimated) == set(truth)
    assert errors.max() < 1.0


def test_run_peer_without_matches_has_no_poses(problem: MappingProblem) -> None:
    empty = MappingProblem(problem.images)
    for name in ("colmap", "colmap-global"):
        assert run_peer(name, empty) == []
