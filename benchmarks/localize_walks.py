"""Localize photos in the model of a video, and a video in a model of photos.

    python -m benchmarks.localize_walks [--walks 3] [--config sift] [--records DIR]

Rooms and videos are those of ``benchmarks.walks``. Another camera takes photos with other exposure
and colors, up to 0.5 m and 60 degrees off the walk. Twenty photos are localized in the model of the
video, whose focal length is unknown. In the other direction, a video of a second walk is localized
in a COLMAP model of 64 photos with true poses. Queries have their true camera or an unknown focal
length. Errors are those of the pose relative to the nearest image of the model, so that errors of
the model itself do not count. Reconstructions and results of earlier calls in DIR are not computed
again.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import pycolmap

import mpsfm_core as mpsfm
from benchmarks._scenes import MPSFM
from benchmarks.localize import Record, build_model, format_median, format_recall, measure
from benchmarks.walks import (
    CAMERA,
    camera_pose,
    develop,
    draw_view,
    make_path,
    make_walk,
    render_frames,
    write_video,
    write_walk,
)
from mpsfm_core.data import PinholeCamera, Pose
from mpsfm_core.evaluation.alignment import trajectory_errors
from mpsfm_core.evaluation.trajectories import read_trajectory
from mpsfm_core.geometry import camera_center, compose, invert
from mpsfm_core.inputs.images import load_images
from mpsfm_core.inputs.models import find_model_folder, reconstruction_poses

SECOND_FPS = 10.0
"""Frames per second of the second walk."""
PHOTO_CAMERA = PinholeCamera(640, 480, 620.0, 620.0, 320.0, 240.0)
"""Camera of the photos: width, height, fx, fy, cx and cy in pixels."""
NUM_QUERIES, NUM_MODEL_PHOTOS = 20, 64
SECOND_ROUNDS = 0.5
"""Rounds of the second walk."""
MAX_OFFSET_M, MAX_TURN_DEG = 0.5, 60.0
"""Maximum offset per axis and maximum turn of a photo from a pose of the walk."""


class Case(NamedTuple):
    """Model, queries, and the true poses of both."""

    model: Path
    """Result folder of a video, or COLMAP model of photos."""
    images: Path
    """Folder of the images of the model."""
    image_poses: Mapping[str, Pose]
    """True poses ``cam_from_world`` of the images of the model, by file name."""
    queries: Path
    """Folder of photos or video that is localized."""
    query_poses: Mapping[str, Pose]
    """True poses ``cam_from_world`` of the queries, by the file name of a photo, or by the name
    ``frame_000000.jpg`` of a video frame."""
    query_camera: PinholeCamera
    """True camera of all queries."""


def main() -> None:
    """Localize in both directions, and print a table in Markdown."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--walks", type=int, default=3)
    parser.add_argument("--config", default="sift")
    parser.add_argument("--records", type=Path)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder, records = arguments.records or Path(temporary), []
        for make_case, seed in product((photos_in_video, video_in_photos), range(arguments.walks)):
            path = folder / f"{make_case.__name__}{seed}-{arguments.config}.json"
            if not path.is_file():
                setting = {"direction": make_case.__name__, "walk": seed}
                case = make_case(folder, seed, arguments.config)
                rows = [setting | row for row in localize(case, arguments.config)]
                path.write_text(json.dumps(rows))
            records += json.loads(path.read_text())
    print(make_table(records))


def photos_in_video(folder: Path, seed: int, config: str) -> Case:
    """Reconstruct a video, and write photos of its rooms as queries."""
    video, walk = write_walk(folder, seed)
    model = video.with_suffix("")
    if not (model / "sparse").is_dir():
        settings = ["--set", "inputs.video.max_frames=70", "--set", "dense.enabled=false"]
        run_command("reconstruct", video, "-o", model, "--config", config, *settings)
    photos, poses = write_photos(folder / f"query_photos{seed}", seed, NUM_QUERIES)
    return Case(model, model / "frames", name_frames(enumerate(walk)), photos, poses, PHOTO_CAMERA)


def video_in_photos(folder: Path, seed: int, config: str) -> Case:
    """Write photos of rooms with their model, and a video of a second walk as query."""
    photos, poses = write_photos(folder / f"photos{seed}", seed, NUM_MODEL_PHOTOS)
    model = folder / f"photos{seed}_model"
    model.mkdir(exist_ok=True)
    build_model(load_images(photos, PHOTO_CAMERA), poses).write(str(model))
    world, _, rng = make_walk(seed)
    walk = make_path(np.random.default_rng([seed, 52]), SECOND_ROUNDS, SECOND_FPS)
    video = folder / f"second_walk{seed}.mp4"
    write_video(video, render_frames(world, walk, rng), SECOND_FPS)
    return Case(model, photos, poses, video, name_frames(enumerate(walk)), CAMERA)


def name_frames(poses: Iterable[tuple[int, Pose]]) -> dict[str, Pose]:
    """Return the poses of the frames of a video, by image name instead of by frame number."""
    return {f"frame_{number:06d}.jpg": pose for number, pose in poses}


