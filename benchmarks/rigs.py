"""Compare the mapper with COLMAP's incremental mapper on generated rigs with known relative poses.

Both mappers use the same keypoints, verified matches, cameras and relative poses. The frames move
through a furnished room; keypoints have noise of 0.5 px, and depth maps have scale errors of 10 %.

Usage::

    python -m benchmarks.rigs [--frames 6] [--seeds 2]
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Mapping

import numpy as np

from mpsfm_core.data import Float64, Pose
from mpsfm_core.evaluation.alignment import umeyama
from mpsfm_core.evaluation.peers import run_peer
from mpsfm_core.geometry import camera_center
from mpsfm_core.mapping.mapper import reconstruct
from mpsfm_core.testing.synthetic.problems import SyntheticNoise
from mpsfm_core.testing.synthetic.rigs import RigKind, RigProblem, make_rig_problem
from mpsfm_core.testing.synthetic.scenes import look_at, room_scene

KINDS: tuple[RigKind, ...] = ("stereo", "around", "panorama")
NOISE = SyntheticNoise(keypoints_px=0.5, scale=0.1, depth=0.01)


def make_frame_poses(count: int, seed: int) -> list[Float64]:
    """Return poses of frames that move along the room."""
    rng = np.random.default_rng(seed)
    eyes = np.linspace(-1.5, 0.5, count)
    return [
        look_at(
            [x, -0.6 + 0.2 * rng.normal(), 1.4 + 0.1 * rng.normal()],
            [x + 3.5, 0.3 * rng.normal(), 1.2],
        )
        for x in eyes
    ]


def measure_errors(poses: Mapping[str, Pose], truth: RigProblem) -> tuple[float, float, float]:
    """Return RMSE of centers in meters, RMSE of rotations in degrees, and error of the scale."""
    names = [image.name for image in truth.problem.images]
    true = dict(zip(names, truth.poses, strict=True))
    ours = np.array([camera_center(*poses[name]) for name in poses])
    theirs = np.array([camera_center(true[name][:, :3], true[name][:, 3]) for name in poses])
    aligned = umeyama(ours, theirs)
    centers = np.linalg.norm(aligned.apply(ours) - theirs, axis=1)
    turns = [poses[name][0] @ aligned.rotation.T @ true[name][:, :3].T for name in poses]
    angles = [np.degrees(np.linalg.norm(turn - np.eye(3)) / np.sqrt(2)) for turn in turns]
    rms = [float(np.sqrt(np.mean(np.square(values)))) for values in (centers, angles)]
    return rms[0], rms[1], abs(1 / aligned.scale - 1)


def main() -> None:
    """Print a table of registered images, errors and time of both mappers."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=6)
    parser.add_argument("--seeds", type=int, default=2)
    arguments = parser.parse_args()
    print("| rig | mapper | images | center error mm | rotation error deg | scale error | s |")
    print("| --- | --- | --- | --- | --- | --- | --- |")
    for kind in KINDS:
        for seed in range(arguments.seeds):
            truth = make_rig_problem(
                room_scene(), kind, make_frame_poses(arguments.frames, seed), noise=NOISE, seed=seed
            )
            for mapper in ("mpsfm", "colmap"):
                start = time.perf_counter()
                if mapper == "mpsfm":
                    models = [model.poses for model in reconstruct(truth.problem).reconstructions]
                else:
                    models = run_peer(mapper, truth.problem)
                seconds = time.perf_counter() - start
                if not models:
                    print(f"| {kind} {seed} | {mapper} | 0 | - | - | - | {seconds:.1f} |")
                    continue
                center, angle, scale = measure_errors(models[0], truth)
                count = f"{len(models[0])} / {len(truth.poses)}"
                print(
                    f"| {kind} {seed} | {mapper} | {count} | {1000 * center:.2f} | {angle:.3f} | "
                    f"{scale:.2%} | {seconds:.1f} |",
                    flush=True,
                )


if __name__ == "__main__":
    main()
