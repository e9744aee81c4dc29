"""Generate the sample scene: build a room, render photos, simulate depth and normal priors.

Needs Blender as a Python module (bpy); README.md has the command that installs bpy.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from generator.cameras import Camera, Pose
from generator.files import (
    drop_jpeg_notes,
    write_intrinsics,
    write_poses,
    write_prior,
    write_truth,
)
from generator.priors import PriorErrors, degrade_depth, degrade_normals
from generator.render import cast_truth, empty_scene, render_image, scene_surface
from generator.room import build_room, room_path


def make_scene(
    build: Callable[[np.random.Generator], None],
    path: Callable[[np.random.Generator], Sequence[Pose]],
    folder: Path,
    *,
    samples: int,
    seed: int,
) -> None:
    """Build a scene, render it from each pose of a camera path, and write the scene folder."""
    camera, errors = Camera(), PriorErrors()
    halved = camera.halved()
    empty_scene()
    build(np.random.default_rng([seed, 0]))
    poses = {f"view_{i}": p for i, p in enumerate(path(np.random.default_rng([seed, 1])))}
    folder.mkdir(parents=True, exist_ok=True)
    write_intrinsics(folder, camera)
    write_poses(folder, camera, {f"{stem}.jpg": pose for stem, pose in poses.items()})
    surface = scene_surface()
    for index, (stem, pose) in enumerate(poses.items()):
        write_truth(folder, stem, cast_truth(surface, camera, pose))
        coarse = cast_truth(surface, halved, pose)
        depth = degrade_depth(coarse, errors, np.random.default_rng([seed, 2, index]))
        rng = np.random.default_rng([seed, 3, index])
        normals = degrade_normals(coarse, halved.rays(), errors, rng)
        write_prior(folder / "priors" / "depth" / f"{stem}.npz", "depth", depth)
        write_prior(folder / "priors" / "normals" / f"{stem}.npz", "normals", normals)
        image = folder / "images" / f"{stem}.jpg"
        render_image(camera, pose, image, samples)
        drop_jpeg_notes(image)


def main() -> None:
    """Parse the command line and generate the scene."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--output", type=Path, default=Path(__file__).parent)
    parser.add_argument("--samples", type=int, default=32, help="Cycles samples a pixel")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    make_scene(build_room, room_path, options.output, samples=options.samples, seed=options.seed)


if __name__ == "__main__":
    main()
