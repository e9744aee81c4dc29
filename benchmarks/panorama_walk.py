"""Render a 360-degree video of a walk through four rooms, reconstruct it and print the errors.

Usage::

    python -m benchmarks.panorama_walk [--seconds 60] [--fps 5] [--width 1280] [--work DIR]

The video shows the rooms of :mod:`benchmarks.panoramas` along the path of :mod:`benchmarks.walks`,
by a camera that stays upright. Two commands make a COLMAP model with rigs, the poses of all frames
and a report, and a folder for gsplat. The camera centers of the keyframes and of all frames are
compared with the true ones. A video that exists in DIR is not rendered again, but the cache is
empty at the start.
"""

from __future__ import annotations

import argparse
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import cv2
import numpy as np
import pycolmap

from benchmarks.panoramas import TEXTURE_FACTOR, render_panorama, view_to_panorama
from benchmarks.walks import FPS, ROOM, SPEED, build_rooms, make_path
from mpsfm_core.data import Float64, Pose
from mpsfm_core.data.result_layout import SUMMARY
from mpsfm_core.evaluation.trajectories import read_trajectory
from mpsfm_core.geometry import camera_center
from mpsfm_core.geometry.similarity import umeyama
from mpsfm_core.inputs.models import reconstruction_poses
from mpsfm_core.report.verdict import judge
from mpsfm_core.results.summary import read_summary

SEED = (8, 53)
MAX_ERROR_M = 0.2
"""Largest error of a camera center that counts as right."""


def keep_upright(pose: Pose) -> Pose:
    """Return the pose of a camera with the same center and heading that stays upright."""
    rotation, translation = pose
    yaw = np.arctan2(rotation[2, 1], rotation[2, 0])
    right = np.array([np.sin(yaw), -np.cos(yaw), 0.0])
    forward = np.array([np.cos(yaw), np.sin(yaw), 0.0])
    turned = np.stack([right, [0.0, 0.0, -1.0], forward])
    return turned, -turned @ camera_center(rotation, translation)


def write_video(path: Path | None, seconds: float, fps: float, width: int) -> Float64:
    """Render the video unless ``path`` is None, and return the true camera centers (n, 3)."""
    rng = np.random.default_rng(SEED)
    world = build_rooms(rng, TEXTURE_FACTOR)
    rounds = seconds * SPEED / (2 * ROOM.sum()) + 1e-9
    poses = [keep_upright(pose) for pose in make_path(rng, rounds)]
    poses = poses[: round(seconds * FPS) : round(FPS / fps)]
    if path is not None:
        codec = cv2.VideoWriter_fourcc(*"mp4v")
        writer = cv2.VideoWriter(str(path), codec, fps, (width, width // 2))
        for pose in poses:
            pixels = render_panorama(world, pose, width, rng)
            writer.write(np.ascontiguousarray(pixels[:, :, ::-1]))
        writer.release()
    return np.array([camera_center(*pose) for pose in poses])


def measure_errors(name: str, ours: Float64, truth: Float64) -> str:
    """Align camera centers with the true ones, and describe their errors in one line.

    The similarity transform is fitted three times. From the second time on, it ignores the centers
    whose error is above the larger of ``MAX_ERROR_M`` and the median.
    """
    chosen = np.ones(len(ours), dtype=np.bool_)
    for _ in range(3):
        aligned = umeyama(ours[chosen], truth[chosen])
        errors = np.linalg.norm(aligned.apply(ours) - truth, axis=1)
        chosen = errors <= max(MAX_ERROR_M, float(np.median(errors)))
    return (
        f"{name}: {len(ours)}, {(errors <= MAX_ERROR_M).sum()} within {100 * MAX_ERROR_M:.0f} cm, "
        f"median {100 * np.median(errors):.2f} cm, max {100 * errors.max():.1f} cm"
    )


def main() -> None:
    """Render the video, run both commands, and print errors, time and memory."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=60)
    parser.add_argument("--fps", type=float, default=5, help="a divisor of 20")
    parser.add_argument("--width", type=int, default=1280, help="width of a panorama in pixels")
    parser.add_argument("--work", type=Path, help="folder for the video and results, kept")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="mpsfm-panorama-walk-") as temporary:
        work = arguments.work or Path(temporary)
        work.mkdir(parents=True, exist_ok=True)
        video, output = work / "walk.mp4", work / "out"
        missing = None if video.is_file() else video
        truth = write_video(missing, arguments.seconds, arguments.fps, arguments.width)
        cache = work / "cache"
        shutil.rmtree(cache, ignore_errors=True)
        settings = ["dense.enabled=false", "runtime.workers=1", f"runtime.cache_dir={cache}"]
        overrides = [part for setting in settings for part in ("--set", setting)]
        start = time.perf_counter()
        for command in (
            ["reconstruct", video, "-o", output, "--config", "sift", "--fresh", *overrides],
            ["export", output, "--to", "gsplat"],
        ):
            subprocess.run([sys.executable, "-m", "mpsfm_core", *map(str, command)], check=True)
        used = resource.getrusage(resource.RUSAGE_CHILDREN)
        print(
            f"{time.perf_counter() - start:.0f} s, {used.ru_utime + used.ru_stime:.0f} CPU s, "
            f"{used.ru_maxrss / 1024:.0f} MiB"
        )
        print_errors(output, truth, arguments.fps)


def print_errors(output: Path, truth: Float64, fps: float) -> None:
    """Print the verdict, and the position errors of the keyframes and of all video frames."""
    verdict = judge(read_summary(output / SUMMARY))
    print(verdict.level, [doubt.reason.code.value for doubt in verdict.doubts])
    model = pycolmap.Reconstruction(str(output / "sparse"))
    poses = view_to_panorama(reconstruction_poses(model))
    numbers = [int(name.rsplit("_", 1)[1]) for name in poses]
    centers = np.array([camera_center(*pose) for pose in poses.values()])
    print(measure_errors("panoramas", centers, truth[numbers]))
    trajectory = read_trajectory(output / "trajectory.txt")
    rows = np.rint(trajectory.times * fps).astype(int)
    centers = np.array([camera_center(*pose) for pose in trajectory.poses])
    print(measure_errors("frames", centers, truth[rows]))


if __name__ == "__main__":
    main()
