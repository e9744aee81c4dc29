"""Measured memory and disk space of whole runs, compared with the estimates before each run.

    python -m benchmarks.resources [CASE ...]

The rendered photos show a synthetic hall, which gives one component, or several unconnected rooms,
one component each. Runs use SIFT with 1024 keypoints, exact depth from files, and pairs of
neighboring photos. Prints a table row for each reconstruction.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import tempfile
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from benchmarks._scenes import MPSFM
from mpsfm_core.data import Float64, PinholeCamera
from mpsfm_core.testing.synthetic.halls import make_hall
from mpsfm_core.testing.synthetic.scenes import AnalyticScene, arc_poses, room_scene

ARC_DEG = 120.0
"""Angle in degrees of the circular arc of cameras around the center of a synthetic room."""
CONFIG = """
features: {{use: sift, options: {{max_keypoints: 1024}}}}
matcher: {{use: mutual-nearest}}
depth: {{use: files, options: {{directory: {folder}/depth, relative_std: 0.02}}}}
normals: {{use: from-depth}}
pairs: {{mode: sequential, overlap: 4, quadratic: true}}
extraction: {{integration_size: {grid}}}
runtime: {{workers: {workers}, cache_dir: {folder}/cache}}
"""


@dataclass(frozen=True)
class Case:
    """Test scene: number of photos and rooms (0: a hall), size of photos and prior maps."""

    count: int
    rooms: int
    size: tuple[int, int]
    grid: int
    workers: int

    def photos(self) -> Iterable[tuple[AnalyticScene, Float64]]:
        """Return the synthetic scene and the camera pose of each photo."""
        if not self.rooms:
            poses, scene = make_hall(self.count, np.random.default_rng(0))
            yield from ((scene, pose) for pose in poses)
        for seed in range(self.rooms):
            each = self.count // self.rooms
            scene = room_scene(seed)
            yield from ((scene, pose) for pose in arc_poses(each, min(15.0, ARC_DEG / each)))


CASES = {
    "room": Case(5, 1, (320, 240), 96, 1),
    "hall": Case(60, 0, (320, 240), 160, 1),
    "large photos": Case(24, 0, (640, 480), 256, 2),
    "many photos": Case(140, 0, (320, 240), 128, 1),
    "three rooms": Case(60, 3, (320, 240), 160, 1),
}


def main() -> None:
    """Reconstruct all test scenes, and print measured and estimated memory and disk space."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("cases", nargs="*", metavar="CASE", help=", ".join(CASES))
    print("| case | groups | MB predicted, measured | results predicted, measured |")
    print("| --- | --- | --- | --- |")
    for name in parser.parse_args().cases or CASES:
        with tempfile.TemporaryDirectory() as folder:
            summary = run(CASES[name], Path(folder))
        groups = ", ".join(str(part["images"]) for part in summary["reconstructions"])
        both = [summary["resources"][key] for key in ("predicted", "measured")]
        memory, disk = (
            ", ".join(str(of[key]) for of in both) for key in ("memory_mb", "output_mb")
        )
        print(f"| {name} | {groups} | {memory} | {disk} |", flush=True)


def run(case: Case, folder: Path) -> dict:
    """Render photos and depth maps, reconstruct them in a child process, and read the summary."""
    width, height = case.size
    focal = (0.875 if case.rooms else 0.7) * width
    camera = PinholeCamera(width, height, focal, focal, width / 2, height / 2)
    for name in ("images", "depth"):
        (folder / name).mkdir()
    for number, (scene, pose) in enumerate(case.photos()):
        rendering = scene.render(camera, pose)
        cv2.imwrite(str(folder / "images" / f"{number:04d}.png"), rendering.rgb[..., ::-1])
        np.savez(folder / "depth" / f"{number:04d}.npz", depth=rendering.depth[::4, ::4])
    params = [camera.fx, camera.fy, camera.cx, camera.cy]
    (folder / "intrinsics.yaml").write_text(f"1: {{params: {params}, images: all}}\n")
    config = CONFIG.format(folder=folder, grid=case.grid, workers=case.workers)
    (folder / "config.yaml").write_text(config)
    options = {name: str(folder / f"{name}.yaml") for name in ("config", "intrinsics")}
    output = folder / "out"
    arguments = [str(folder / "images"), "--output", str(output), "--quiet"]
    arguments += [text for name, path in options.items() for text in (f"--{name}", path)]
    subprocess.run([*MPSFM, "reconstruct", *arguments], check=True, stdout=subprocess.DEVNULL)
    return json.loads((output / "summary.json").read_text(encoding="utf-8"))


if __name__ == "__main__":
    main()
