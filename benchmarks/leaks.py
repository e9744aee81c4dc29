"""Memory of a process that reconstructs a tiny scene again and again.

    python -m benchmarks.leaks [--count 200]

Three photos of an analytic room, all stages, results written anew each time; what providers give
comes from the cache after the first. Prints resident memory as runs go on, and how it grows from
the first quarter of the runs on. Writes benchmarks/results/leaks.md.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import psutil

from benchmarks._scenes import RESULTS
from mpsfm_core.config import Config, RuntimeOptions
from mpsfm_core.data import PinholeCamera
from mpsfm_core.options import Backend
from mpsfm_core.pipeline import reconstruct
from mpsfm_core.registry import Registry
from mpsfm_core.testing.scenes import arc_poses, room_scene

CAMERA = PinholeCamera(160, 120, 140.0, 140.0, 80.0, 60.0)


def main() -> None:
    """Reconstruct, and write the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=200)
    count = parser.parse_args().count
    with tempfile.TemporaryDirectory() as folder:
        resident = np.array(list(memory_of_runs(Path(folder), count)))
    settled = np.arange(count // 4, count)
    slope = np.polyfit(settled, resident[settled], 1)[0]
    lines = [
        f"# Memory of {count} reconstructions in one process",
        "",
        f"`python -m benchmarks.leaks --count {count}`",
        "",
        f"From run {settled[0] + 1} on memory grows by {1000 * slope:.0f} kB a run.",
        "",
        "| after run | resident MB |",
        "| --- | --- |",
        *(f"| {k + 1} | {resident[k]:.1f} |" for k in range(0, count, max(1, count // 10))),
    ]
    text = "\n".join(lines) + "\n"
    RESULTS.mkdir(exist_ok=True)
    (RESULTS / "leaks.md").write_text(text, encoding="utf-8")
    print(text)


def memory_of_runs(folder: Path, count: int) -> Iterator[float]:
    """Resident memory after each run, MB."""
    photos = folder / "photos"
    photos.mkdir()
    for number, pose in enumerate(arc_poses(3, 10.0)):
        picture = room_scene().render(CAMERA, pose).rgb[..., ::-1]
        cv2.imwrite(str(photos / f"{number}.png"), picture)
    (folder / "intrinsics.yaml").write_text("1: {params: [140, 140, 80, 60], images: all}\n")
    config = Config(
        features=Backend(use="sift"),
        matcher=Backend(use="mutual-nearest"),
        depth=Backend(use="flat"),
        normals=Backend(use="from-depth"),
        runtime=RuntimeOptions(cache_dir=folder / "cache", workers=1),
    )
    config = config.model_copy(
        update={"extraction": config.extraction.model_copy(update={"integration_size": 64})}
    )
    registry, process = Registry.discover(), psutil.Process()
    for _ in range(count):
        reconstruct(
            photos,
            folder / "out",
            config,
            intrinsics=folder / "intrinsics.yaml",
            registry=registry,
        )
        yield process.memory_info().rss / 1e6


if __name__ == "__main__":
    main()
