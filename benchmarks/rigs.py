"""Compare MP-SfM's mapper with COLMAP's incremental mapper on synthetic camera rigs.

Both mappers use the same keypoints, verified matches, cameras and relative poses. The frames move
through a furnished room; keypoints have noise of 0.5 px, and depth maps have scale errors of 10 %.
With ``--unknown``, the relative poses are unknown and the frames turn by 20 degrees each. COLMAP
then follows its documented recipe: it maps the images without rigs, derives the relative poses with
``apply_rig_config``, and maps again with relative poses that bundle adjustment refines.

Usage::

    python -m benchmarks.rigs [--kinds KIND ...] [--frames 6] [--seeds 2] [--unknown]
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap

from mpsfm_core.data import Float64, MappingProblem, Pose, Rig
from mpsfm_core.evaluation.peers import run_peer, set_incremental_options, write_database
from mpsfm_core.geometry import camera_center
from mpsfm_core.geometry.similarity import umeyama
from mpsfm_core.inputs.models import reconstruction_poses
from mpsfm_core.mapping.mapper import reconstruct
from mpsfm_core.testing.synthetic.problems import SyntheticNoise
from mpsfm_core.testing.synthetic.rigs import RigKind, RigProblem, make_rig_problem
from mpsfm_core.testing.synthetic.scenes import look_at, room_scene

KINDS: tuple[RigKind, ...] = ("stereo", "phones", "around", "panorama")
NOISE = SyntheticNoise(keypoints_px=0.5, scale=0.1, depth=0.01)


def make_frame_poses(count: int, seed: int, turn_deg: float) -> list[Float64]:
    """Return poses of frames that move along the room, and turn by an angle each."""
    rng = np.random.default_rng(seed)
    eyes = np.linspace(-1.5, 0.5, count)
    poses = []
    for x, angle in zip(eyes, np.radians(turn_deg) * np.arange(count), strict=True):
        eye = np.array([x, -0.6 + 0.2 * rng.normal(), 1.4 + 0.1 * rng.normal()])
        forward, side = 3.5, 0.6 + 0.3 * rng.normal()
        direction = [
            forward * np.cos(angle) - side * np.sin(angle),
            forward * np.sin(angle) + side * np.cos(angle),
        ]
        poses.append(look_at(eye, [eye[0] + direction[0], eye[1] + direction[1], 1.2]))
    return poses


def run_colmap_with_unknown_rigs(problem: MappingProblem) -> list[dict[str, Pose]]:
    """Map without rigs, derive the relative poses, and map again, as COLMAP documents.

    Returns:
        ``cam_from_world`` by image name of each model, the largest first.
    """
    (rig,) = problem.rigs
    count = len(rig.sensor_from_rig)
    sensors = tuple(
        Rig(((np.eye(3), np.zeros(3)),), tuple((frame[sensor],) for frame in rig.frames))
        for sensor in range(count)
    )
    config = pycolmap.RigConfig()
    config.cameras = [
        pycolmap.RigConfigCamera(ref_sensor=sensor == 0, image_prefix=f"camera{sensor}/")
        for sensor in range(count)
    ]
    options = set_incremental_options(pycolmap.IncrementalPipelineOptions(), refine_rigs=True)
    with tempfile.TemporaryDirectory(prefix="mpsfm-rigs-") as folder:
        path = Path(folder) / "database.db"
        write_database(replace(problem, rigs=sensors), path)
        models = pycolmap.incremental_mapping(path, folder, folder, options)
        if not models:
            return []
        largest = max(models.values(), key=lambda model: model.num_reg_images())
        with pycolmap.Database.open(path) as database:
            pycolmap.apply_rig_config([config], database, largest)
        models = pycolmap.incremental_mapping(path, folder, folder, options)
        poses = [reconstruction_poses(model) for model in models.values()]
        return sorted(poses, key=lambda model: -len(model))


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
    parser.add_argument("--kinds", nargs="+", choices=KINDS, default=KINDS)
    parser.add_argument("--frames", type=int, default=6)
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--unknown", action="store_true", help="hide the relative poses")
    arguments = parser.parse_args()
    print("| rig | mapper | images | center error mm | rotation error deg | scale error | s |")
    print("| --- | --- | --- | --- | --- | --- | --- |")
    turn_deg = 20.0 if arguments.unknown else 0.0
    for kind in arguments.kinds:
        for seed in range(arguments.seeds):
            frame_poses = make_frame_poses(arguments.frames, seed, turn_deg)
            truth = make_rig_problem(room_scene(), kind, frame_poses, noise=NOISE, seed=seed)
            problem = truth.problem
            if arguments.unknown:
                (rig,) = problem.rigs
                unknown = replace(rig, sensor_from_rig=(None,) * len(rig.sensor_from_rig))
                problem = replace(problem, rigs=(unknown,))
            for mapper in ("mpsfm", "colmap"):
                start = time.perf_counter()
                if mapper == "mpsfm":
                    models = [model.poses for model in reconstruct(problem).reconstructions]
                elif arguments.unknown:
                    models = run_colmap_with_unknown_rigs(problem)
                else:
                    models = run_peer(mapper, problem)
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
