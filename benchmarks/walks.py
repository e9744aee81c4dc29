"""Reconstruct rendered walks through several rooms, and compare with COLMAP's mapper.

    python -m benchmarks.walks [--walks 2] [--look-alike 1] [--fps 20] [--rounds 1.15]
        [--config sift] [--set dense.enabled=false] [--records DIR]

A walk is a video of a loop through four furnished rooms with equal doors, which ends after 1.15
rounds, or after more rounds of 20 s for a long video. A walk past look-alike rooms ends after three
rooms, the first and third of which differ in their pictures only. The video has camera shake,
noise, exposure changes and blurred frames, and its camera poses are known. Each video is
reconstructed with an unknown focal length, and the poses of all frames are compared with the true
poses. Frames are also localized between keyframes with true poses, and depth with smooth errors of
1.4 %. COLMAP extracts and matches SIFT features of the same keyframes (sequential matching without
loop detection) and maps them. The frames of hololens_room are a video without its blurred frames.
Results of earlier calls in DIR are not computed again.

A loop is closed rightly if keyframes after the first round share 15 points with keyframes of its
start, and if the loop error (:func:`measure_loop_error`) is at most 1 % of the length of a round. A
false loop is a pair of keyframes whose relative position is wrong by more than 1 m, after alignment
of the model with the true poses.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pycolmap

from benchmarks._scenes import MPSFM, shared_folder
from mpsfm_core.data import (
    DepthPrior,
    Float64,
    MappingImage,
    MappingProblem,
    NormalPrior,
    PinholeCamera,
    Pose,
    UInt8,
)
from mpsfm_core.evaluation.alignment import trajectory_errors
from mpsfm_core.evaluation.trajectories import (
    Trajectory,
    count_frames_outside_largest,
    evaluate_trajectory,
    read_trajectory,
)
from mpsfm_core.geometry import camera_center, rotation_angle_deg
from mpsfm_core.geometry.similarity import umeyama
from mpsfm_core.inputs.images import load_images
from mpsfm_core.inputs.models import reconstruction_poses
from mpsfm_core.inputs.video import read_selection
from mpsfm_core.mapping.scene.reconstruction import Reconstruction, RegisteredImage
from mpsfm_core.pipeline.trajectory import localize_frames
from mpsfm_core.report.verdict import judge
from mpsfm_core.results.original_images import OriginalImages
from mpsfm_core.results.summary import read_summary

sys.path.insert(0, str(Path(__file__).parents[1] / "plugins" / "mpsfm-compact"))

CAMERA = PinholeCamera(480, 360, 380.0, 380.0, 240.0, 180.0)
FPS = 20.0
SPEED = 0.8
"""Walking speed in meters per second."""
ROOM = np.array([4.4, 3.6])
"""Length and width of each of the four rooms in meters."""
HEIGHT = 2.6
DOOR = 1.0
"""Width of the door openings in meters."""
ROUNDS, OPEN_ROUNDS = 1.15, 0.75
"""Rounds of a walk that returns to its start, and of a walk past look-alike rooms."""
START_ROUNDS = 0.3
"""Part of the first round that is aligned with the true poses to measure the error of the loop."""
MAX_LOOP_ERROR_RATIO = 0.01
"""Loop error of a loop that is closed rightly, relative to the length of a round."""
MIN_LOOP_POINTS = 15
"""Common points of the start and the keyframes after the first round of a closed loop."""
FALSE_LOOP_ERROR = 1.0
"""Error of the relative position of two keyframes above which a model has a false loop, in meters.
"""
_TEXTURES = 64
Record = dict[str, Any]


def build_rooms(
    rng: np.random.Generator, texture_factor: float = 1.0, *, look_alike: bool = False
) -> tuple[Any, Any, Any]:
    """Build four rooms around the origin, each with doors to two neighbors.

    Args:
        rng: Generator of shapes and textures.
        texture_factor: Factor on the size of the textures of floor, ceiling and inner walls, which
            repeat in several rooms with factor 1.
        look_alike: If true, diagonal rooms have the same walls and furniture, and differ in their
            pictures.
    """
    from training.synthetic.builder import Builder
    from training.synthetic.furniture import FURNITURE, Frame
    from training.synthetic.textures import make_textures
    from training.synthetic.worlds import _wall

    b = Builder(rng, _TEXTURES)

    def look(period: tuple[float, float]) -> Any:
        return b.look((texture_factor * period[0], texture_factor * period[1]))

    length, width = 2 * ROOM
    b.box((0, 0, -0.1), (length + 1, width + 1, 0.1), look((0.8, 2)), shadow=False)
    b.box((0, 0, HEIGHT), (length + 1, width + 1, 0.1), look((1, 3)), shadow=False)
    door = b.look((1, 2))
    seed = int(rng.integers(2**32)) if look_alike else 0
    for side in range(4):
        if look_alike:
            b.rng = np.random.default_rng([seed, side % 2])
        along, away = (width, length) if side % 2 == 0 else (length, width)
        yaw = np.pi + side * np.pi / 2
        outward = np.array([np.cos(yaw), np.sin(yaw)]) * -away / 2
        f = Frame(b, *outward, yaw)
        b.box(f.at(0, -0.05, 0), (0.1, along + 0.2, HEIGHT), look((1, 3)), yaw, shadow=False)
        for half in (-1, 1):
            _wall(b, Frame(b, *f.at(half * along / 4, 0, 0)[:2], yaw), along / 2 - 0.4, HEIGHT)
            for offset in (-1.1, 0.2, 1.3):
                place = f.at(half * along / 4 + offset, 0.03, 0)
                FURNITURE[b.rng.integers(len(FURNITURE))](b, place[0], place[1], yaw)
        # An interior wall from the outer wall to the center, with a door opening in its middle.
        inner = Frame(b, *(outward / 2), yaw + np.pi / 2)
        half_length = away / 2
        part = (half_length - DOOR) / 2
        for end in (-1, 1):
            u = end * (DOOR + part) / 2
            wall = look((0.6, 2))
            b.box(inner.at(u, 0, 0), (0.12, part, HEIGHT), wall, inner.yaw, shadow=False)
            room_rng, b.rng = b.rng, rng
            for face in (-1, 1):
                picture = inner.at(u, 0.065 * face, rng.uniform(1.0, 1.4))
                b.box(picture, (0.02, *rng.uniform(0.4, 0.9, 2)), b.look((0.4, 0.9)), inner.yaw)
            b.rng = room_rng
            b.box(inner.at(end * (DOOR / 2 - 0.03), 0, 0), (0.16, 0.06, 2.1), door, inner.yaw)
        b.box(inner.at(0, 0, 2.1), (0.12, DOOR, HEIGHT - 2.1), look((0.6, 2)), inner.yaw)
    # Without lamps there are no shadows to compute, which is several times faster.
    b.lights.clear()
    b.ambient = ((0.9,) * 3, (0.5,) * 3)
    return b.arrays(make_textures(rng, _TEXTURES, ()))


def make_path(rng: np.random.Generator, rounds: float = ROUNDS, fps: float = FPS) -> list[Pose]:
    """Return ``cam_from_world`` of each frame of a walk around the center through all rooms."""
    a, c = ROOM / 2
    perimeter = 4 * (a + c)
    count = int(rounds * perimeter / SPEED * fps)
    turn = np.linspace(0, 2 * np.pi * rounds, count)
    # A rounded rectangle through the middle of the door openings.
    stretch = 1.0 / np.maximum(np.abs(np.cos(turn)), np.abs(np.sin(turn))) ** 0.6
    xy = np.column_stack([a * np.cos(turn) * stretch, c * np.sin(turn) * stretch])
    xy = cv2.GaussianBlur(xy, (1, 0), sigmaX=1e-6, sigmaY=0.25 * fps, borderType=cv2.BORDER_REFLECT)
    heading = np.gradient(xy, axis=0)
    yaw = np.unwrap(np.arctan2(heading[:, 1], heading[:, 0]))
    yaw = yaw - 0.35 + 0.45 * np.sin(4 * turn + rng.uniform(0, 6))
    shake = rng.normal(size=(count, 6))
    shake = cv2.GaussianBlur(shake, (1, 0), sigmaX=1e-6, sigmaY=0.12 * fps)
    shake *= np.array([0.02, 0.02, 0.02, 0.012, 0.012, 0.012]) / shake.std(axis=0)
    poses = []
    for place, angle, (dx, dy, dz, pitch, roll, extra) in zip(xy, yaw, shake, strict=True):
        center = np.array([place[0] + dx, place[1] + dy, 1.5 + dz])
        poses.append(camera_pose(center, angle + extra, -0.12 + pitch, roll))
    return poses


def camera_pose(center: Float64, yaw: float, tilt: float, roll: float = 0.0) -> Pose:
    """Return ``cam_from_world`` of a camera, from its heading and its tilt upward in radians."""
    forward = np.array([np.cos(yaw) * np.cos(tilt), np.sin(yaw) * np.cos(tilt), np.sin(tilt)])
    right = np.cross(forward, [0, 0, 1.0])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    cosine, sine = np.cos(roll), np.sin(roll)
    rotation = np.array([[cosine, sine, 0], [-sine, cosine, 0], [0, 0, 1]]) @ rotation
    return rotation, -rotation @ center


def draw_view(
    world: tuple[Any, Any, Any], pose: Pose, factor: int = 1, camera: PinholeCamera = CAMERA
) -> tuple[Any, Any, Any, Any]:
    """Render light, depth, normals and kind of surface of a view, downscaled by a factor."""
    from training.synthetic.raycast import draw

    width, height = camera.width // factor, camera.height // factor
    light, depth = np.zeros((height, width, 3)), np.zeros((height, width))
    normals, kind = np.zeros((height, width, 3)), np.zeros((height, width), np.uint8)
    to_world = np.ascontiguousarray(pose[0].T)
    center = -to_world @ pose[1]
    focal = camera.fx / factor
    draw(*world, center, to_world, focal, width, height, light, depth, normals, kind)
    return light, depth, normals, kind


def develop(light: Float64) -> Float64:
    """Convert linear light to RGB values from 0 to 255."""
    return np.clip(light, 0, 1) ** (1 / 2.2) * 255


def render_frames(
    world: tuple[Any, Any, Any], poses: Sequence[Pose], rng: np.random.Generator
) -> Iterator[UInt8]:
    """Yield the BGR frames of a walk with noise, exposure changes and some blurred frames."""
    gain = 1.0
    for number, pose in enumerate(poses):
        light = draw_view(world, pose)[0]
        gain += 0.1 * (0.3 / (light.mean() + 0.02) - gain) if number else 0.3 / light.mean() - gain
        frame = develop(light * gain)
        if rng.random() < 0.1:
            frame = cv2.blur(frame, (9, 1) if rng.random() < 0.7 else (1, 7))
        frame += rng.normal(0, 2.0, frame.shape)
        yield frame.clip(0, 255).astype(np.uint8)[:, :, ::-1]


def make_walk(
    seed: int, fps: float = FPS, rounds: float = ROUNDS, *, look_alike: bool = False
) -> tuple[tuple[Any, Any, Any], list[Pose], np.random.Generator]:
    """Return the rooms and the true poses of a walk, and the generator of the image noise."""
    rng = np.random.default_rng([seed, 51])
    world = build_rooms(rng, look_alike=look_alike)
    return world, make_path(rng, OPEN_ROUNDS if look_alike else rounds, fps), rng


def write_video(video: Path, frames: Iterable[UInt8], fps: float) -> None:
    """Write BGR frames to a video file, unless the file exists."""
    if video.is_file():
        return
    video.parent.mkdir(parents=True, exist_ok=True)
    part, writer = video.with_suffix(".part.mp4"), None
    for frame in frames:
        if writer is None:
            size = frame.shape[1], frame.shape[0]
            writer = cv2.VideoWriter(str(part), cv2.VideoWriter_fourcc(*"mp4v"), fps, size)
        writer.write(np.ascontiguousarray(frame))
    assert writer is not None
    writer.release()
    part.rename(video)


def write_walk(
    folder: Path,
    seed: int,
    fps: float = FPS,
    rounds: float = ROUNDS,
    *,
    look_alike: bool = False,
) -> tuple[Path, list[Pose]]:
    """Write the video of a walk, unless the folder has the video; return video and true poses."""
    world, poses, rng = make_walk(seed, fps, rounds, look_alike=look_alike)
    video = folder / f"{'look_alike' if look_alike else 'walk'}{seed}.mp4"
    write_video(video, render_frames(world, poses, rng), fps)
    return video, poses


def write_room(folder: Path) -> tuple[Path, dict[int, Pose]]:
    """Write the images of hololens_room to a video file.

    Returns:
        Path of the video file, and true poses ``cam_from_world`` by frame number.
    """
    scene = shared_folder() / "data" / "hololens_room"
    names = sorted(path.name for path in (scene / "images").iterdir())
    video = folder / "hololens_room.mp4"
    poses = reconstruction_poses(pycolmap.Reconstruction(str(scene / "gt")))
    by_stem = {Path(name).stem: pose for name, pose in poses.items()}
    write_video(
        video, (np.asarray(cv2.imread(str(scene / "images" / name))) for name in names), 4.0
    )
    rows = {
        n: by_stem[Path(name).stem] for n, name in enumerate(names) if Path(name).stem in by_stem
    }
    return video, rows


def localize_between_true_keyframes(
    video: Path, seed: int, fps: float = FPS, rounds: float = ROUNDS
) -> Record:
    """Localize the frames of a walk between keyframes with true poses; return quantiles of errors.

    The quantiles are 0.5 and 0.9 of the position error in meters, of the rotation error in degrees,
    and of the position error in predicted standard deviations (root mean square of three axes).
    """
    world, poses, _ = make_walk(seed, fps, rounds)
    folder, rng = video.with_suffix("") / "frames", np.random.default_rng(seed)
    selection = read_selection(folder)
    images, problem_images = [], []
    for row, keyframe in enumerate(selection.keyframes):
        rotation, translation = poses[keyframe.number]
        _, depth, normals, kind = draw_view(world, poses[keyframe.number], 3)
        noise = 20 * cv2.GaussianBlur(rng.normal(size=depth.shape), (0, 0), 8)
        depth = (depth * np.exp(0.02 * noise)).astype(np.float32)
        prior = DepthPrior(depth, (0.025 * depth) ** 2, kind == 1)
        flat = NormalPrior.from_arrays(normals.astype(np.float32), np.ones_like(depth))
        problem_images.append(MappingImage(keyframe.name, CAMERA, np.zeros((0, 2)), prior, flat))
        none = np.zeros(0, np.int64)
        images.append(
            RegisteredImage(row, keyframe.name, CAMERA, rotation, translation, none, prior, 1.0)
        )
    part = Reconstruction(tuple(images), np.zeros((0, 3)), np.zeros(0))
    names = [keyframe.name for keyframe in selection.keyframes]
    problem = MappingProblem(tuple(problem_images), ())
    originals = OriginalImages(load_images(folder, CAMERA, names=names), problem)
    start = time.process_time()
    frames = localize_frames(video, selection, [part], originals)
    seconds = (time.process_time() - start) / len(frames)
    errors = []
    for frame in frames:
        if frame.source == "tracked" and frame.pose is not None and frame.covariance is not None:
            true = poses[frame.number]
            offset = camera_center(*frame.pose) - camera_center(*true)
            ratio = offset @ np.linalg.solve(frame.covariance[3:, 3:], offset) / 3
            turn = float(rotation_angle_deg(frame.pose[0] @ true[0].T))
            errors.append([np.linalg.norm(offset), turn, np.sqrt(ratio)])
    quantiles = np.quantile(np.array(errors), [0.5, 0.9], axis=0)
    return {
        "tracked": len(errors),
        "frames": len(frames),
        "cpu_seconds": seconds,
        **dict(zip(("position", "rotation", "stds"), quantiles.T.tolist(), strict=True)),
    }


def run_walk(
    video: Path,
    poses: Mapping[int, Pose],
    fps: float,
    config: str,
    settings: Sequence[str],
    *,
    rounds: float | None = None,
) -> Record:
    """Reconstruct a video with MP-SfM, and its keyframes with COLMAP; return the errors.

    Args:
        video: The video.
        poses: True poses ``cam_from_world`` by frame number.
        fps: Frame rate.
        config: Name of the configuration of MP-SfM.
        settings: Settings that change the configuration.
        rounds: Number of rounds of a walk whose loop error is measured, or None.
    """
    truth = Trajectory(np.array(sorted(poses)) / fps, tuple(poses[n] for n in sorted(poses)))
    output = video.with_suffix("")
    start = time.monotonic()
    arguments = ["reconstruct", str(video), "-o", str(output), "--config", config, "--quiet"]
    arguments += [part for setting in settings for part in ("--set", setting)]
    # The memory of all children of this process would include the video before.
    _, _, usage = os.wait4(subprocess.Popen([*MPSFM, *arguments]).pid, 0)
    summary = read_summary(output / "summary.json")
    record: Record = {
        "walk": video.stem,
        "loop": rounds is not None,
        "seconds": time.monotonic() - start,
        "cpu_seconds": usage.ru_utime,
        "memory_mb": usage.ru_maxrss / 1024,
        "verdict": _describe_verdict(summary),
        "video": summary["videos"][0],
        "stages": {name: stage["seconds"] for name, stage in summary["stages"].items()},
    }
    if summary["status"] == "success":
        found = read_trajectory(output / "trajectory.txt")
        record["mpsfm"] = evaluate_trajectory(
            found, truth, count_frames_outside_largest(output / "trajectory.txt")
        )
        record["keyframes"] = _evaluate_model(output / "sparse", poses, rounds)
    start = time.process_time()
    database, mapped = output / "colmap.db", output / "colmap"
    database.unlink(missing_ok=True)
    reader = pycolmap.ImageReaderOptions(camera_model="SIMPLE_RADIAL")
    names = sorted(path.name for path in (output / "frames").glob("*.jpg"))
    frames = str(output / "frames")
    pycolmap.extract_features(
        database, frames, names, pycolmap.CameraMode.SINGLE, reader, device=pycolmap.Device.cpu
    )
    pycolmap.match_sequential(database, device=pycolmap.Device.cpu)
    mapped.mkdir(exist_ok=True)
    models = pycolmap.incremental_mapping(database, frames, mapped)
    record["colmap_cpu_seconds"] = time.process_time() - start
    if models:
        best = max(models, key=lambda number: models[number].num_reg_images())
        record["colmap"] = _evaluate_model(mapped / str(best), poses, rounds)
    return record


def _describe_verdict(summary: Mapping[str, Any]) -> str:
    """Return the level of the verdict about a run, and the codes of its doubts."""
    verdict = judge(summary)
    codes = sorted({doubt.reason.code.value for doubt in verdict.doubts})
    return verdict.level + (f" ({', '.join(codes)})" if codes else "")


def _evaluate_model(folder: Path, poses: Mapping[int, Pose], rounds: float | None) -> Record:
    """Return the number of registered keyframes of a COLMAP model, and its errors in meters."""
    model = pycolmap.Reconstruction(str(folder))
    found = {_frame_number(name): pose for name, pose in reconstruction_poses(model).items()}
    truth = {str(number): pose for number, pose in poses.items()}
    errors = trajectory_errors(found, truth)
    record: Record = {
        "registered": len(found),
        "ate": None if errors is None else errors.ate_rmse,
        "max": None if errors is None else float(errors.centers.max()),
        "pair": measure_pair_error(found, truth),
    }
    if rounds is not None:
        points: dict[str, set[int]] = {
            _frame_number(image.name): {
                point.point3D_id for point in image.points2D if point.has_point3D()
            }
            for image in model.images.values()
        }
        first, last = (
            set().union(*(points[name] for name in names))
            for names in _keyframes_of_loop(found, len(truth), rounds)
        )
        record["loop"] = measure_loop_error(found, truth, rounds)
        record["loop_points"] = len(first & last)
    return record


def _frame_number(name: str) -> str:
    """Return the frame number of a keyframe from its file name."""
    return str(int(Path(name).stem[-6:]))


def measure_pair_error(found: Mapping[str, Pose], truth: Mapping[str, Pose]) -> float | None:
    """Return the largest error of the relative position of two keyframes, in meters.

    The model is aligned with the true poses of all keyframes.

    Args:
        found: Estimated poses ``cam_from_world`` by frame number.
        truth: True poses by frame number.

    Returns:
        The error, or None if too few keyframes have both poses.
    """
    names = [name for name in found if name in truth]
    if len(names) < 3:
        return None
    centers, true_centers = (
        np.stack([camera_center(*poses[name]) for name in names]) for poses in (found, truth)
    )
    offsets = umeyama(centers, true_centers).apply(centers) - true_centers
    return float(np.linalg.norm(offsets[:, None] - offsets, axis=2).max())


def _keyframes_of_loop(
    found: Iterable[str], num_frames: int, num_rounds: float
) -> tuple[list[str], list[str]]:
    """Return the keyframes at the start of the first round, and those after this round."""
    start, end = (rounds / num_rounds * num_frames for rounds in (START_ROUNDS, 1.0))
    names = list(found)
    first = [name for name in names if int(name) < start]
    return first, [name for name in names if int(name) >= end]


def measure_loop_error(
    found: Mapping[str, Pose], truth: Mapping[str, Pose], num_rounds: float = ROUNDS
) -> float | None:
    """Return the median error of camera positions after the first round, in meters.

    The model is aligned with the true poses of the keyframes at the start of the first round. If
    the loop is not closed, the error is the drift of one round.

    Args:
        found: Estimated poses ``cam_from_world`` by frame number.
        truth: True poses of all frames of the walk by frame number.
        num_rounds: Number of rounds of the walk.

    Returns:
        The error, or None if too few keyframes at the start and at the end have a pose.
    """
    first, last = _keyframes_of_loop(found, len(truth), num_rounds)
    if len(first) < 3 or not last:
        return None
    centers, true_centers = (
        np.stack([camera_center(*poses[name]) for name in [*first, *last]])
        for poses in (found, truth)
    )
    similarity = umeyama(centers[: len(first)], true_centers[: len(first)])
    offsets = similarity.apply(centers) - true_centers
    return float(np.median(np.linalg.norm(offsets[len(first) :], axis=1)))


def is_loop_closed(model: Record) -> bool:
    """Return whether the loop of a walk is closed rightly, see the docstring of this module."""
    limit = MAX_LOOP_ERROR_RATIO * 2 * float(ROOM.sum())
    error = model["loop"]
    return error is not None and error <= limit and model["loop_points"] >= MIN_LOOP_POINTS


HEADER = (
    """\
