"""Memory of a process that reconstructs a tiny scene repeatedly.

    python -m benchmarks.leaks [--count 200]

Every run passes three rendered photos of a synthetic room through all stages. Results of providers
come from the cache after the first run. Prints memory, Python objects, open files and threads of
the process. The growth of memory per run is fitted to the second half of the runs. Writes
benchmarks/results/leaks.md.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np

from benchmarks._scenes import RESULTS
from mpsfm_core.config import Config, RuntimeOptions
from mpsfm_core.data import PinholeCamera
from mpsfm_core.pipeline.run import reconstruct
from mpsfm_core.providers.provider_config import ProviderConfig
from mpsfm_core.providers.registry import Registry
from mpsfm_core.testing.leak_probe import ProcessUsage, measure_usage
from mpsfm_core.testing.synthetic.scenes import arc_poses, room_scene

CAMERA = PinholeCamera(160, 120, 140.0, 140.0, 80.0, 60.0)


def main() -> None:
    """Reconstruct the scene repeatedly, and write the table of memory."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=200)
    count = parser.parse_args().count
    with tempfile.TemporaryDirectory() as folder:
        runs = measure_usage(reconstruction(Path(folder)), count)
        usage = np.fromiter(runs, np.dtype((float, len(ProcessUsage._fields))), count)
    later = np.arange(count // 2, count)
    slopes = ProcessUsage(*np.polyfit(later, usage[later], 1)[0])
    lines = [
        f"# {count} reconstructions in one process",
        "",
        f"`python -m benchmarks.leaks --count {count}`",
        "",
        f"Slopes over the second half of the runs: memory {1e3 * slopes.memory_mb:.1f} kB per run, "
        f"Python objects {slopes.objects:.2f} per run.",
        "",
        "| after run | resident MB | objects | open files | threads |",
        "| --- | --- | --- | --- | --- |",
        *(
            "| {} | {:.1f} | {:.0f} | {:.0f} | {:.0f} |".format(k + 1, *usage[k])
            for k in (0, *range(count // 10 - 1, count, count // 10))
        ),
    ]
    text = "\n".join(lines) + "\n"
    RESULTS.mkdir(exist_ok=True)
    (RESULTS / "leaks.md").write_text(text, encoding="utf-8")
    print(text)


def reconstruction(folder: Path) -> Callable[[], object]:
    """Return a function that reconstructs rendered photos of a synthetic room."""
    photos = folder / "photos"
    photos.mkdir()
    for number, pose in enumerate(arc_poses(3, 10.0)):
        picture = room_scene().render(CAMERA, pose).rgb[..., ::-1]
        cv2.imwrite(str(photos / f"{number}.png"), picture)
    (folder / "intrinsics.yaml").write_text("1: {params: [140, 140, 80, 60], images: all}\n")
    config = Config(
        features=ProviderConfig(use="sift"),
        matcher=ProviderConfig(use="mutual-nearest"),
        depth=ProviderConfig(use="flat"),
        normals=ProviderConfig(use="from-depth"),
        runtime=RuntimeOptions(cache_dir=folder / "cache", workers=1),
    )
    config = config.model_copy(
        update={"extraction": config.extraction.model_copy(update={"integration_size": 64})}
    )
    registry = Registry.discover()
    return lambda: reconstruct(
        photos,
        folder / "out",
        config,
        intrinsics=folder / "intrinsics.yaml",
        registry=registry,
    )


if __name__ == "__main__":
    main()
