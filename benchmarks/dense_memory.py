"""Peak memory and CPU time of the dense stage by number of photos.

    python -m benchmarks.dense_memory [--photos 16 160] [--output FILE]

The photos are those of rendered_kitchen, with true poses and with true depth at a quarter of the
photo size. If the scene has fewer photos, its photos are used again with shifted poses. Each number
of photos runs in its own process. The table lists peak resident memory, and resident memory before
the dense stage starts.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from benchmarks._scenes import shared_folder
from benchmarks.dense import view_of
from mpsfm_core.data import DepthPrior
from mpsfm_core.dense.densify import densify
from mpsfm_core.dense.options import DenseOptions
from mpsfm_core.evaluation.prior_quality import read_depth
from mpsfm_core.evaluation.scene_folder import read_scene
from mpsfm_core.evaluation.true_surface import true_depth_file
from mpsfm_core.geometry import resize_map
from mpsfm_core.inputs.images import load_images
from mpsfm_core.inputs.options import InputOptions
from mpsfm_core.mapping.scene.reconstruction import Reconstruction, RegisteredImage
from mpsfm_core.pipeline.stages import peak_memory_mb
from mpsfm_core.support.disk_arrays import store_on_disk

_STD = 0.05
"""Relative std that is declared for the true depth maps."""
_APART = 1000.0
"""Distance in meters between two copies of the kitchen."""


def main() -> None:
    """Parse the command line and measure each number of photos in a child process."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--photos", nargs="+", type=int, default=[16, 160])
    parser.add_argument("--output", type=Path)
    parser.add_argument("--one", type=int, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.one:
        print(json.dumps(measured(arguments.one)))
        return
    lines = [
        "| photos | before, MB | peak, MB | CPU, s a photo |",
        "| ---: | ---: | ---: | ---: |",
    ]
    for count in arguments.photos:
        command = [sys.executable, "-m", "benchmarks.dense_memory", "--one", str(count)]
        row = json.loads(subprocess.run(command, check=True, stdout=subprocess.PIPE).stdout)
        lines.append(
            f"| {count} | {row['before_mb']:.0f} | {row['peak_mb']:.0f} | {row['cpu_s']:.2f} |"
        )
    text = "\n".join(lines) + "\n"
    print(text, end="")
    if arguments.output:
        arguments.output.write_text(text, encoding="utf-8")


def measured(count: int) -> dict[str, float | None]:
    """Run the dense stage on a number of photos, and measure memory and CPU time of the process."""
    scene = read_scene(shared_folder() / "data" / "rendered_kitchen")
    assert scene.depth is not None
    photos = load_images(scene.images, scene.intrinsics, None, InputOptions())
    images, original, none = [], {}, np.zeros(0, np.int64)
    while len(images) < count:
        copy = len(images) // len(photos)
        photo = photos[len(images) % len(photos)]
        rotation, translation = scene.truth[photo.name]
        depth = read_depth(true_depth_file(scene.depth, photo.name)).astype(np.float32)
        small = resize_map(depth, depth.shape[1] // 4, depth.shape[0] // 4, linear=False)
        known = DepthPrior.from_arrays(small, (_STD * small) ** 2, small > 0)
        moved = translation - rotation @ np.array([_APART * copy, 0, 0])
        name = f"{copy}/{photo.name}"
        original[name] = photo.name
        images.append(
            RegisteredImage(len(images), name, photo.pinhole, rotation, moved, none, known, 1.0)
        )
    model = Reconstruction(tuple(images), np.zeros((0, 3)), np.zeros(0))
    photo_of = view_of(photos)
    few = Reconstruction(tuple(images[:3]), model.points, model.errors_px)
    densify(few, lambda name: photo_of(original[name]), DenseOptions())  # compiles the kernels
    before, started = peak_memory_mb(), time.process_time()
    with tempfile.TemporaryDirectory() as folder, store_on_disk(Path(folder)):
        densify(model, lambda name: photo_of(original[name]), DenseOptions())
    return {
        "before_mb": before,
        "peak_mb": peak_memory_mb(),
        "cpu_s": (time.process_time() - started) / count,
    }


if __name__ == "__main__":
    main()