def write_photos(folder: Path, seed: int, count: int) -> tuple[Path, dict[str, Pose]]:
    """Write photos at even distances along a walk; return the folder and the true poses."""
    world, walk, _ = make_walk(seed, rounds=1.0)
    rng = np.random.default_rng([seed, count])
    folder.mkdir(parents=True, exist_ok=True)
    poses = {}
    for number in np.linspace(0, len(walk), count, endpoint=False).astype(int):
        rotation, translation = walk[number]
        center = camera_center(rotation, translation) + rng.uniform(-1, 1, 3) * MAX_OFFSET_M
        yaw = np.arctan2(rotation[2, 1], rotation[2, 0])
        yaw += np.deg2rad(MAX_TURN_DEG) * rng.uniform(-1, 1)
        pose = camera_pose(center, yaw, rng.uniform(-0.3, 0.1), rng.normal(0, 0.05))
        light = draw_view(world, pose, camera=PHOTO_CAMERA)[0]
        gain = 0.3 / light.mean() * rng.uniform(0.6, 1.6) * rng.uniform(0.9, 1.1, 3)
        photo = develop(light * gain) + rng.normal(0, 2.0, light.shape)
        name = f"IMG_{len(poses):04d}.png"
        cv2.imwrite(str(folder / name), photo.clip(0, 255).astype(np.uint8)[:, :, ::-1])
        poses[name] = pose
    return folder, poses


def localize(case: Case, config: str) -> Iterator[Record]:
    """Localize all queries twice, with their true camera and with unknown focal length.

    Yields:
        Errors of one query, with the number of model images and their ATE.
    """
    model = pycolmap.Reconstruction(str(find_model_folder(case.model)))
    found = reconstruction_poses(model)
    errors = trajectory_errors(found, case.image_poses)
    assert errors is not None
    setting = {"registered": len(found), "ate": errors.ate_rmse}
    scale = errors.truth_from_estimate.scale
    names = list(found)
    true_centers = np.stack([camera_center(*case.image_poses[name]) for name in names])

    def align(pose: Pose, true_pose: Pose) -> Pose:
        """Express a pose in the true world by the true pose of the nearest image."""
        distances = np.linalg.norm(true_centers - camera_center(*true_pose), axis=1)
        nearest = names[int(distances.argmin())]
        rotation, translation = compose(pose, invert(*found[nearest]))
        return compose((rotation, scale * translation), case.image_poses[nearest])

    arguments = [case.model, case.queries, "--config", config, "--images", case.images]
    # The first call stores the triangulated points of the model, which belong to no query.
    photo = case.images / next(iter(found))
    mpsfm.localize(case.model, photo, config=config, images=case.images)
    cameras = case.queries.with_suffix(".yaml")
    cameras.write_text(f"1: {{params: {case.query_camera.params.tolist()}, images: all}}\n")
    for known in (True, False):
        output = case.queries.with_name(f"{case.queries.stem}_{'known' if known else 'unknown'}")
        intrinsics = ["--intrinsics", cameras] if known else []
        seconds = run_command("localize", *arguments, "-o", output, *intrinsics)
        located = read_poses(output)
        for name, true_pose in case.query_poses.items():
            pose = located.get(name)
            moved = None if pose is None else (align(pose, true_pose), np.nan)
            record = {"known": known, "seconds": seconds / len(case.query_poses), "is_other": False}
            yield setting | record | measure(moved, true_pose)


def run_command(*arguments: object) -> float:
    """Run ``mpsfm`` with arguments, and return its CPU time in seconds."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run([*MPSFM, *map(str, arguments), "--quiet"], check=True)
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime - before.ru_utime


def read_poses(output: Path) -> dict[str, Pose]:
    """Read the poses of localized photos, or of all frames of a localized video."""
    trajectory = output / "trajectory.txt"
    if not trajectory.is_file():
        return reconstruction_poses(pycolmap.Reconstruction(str(output / "sparse")))
    found = read_trajectory(trajectory)
    numbers = np.rint(found.times * SECOND_FPS).astype(int)
    return name_frames(zip(numbers, found.poses, strict=True))


def make_table(records: Sequence[Record]) -> str:
    """Format a Markdown table: a row for photos localized in videos, and one for the reverse."""
    lines = [
        "| queries | models: images, ATE in cm | known: recall | median | unknown: recall | median "
        "| CPU s per query |",
        "| --- | ---: | ---: | ---: | ---: | ---: | ---: |",
    ]
    for direction in dict.fromkeys(record["direction"] for record in records):
        rows = [record for record in records if record["direction"] == direction]
        models = {row["walk"]: f"{row['registered']}, {100 * row['ate']:.1f}" for row in rows}
        known, unknown = ([row for row in rows if row["known"] == value] for value in (True, False))
        cells = [f"{len(known)} {direction.replace('_', ' ')}", "; ".join(models.values())]
        for part in (known, unknown):
            cells += [format_recall(part), format_median(part)]
        cells.append(f"{np.mean([row['seconds'] for row in known]):.2f}")
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


if __name__ == "__main__":
    main()
