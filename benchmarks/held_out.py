"""Similarity of held-out photos and renderings of dense clouds and meshes, for real photos.

    python -m benchmarks.held_out [--sets lund_door ...] [--config fast-cpu] [--output DIR]
        [--without-validity]

Each set is reconstructed with every fifth photo held out: the mapper registers the photo, and the
stage ``dense`` does not use it. ``mpsfm mesh`` meshes the depth maps, and COLMAP's Poisson meshing
meshes the fused cloud. Cloud and meshes are rendered at the poses of the held-out photos. Finished
reconstructions in the output folder are reused. With ``--without-validity``, the stage ``dense``
keeps the pixels that match no other view or are next to a depth edge, and there is no Poisson mesh.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import Any

import pycolmap

import mpsfm_core as mpsfm
from benchmarks._scenes import shared_folder
from mpsfm_core.config.model import Config
from mpsfm_core.data.result_layout import DENSE, MESH_GLB, SUMMARY
from mpsfm_core.pipeline.dense_models import mesh_model
from mpsfm_core.results.held_out import evaluate_held_out

SETS = {
    "lund_door": "photos/lund_door",
    "mobilebrick": "photos/mobilebrick",
    "sacre_coeur": "photos/sacre_coeur",
    "seneca": "photos/seneca",
    "fountain": "data/fountain/images",
    "hololens_room": "data/hololens_room/images",
}
"""Folder of the photos of each set, relative to the folder of benchmark data."""
HOLD_OUT_EVERY = 5
POISSON = "poisson.ply"
POISSON_DEPTH, POISSON_TRIM = 9, 6.0
"""Depth of the octree, and the depth below which surfaces are removed; COLMAP's defaults of 13 and
10 take more than five minutes on two cores."""
METRICS = ("covered", "psnr", "ssim", "depth_close")


def main() -> None:
    """Parse the command line, and print a table with one row per photo set and cloud or mesh."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--sets", nargs="+", default=list(SETS), choices=SETS, metavar="SET")
    parser.add_argument("--config", default="fast-cpu")
    parser.add_argument("--output", type=Path, default=Path("build/benchmarks/held_out"))
    parser.add_argument("--without-validity", action="store_true")
    arguments = parser.parse_args()
    settings = [
        f"dense.hold_out_every={HOLD_OUT_EVERY}",
        f"dense.check_validity={not arguments.without_validity}",
    ]
    config = mpsfm.load_config(arguments.config, settings)
    print("| set | photos | geometry | covered, % | PSNR, dB | SSIM | depth within 5 %, % | s |")
    print("| --- | ---: | --- | ---: | ---: | ---: | ---: | ---: |")
    for name in arguments.sets:
        for row in evaluate_set(name, config, arguments.output / name):
            print("| " + " | ".join(row) + " |", flush=True)


def evaluate_set(name: str, config: Config, folder: Path) -> list[list[str]]:
    """Reconstruct and mesh one set, and return the cells of one table row per geometry."""
    if not (folder / SUMMARY).is_file():
        mpsfm.reconstruct(shared_folder() / SETS[name], folder, config)
    started = time.monotonic()
    if not (folder / MESH_GLB).is_file():
        mesh_model(folder)
    meshed = time.monotonic()
    if config.dense.check_validity and not (folder / POISSON).is_file():
        options = pycolmap.PoissonMeshingOptions()
        options.depth, options.trim = POISSON_DEPTH, POISSON_TRIM
        pycolmap.poisson_meshing(folder / DENSE, folder / POISSON, options)
    seconds = {"mesh.obj": meshed - started, POISSON: time.monotonic() - meshed}
    report = evaluate_held_out(folder)
    geometries: dict[str, Any] = dict(report["geometries"])
    if (folder / POISSON).is_file():
        poisson = evaluate_held_out(folder, names=report["images"], geometry=folder / POISSON)
        geometries |= poisson["geometries"]
    rows = []
    for file, values in geometries.items():
        metrics = [values[metric] for metric in METRICS]
        factors = (100, 1, 1, 100)
        cells = [
            "" if value is None else f"{factor * value:.{2 if metric == 'ssim' else 1}f}"
            for value, factor, metric in zip(metrics, factors, METRICS, strict=True)
        ]
        time_cell = f"{seconds[file]:.0f}" if file in seconds else ""
        rows.append([name, str(len(report["images"])), file, *cells, time_cell])
    return rows


if __name__ == "__main__":
    main()
