"""Reconstruct rooms from few panoramas each, and compare with COLMAP's panorama recipe.

Usage::

    python -m benchmarks.panoramas [--seeds 0 1 2] [--panoramas 1 2 3] [--size 3072] [--work DIR]

Four furnished rooms with equal doors in a square are rendered as equirectangular panoramas, at
random positions in each room. MP-SfM reconstructs them with SIFT, and depth of mpsfm-compact or the
true depth. COLMAP extracts and matches SIFT features of the same perspective views, and maps them
with a known rig (the recipe of its script ``panorama_sfm.py``).

Two adjacent rooms are correctly joined if the relative poses between their panoramas have errors
below 5 degrees and 0.5 m. One scale factor is fitted to all distances first.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections.abc import Mapping
from itertools import combinations
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pycolmap

from benchmarks.walks import HEIGHT, ROOM, build_rooms
from mpsfm_core import reconstruct
from mpsfm_core.data import DepthPrior, Float64, Pose, UInt8, View
from mpsfm_core.data.errors import MpsfmError
from mpsfm_core.data.result_layout import CUT_VIEWS
from mpsfm_core.evaluation.peers import set_incremental_options
from mpsfm_core.geometry import camera_center, compose, invert, rotation_angle_deg
from mpsfm_core.geometry.panorama import make_view_rotations
from mpsfm_core.inputs.models import reconstruction_poses
from mpsfm_core.report.verdict import judge

OVERRIDES = ("inputs.projection=equirectangular", "dense.enabled=false", "results.report=false")
MAX_ANGLE_DEG, MAX_DISTANCE_M = 5.0, 0.5
TEXTURE_FACTOR = 12.0
"""Factor that enlarges textures, so that no part of a texture appears in two rooms."""
World = tuple[Any, Any, Any]


def place_panoramas(count: int, rng: np.random.Generator) -> dict[str, Pose]:
    """Return ``panorama_from_world`` of each panorama by name ``room<number>_<number>``."""
    poses = {}
    corners = [(0.5, 0.5), (-0.5, 0.5), (-0.5, -0.5), (0.5, -0.5)]
    for room, corner in enumerate(corners):
        for number in range(count):
            offset = rng.uniform(-0.8, 0.8, 2) if count > 1 else rng.uniform(-0.4, 0.4, 2)
            center = np.array([*(ROOM * corner + offset), HEIGHT / 2 + rng.uniform(-0.1, 0.3)])
            yaw = rng.uniform(0, 2 * np.pi)
            forward = np.array([np.cos(yaw), np.sin(yaw), 0.0])
            right = np.array([np.sin(yaw), -np.cos(yaw), 0.0])
            rotation = np.stack([right, [0.0, 0.0, -1.0], forward])
            poses[f"room{room}_{number}"] = rotation, -rotation @ center
    return poses


def draw_square(world: World, pose: Pose, side: int) -> tuple[Float64, Float64, UInt8]:
    """Render light, depth and kind of surface of a view of 90 degrees."""
    from training.synthetic.raycast import draw

    light, depth = np.zeros((side, side, 3)), np.zeros((side, side))
    normals, kind = np.zeros((side, side, 3)), np.zeros((side, side), np.uint8)
    to_world = np.ascontiguousarray(pose[0].T)
    draw(*world, -to_world @ pose[1], to_world, side / 2, side, side, light, depth, normals, kind)
    return light, depth, kind


def render_panorama(world: World, pose: Pose, width: int, rng: np.random.Generator) -> UInt8:
    """Render six cube faces, resample them to an equirectangular RGB panorama, and add noise."""
    side = width // 3
    size = width, width // 2
    columns, rows = np.meshgrid(np.arange(width) + 0.5, np.arange(width // 2) + 0.5)
    longitude, latitude = (columns / width - 0.5) * 2 * np.pi, (rows / size[1] - 0.5) * np.pi
    directions = np.stack(
        [
            np.cos(latitude) * np.sin(longitude),
            np.sin(latitude),
            np.cos(latitude) * np.cos(longitude),
        ],
        axis=-1,
    )
    faces = [*make_view_rotations(4)]
    faces += [np.array([[1.0, 0, 0], [0, 0, -s], [0, s, 0]]) for s in (1.0, -1.0)]
    panorama = np.zeros((size[1], width, 3))
    for face in faces:
        in_face = directions @ face.T
        is_seen = in_face[..., 2] >= np.abs(in_face[..., :2]).max(axis=-1) - 1e-9
        light, _, _ = draw_square(world, compose((face, np.zeros(3)), pose), side)
        xy = (in_face[..., :2] / np.maximum(in_face[..., 2:], 1e-9) + 1) * side / 2 - 0.5
        xy = xy.astype(np.float32)
        drawn = cv2.remap(
            light, xy[..., 0], xy[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
        )
        panorama[is_seen] = drawn[is_seen]
    panorama = np.clip(panorama * 0.3 / panorama.mean(), 0, 1) ** (1 / 2.2) * 255
    panorama += rng.normal(0, 2.0, panorama.shape)
    return panorama.clip(0, 255).astype(np.uint8)


class TrueDepth:
    """Depth provider that renders the true depth of a view of a panorama."""

    def __init__(self, world: World, poses: Mapping[str, Pose]) -> None:
        self._world, self._poses = world, poses

    def predict(self, view: View) -> DepthPrior:
        """Render the true depth of a view, and declare a relative standard deviation of 2 %."""
        folder, name = view.name.split("/")
        rotation = make_view_rotations()[int(folder.removeprefix("camera"))]
        pose = compose((rotation, np.zeros(3)), self._poses[Path(name).stem])
        _, rendered, kind = draw_square(self._world, pose, 160)
        depth = rendered.astype(np.float32)
        return DepthPrior(
            depth, np.float32(0.02) ** 2 * depth**2, (kind == 1) & (depth > 0), metric=True
        )


def view_to_panorama(poses: Mapping[str, Pose]) -> dict[str, Pose]:
    """Return ``panorama_from_world`` by name of the panorama, from the poses of views."""
    rotations, of_panoramas = make_view_rotations(), {}
    for name, pose in poses.items():
        folder, file = name.split("/")
        rotation = rotations[int(folder.removeprefix("camera"))]
        of_panoramas[Path(file).stem] = compose(invert(rotation, np.zeros(3)), pose)
    return of_panoramas


def run_colmap(views: Path) -> list[dict[str, Pose]]:
    """Map the views of panoramas with COLMAP and a known rig; return the poses of each model."""
    cameras = []
    for number, rotation in enumerate(make_view_rotations()):
        camera = pycolmap.RigConfigCamera(ref_sensor=number == 0, image_prefix=f"camera{number}/")
        if number:
            camera.cam_from_rig = pycolmap.Rigid3d(np.column_stack([rotation, np.zeros(3)]))
        cameras.append(camera)
    config = pycolmap.RigConfig()
    config.cameras = cameras
    view = cv2.imread(str(next(views.glob("camera0/*.jpg"))))
    assert view is not None
    params = ",".join([f"{len(view) / 2}"] * 4)
    with tempfile.TemporaryDirectory(prefix="mpsfm-panoramas-") as folder:
        path = Path(folder) / "database.db"
        pycolmap.extract_features(
            path,
            views,
            camera_mode=pycolmap.CameraMode.PER_FOLDER,
            reader_options=pycolmap.ImageReaderOptions(
                camera_model="PINHOLE", camera_params=params
            ),
            extraction_options=pycolmap.FeatureExtractionOptions(use_gpu=False),
        )
        with pycolmap.Database.open(path) as database:
            pycolmap.apply_rig_config([config], database)
        matching = pycolmap.FeatureMatchingOptions(use_gpu=False, rig_verification=True)
        pycolmap.match_exhaustive(path, matching_options=matching)
        options = set_incremental_options(pycolmap.IncrementalPipelineOptions())
        models = pycolmap.incremental_mapping(path, views, folder, options)
        poses = [reconstruction_poses(model) for model in models.values()]
    return sorted(poses, key=lambda model: -len(model))


def measure(poses: Mapping[str, Pose], truth: Mapping[str, Pose]) -> str:
    """Return the cells of a table row: panoramas, joined pairs of rooms, errors and scale."""
    names = sorted(poses)
    ratios = [
        np.linalg.norm(_center(truth, a) - _center(truth, b))
        / max(float(np.linalg.norm(_center(poses, a) - _center(poses, b))), 1e-9)
        for a, b in combinations(names, 2)
    ]
    scale = float(np.median(ratios)) if ratios else np.nan
    joined, angles, distances = 0, [], []
    for room in range(4):
        pairs = [
            (a, b)
            for a in truth
            for b in truth
            if a.startswith(f"room{room}_") and b.startswith(f"room{(room + 1) % 4}_")
        ]
        errors = [_relative_error(poses, truth, a, b, scale) for a, b in pairs]
        is_right = [
            e is not None and e[0] < MAX_ANGLE_DEG and e[1] < MAX_DISTANCE_M for e in errors
        ]
        joined += all(is_right)
        angles += [e[0] for e in errors if e is not None]
        distances += [e[1] for e in errors if e is not None]
    if not angles:
        return f"{len(names)} / {len(truth)} | 0 / 4 | - | - | -"
    return (
        f"{len(names)} / {len(truth)} | {joined} / 4 | {np.median(angles):.2f} | "
        f"{100 * np.median(distances):.1f} | {abs(1 / scale - 1):.1%}"
    )


def _center(poses: Mapping[str, Pose], name: str) -> Float64:
    return camera_center(*poses[name])


def _relative_error(
    poses: Mapping[str, Pose], truth: Mapping[str, Pose], a: str, b: str, scale: float
) -> tuple[float, float] | None:
    """Return errors in degrees and meters of the pose of ``b`` relative to ``a``."""
    if a not in poses or b not in poses:
        return None
    rotation, translation = compose(poses[b], invert(*poses[a]))
    true_rotation, true_translation = compose(truth[b], invert(*truth[a]))
    angle = float(rotation_angle_deg(rotation @ true_rotation.T))
    center = camera_center(rotation, scale * translation)
    true_center = camera_center(true_rotation, true_translation)
    return angle, float(np.linalg.norm(center - true_center))


def main() -> None:
    """Print a table of joined rooms and errors of MP-SfM and COLMAP."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--panoramas", type=int, nargs="+", default=[1, 2, 3])
    parser.add_argument("--size", type=int, default=3072, help="width of a panorama in pixels")
    parser.add_argument("--work", type=Path, help="folder for panoramas and results, kept")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="mpsfm-panoramas-") as temporary:
        work = arguments.work or Path(temporary)
        columns = ["panoramas a room", "seed", "mapper", "panoramas", "joined", "deg", "cm"]
        columns += ["scale", "s", "verdict"]
        print(f"| {' | '.join(columns)} |")
        print("| ---: | ---: | --- | ---: | ---: | ---: | ---: | ---: | ---: | --- |")
        for count in arguments.panoramas:
            for seed in arguments.seeds:
                _compare(work / f"rooms{count}-{seed}", count, seed, arguments.size)