| video | frames | keyframes | placed | ATE all | WATE-AUC 10 m, full | \
keyframes in the model, ATE, maximum | worst pair | loop, points | verdict | \
COLMAP: keyframes, ATE, maximum, loop | memory GB | CPU s, COLMAP | CPU min per min |
| --- |"""
    + " ---: |" * 13
)


def format_row(record: Record) -> str:
    """Format the results of a video as a row of a Markdown table."""
    video, found = record["video"], record.get("mpsfm")
    model, colmap = record.get("keyframes") or {}, record.get("colmap") or {}
    keyframes, minutes = video["keyframes"], video["duration_s"] / 60
    cells = [record["walk"], video["frames"], keyframes]
    if found is None:
        cells += ["0 %", *["none"] * 2]
    else:
        areas = found["wate_auc"]
        cells += [
            f"{100 * found['poses'] / video['frames']:.1f} %",
            f"{100 * found['ate_rmse']:.1f} cm",
            f"{areas.get('10', float('nan')):.1f}, {areas['full']:.1f}",
        ]
    cells += [_format_model(model, keyframes, "ate", "max"), _centimeters(model.get("pair"))]
    cells += [f"{_centimeters(model.get('loop'))}, {model.get('loop_points', 'none')}"]
    cells += [record["verdict"], _format_model(colmap, keyframes, "ate", "max", "loop")]
    cells += [f"{record['memory_mb'] / 1024:.1f}"]
    cells += [f"{record['cpu_seconds']:.0f}, {record['colmap_cpu_seconds']:.0f}"]
    cells += [f"{record['cpu_seconds'] / 60 / minutes:.1f}"]
    return "| " + " | ".join(map(str, cells)) + " |"


def _format_model(model: Record, keyframes: int, *errors: str) -> str:
    """Format the number of registered keyframes of a model, and some of its errors."""
    cells = [f"{model.get('registered', 0)} of {keyframes}"]
    return ", ".join(cells + [_centimeters(model.get(name)) for name in errors])


def summarize_loops(records: Sequence[Record]) -> str:
    """Return the numbers of walks with a loop closed rightly, and with a false loop."""
    models = [record.get("keyframes") for record in records]
    pairs = [model["pair"] for model in models if model is not None]
    false = sum(error is not None and error > FALSE_LOOP_ERROR for error in pairs)
    loops = [model for record, model in zip(records, models, strict=True) if record["loop"]]
    closed = sum(model is not None and is_loop_closed(model) for model in loops)
    return f"loops closed rightly: {closed} of {len(loops)}; false loops: {false} of {len(records)}"


def _centimeters(meters: float | None) -> str:
    return "none" if meters is None else f"{100 * meters:.1f} cm"


def main() -> None:
    """Reconstruct all videos and print a table in Markdown."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--walks", type=int, default=2)
    parser.add_argument("--look-alike", type=int, default=0, help="walks past look-alike rooms")
    parser.add_argument("--fps", type=float, default=FPS)
    parser.add_argument("--rounds", type=float, default=ROUNDS, help="rounds of the other walks")
    parser.add_argument("--config", default="sift")
    parser.add_argument("--set", dest="settings", action="append", default=[])
    parser.add_argument("--records", type=Path)
    arguments = parser.parse_args()
    config, settings = arguments.config, arguments.settings
    fps, rounds = arguments.fps, arguments.rounds
    walks = [(seed, False) for seed in range(arguments.walks)]
    walks += [(seed, True) for seed in range(arguments.look_alike)]
    with tempfile.TemporaryDirectory() as temporary:
        folder, records = arguments.records or Path(temporary), []
        print(HEADER, flush=True)
        for seed, look_alike in walks:
            path = folder / f"{'look_alike' if look_alike else 'walk'}{seed}-{config}.json"
            if not path.is_file():
                video, walk = write_walk(folder, seed, fps, rounds, look_alike=look_alike)
                poses = dict(enumerate(walk))
                of_loop = None if look_alike else rounds
                record = run_walk(video, poses, fps, config, settings, rounds=of_loop)
                if not look_alike:
                    record["true_keyframes"] = localize_between_true_keyframes(
                        video, seed, fps, rounds
                    )
                path.write_text(json.dumps(record))
            records.append(json.loads(path.read_text()))
            print(format_row(records[-1]), flush=True)
        path = folder / f"hololens_room-{config}.json"
        if not path.is_file():
            record = run_walk(*write_room(folder), 4.0, config, settings)
            path.write_text(json.dumps(record))
        print(format_row(json.loads(path.read_text())))
    for record in records:
        if "true_keyframes" in record:
            between = json.dumps(record["true_keyframes"])
            print(f"{record['walk']} between true keyframes: {between}")
    print(summarize_loops(records))


if __name__ == "__main__":
    main()
