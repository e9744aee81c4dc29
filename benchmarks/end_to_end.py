"""Accuracy and time of ``mpsfm reconstruct``, compared with COLMAP's SIFT pipeline.

    python -m benchmarks.end_to_end [--scenes fountain ...] [--output FILE]

COLMAP runs SIFT, exhaustive matching and the incremental mapper, as ``colmap
automatic_reconstructor``, with the default number of threads. ``mpsfm reconstruct`` runs with an
empty cache and compiled kernels, without the dense stage and the report. COLMAP and ``mpsfm
reconstruct`` get the true intrinsics. The printed table lists pose AUC in percent (convention
`paper`), and wall time of one run on an idle machine.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Mapping
from pathlib import Path

import pycolmap

from benchmarks._scenes import MPSFM, percent, shared_folder
from benchmarks._sift import extract, match
from mpsfm_core.data import Pose
from mpsfm_core.evaluation.pose_auc import CONVENTIONS, pose_auc, pose_errors_deg
from mpsfm_core.evaluation.scene_folder import SceneFolder, read_scene
from mpsfm_core.inputs.images import load_images
from mpsfm_core.inputs.models import read_poses, reconstruction_poses
from mpsfm_core.support.user_folders import CACHE_VARIABLE

SCENES = ("fountain", "rendered_kitchen", "hololens_room")
OURS = ("sift", "fast-cpu")
"""Configurations of ``mpsfm reconstruct`` that are measured."""
_ALONE = ("dense.enabled=false", "results.dense_cloud=false", "results.report=false")


def main() -> None:
    """Parse the command line, run both programs, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--scenes", nargs="+", default=["fountain"], choices=SCENES)
    parser.add_argument("--output", type=Path, help="also write the table to this file")
    parser.add_argument("--colmap", nargs=2, metavar=("SCENE", "DIR"), help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.colmap:
        colmap(read_scene(Path(arguments.colmap[0])), Path(arguments.colmap[1]))
        return
    lines = [
        "| scene | method | registered | AUC@1/5/20 | s | / COLMAP |",
        "| --- | --- | ---: | ---: | ---: | ---: |",
    ]
    for name in arguments.scenes:
        lines += compared(read_scene(shared_folder() / "data" / name))
        print("\n".join(lines), file=sys.stderr)
    text = "\n".join(lines) + "\n"
    print(text, end="")
    if arguments.output:
        arguments.output.write_text(text, encoding="utf-8")


def compared(scene: SceneFolder) -> list[str]:
    """Yield a table row for COLMAP and for each configuration of ``mpsfm reconstruct``."""
    folder = scene.images.parent
    rows = []
    with tempfile.TemporaryDirectory() as work:
        colmap_command = [sys.executable, "-m", "benchmarks.end_to_end", "--colmap", str(folder)]
        target = Path(work, "colmap")
        reference = timed([*colmap_command, str(target)], {})
        rows.append(row(scene, "COLMAP", read_poses(target), reference, reference))
        for config in OURS:
            target = Path(work, config)
            command = [*MPSFM, "reconstruct", str(scene.images), "-o", str(target), "--quiet"]
            command += ["--intrinsics", str(scene.intrinsics), "--config", config]
            for setting in _ALONE:
                command += ["--set", setting]
            seconds = timed(command, {CACHE_VARIABLE: str(Path(work, f"cache-{config}"))})
            poses = read_poses(target / "sparse")
            rows.append(row(scene, f"`{config}`", poses, seconds, reference))
    return rows


def timed(command: list[str], environment: Mapping[str, str]) -> float:
    """Run a command, and return its wall time in seconds."""
    started = time.perf_counter()
    subprocess.run(command, check=True, env={**os.environ, **environment}, stdout=sys.stderr)
    return time.perf_counter() - started


def row(
    scene: SceneFolder, label: str, poses: Mapping[str, Pose], seconds: float, reference: float
) -> str:
    """Format registered images, pose AUC and time of one method as a table row."""
    convention = CONVENTIONS["paper"]
    area = pose_auc(pose_errors_deg(poses, scene.truth, convention), convention)
    registered = f"{len(poses)} of {len(scene.truth)}"
    name = scene.images.parent.name
    return (
        f"| {name} | {label} | {registered} | {percent(area)} | {seconds:.1f} | "
        f"{seconds / reference:.2f}x |"
    )


def colmap(scene: SceneFolder, output: Path) -> None:
    """Reconstruct a scene with COLMAP, and return the largest model."""
    photos = load_images(scene.images, scene.intrinsics)
    output.mkdir(parents=True)
    database = output / "database.db"
    cameras = defaultdict(list)
    for photo in photos:
        camera = photo.pinhole
        cameras[camera.fx, camera.fy, camera.cx, camera.cy].append(photo.name)
    for values, names in cameras.items():
        extract(database, scene.images, "PINHOLE", values, names)
    match(database)
    options = pycolmap.IncrementalPipelineOptions()
    options.ba_refine_focal_length = False
    options.ba_refine_extra_params = False
    models = pycolmap.incremental_mapping(database, scene.images, output, options)
    largest = max(models.values(), key=lambda model: len(reconstruction_poses(model)))
    largest.write(output)


if __name__ == "__main__":
    main()
