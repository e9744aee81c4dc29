"""Tests of trajectory files and of the errors of trajectories with known noise."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from typer.testing import CliRunner

from mpsfm_core.cli import build_app
from mpsfm_core.data import Pose
from mpsfm_core.data.errors import InputError
from mpsfm_core.evaluation.trajectories import (
    associate_time_stamps,
    count_frames_outside_largest,
    evaluate_trajectory,
    read_trajectory,
)
from mpsfm_core.geometry import camera_center, rotation_angle_deg
from mpsfm_core.geometry.similarity import umeyama
from mpsfm_core.results.trajectory import TrajectoryFrame, write_trajectory

TIMES = 5.0 + np.arange(120) / 10


def make_poses(noise: float, seed: int = 0) -> list[Pose]:
    """Return poses on a curve of 24 m; ``noise`` is the std of the camera centers in meters."""
    rng = np.random.default_rng(seed)
    poses = []
    for time in TIMES - TIMES[0]:
        rotation = pycolmap.Rotation3d(np.array([0.1 * time, 0.2, 0.3 * np.sin(time)])).matrix()
        center = np.array([2 * time, np.sin(time), 0.0]) + rng.normal(0, noise, 3)
        poses.append((rotation, -rotation @ center))
    return poses


def write(folder: Path, poses: list[Pose], missing: int = 0) -> Path:
    folder.mkdir()
    frames = [
        TrajectoryFrame(number, time, "tracked", 0, pose)
        for number, (time, pose) in enumerate(zip(TIMES, poses, strict=True))
    ]
    frames += [TrajectoryFrame(200 + k, 90.0 + k, "none") for k in range(missing)]
    write_trajectory(folder, frames)
    return folder


def test_written_trajectory_is_read_again(tmp_path: Path) -> None:
    poses = make_poses(0.0)
    read = read_trajectory(write(tmp_path / "a", poses) / "trajectory.txt")
    assert read.times == pytest.approx(TIMES)
    for (rotation, translation), (true_rotation, true_translation) in zip(
        read.poses, poses, strict=True
    ):
        assert rotation_angle_deg(rotation @ true_rotation.T) < 1e-4
        assert translation == pytest.approx(true_translation, abs=1e-5)


def test_euroc_ground_truth_has_nanoseconds_and_w_first(tmp_path: Path) -> None:
    file = tmp_path / "data.csv"
    file.write_text("#timestamp [ns],px,py,pz,qw,qx,qy,qz,vx\n1500000000,1,2,3,0,1,0,0,9\n")
    read = read_trajectory(file)
    assert read.times == pytest.approx([1.5])
    assert camera_center(*read.poses[0]) == pytest.approx([1, 2, 3])
    assert read.poses[0][0] == pytest.approx(np.diag([1.0, -1, -1]))


def test_line_that_is_no_pose_is_named(tmp_path: Path) -> None:
    file = tmp_path / "t.txt"
    file.write_text("# TUM\n1 0 0 0 0 0 0 1\n2 0 0 0 0 0 1\n")
    with pytest.raises(InputError, match="line 3"):
        read_trajectory(file)


def test_time_stamps_are_associated_with_the_nearest_at_a_higher_rate() -> None:
    rows, true_rows = associate_time_stamps(
        np.array([0.0, 0.5, 1.0]), np.array([0.004, 0.2, 0.495, 0.6, 1.3])
    )
    assert rows.tolist() == [0, 1] and true_rows.tolist() == [0, 2]


def test_errors_of_a_scaled_trajectory(tmp_path: Path) -> None:
    truth = write(tmp_path / "truth", make_poses(0.0))
    shrunk = [(rotation, 0.5 * t) for rotation, t in make_poses(0.05)]
    found = write(tmp_path / "found", shrunk, missing=30)
    arguments = ["evaluate", str(found), str(truth / "trajectory.txt")]
    result = CliRunner().invoke(build_app(), arguments)
    assert result.exit_code == 0, result.output
    report = json.loads(result.stdout)
    assert report["compared"] == 120 and report["missing"] == 30
    assert report["scale"] == pytest.approx(2.0, rel=0.01)
    assert 0.06 < report["ate_rmse"] < 0.11  # sqrt(3) * 0.05
    assert 0.09 < report["rpe_rmse"] < 0.15  # sqrt(6) * 0.05
    assert report["recall"]["0.25 m, 2 deg"] == pytest.approx(80.0)


def test_windowed_error_equals_alignment_of_each_window(tmp_path: Path) -> None:
    truth, found = make_poses(0.0), make_poses(0.1, seed=1)
    folders = [write(tmp_path / name, poses) for name, poses in (("t", truth), ("f", found))]
    report = evaluate_trajectory(
        *(read_trajectory(folder / "trajectory.txt") for folder in reversed(folders))
    )
    a, b = (np.array([camera_center(*pose) for pose in poses]) for poses in (found, truth))
    path = np.concatenate([[0], np.linalg.norm(np.diff(b, axis=0), axis=1).cumsum()])
    errors = []
    for row in range(len(b)):
        start = np.clip(path[row] - 5, 0, path[-1] - 10)
        inside = (path >= start) & (path <= start + 10)
        moved = umeyama(a[inside], b[inside]).apply(a[row : row + 1])[0]
        errors.append(np.linalg.norm(moved - b[row]))
    exact = np.maximum(0, 1 - np.array(errors) / 0.5).mean()
    assert report["wate_auc"]["10"] == pytest.approx(100 * exact, abs=0.5)
    assert "25" in report["wate_auc"] and "50" not in report["wate_auc"]
    assert count_frames_outside_largest(tmp_path / "trajectory.txt") == 0