def _compare(folder: Path, count: int, seed: int, width: int) -> None:
    """Render the panoramas of one scene, and print a row for each mapper."""
    rng = np.random.default_rng([seed, 53])
    world = build_rooms(rng, TEXTURE_FACTOR)
    truth = place_panoramas(count, rng)
    photos = folder / "photos"
    photos.mkdir(parents=True, exist_ok=True)
    for name, pose in truth.items():
        if not (photos / f"{name}.jpg").is_file():
            pixels = render_panorama(world, pose, width, rng)
            cv2.imwrite(str(photos / f"{name}.jpg"), pixels[:, :, ::-1])
    for mapper in ("compact", "true depth", "colmap"):
        stored = folder / f"{mapper.replace(' ', '-')}.json"
        if not stored.is_file():
            start = time.perf_counter()
            poses, verdict = _run(mapper, photos, folder, world, truth)
            seconds = time.perf_counter() - start
            record = {
                "poses": {n: np.column_stack(pose).tolist() for n, pose in poses.items()},
                "seconds": seconds,
                "verdict": verdict,
            }
            stored.write_text(json.dumps(record), encoding="utf-8")
        record = json.loads(stored.read_text(encoding="utf-8"))
        matrices = {name: np.array(pose) for name, pose in record["poses"].items()}
        poses = {name: (matrix[:, :3], matrix[:, 3]) for name, matrix in matrices.items()}
        cells = measure(poses, truth)
        end = f"{record['seconds']:.0f} | {record['verdict']}"
        print(f"| {count} | {seed} | {mapper} | {cells} | {end} |", flush=True)


def _run(
    mapper: str, photos: Path, folder: Path, world: World, truth: Mapping[str, Pose]
) -> tuple[dict[str, Pose], str]:
    """Return ``panorama_from_world`` of the largest model of a mapper, and our verdict."""
    output = folder / mapper.replace(" ", "-")
    if mapper == "colmap":
        models = run_colmap(folder / "compact" / CUT_VIEWS)
        return (view_to_panorama(models[0]) if models else {}), "-"
    depth = TrueDepth(world, truth) if mapper == "true depth" else None
    try:
        result = reconstruct(photos, output, "sift", depth=depth, overrides=OVERRIDES, fresh=True)
    except MpsfmError as error:
        print(f"{mapper}: {error}")
        return {}, "failed"
    poses = view_to_panorama(result.mapping.reconstructions[0].poses)
    return poses, judge(result.summary).level


if __name__ == "__main__":
    main()
