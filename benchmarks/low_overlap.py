"""Accuracy on low-overlap photos with SIFT, with matching networks, and with both in turn.

    python -m benchmarks.low_overlap [--scenes rendered_kitchen ...] [--buckets minimal ...]

Compares the configurations `fast-cpu`, `fast-cpu` without the preceding SIFT pass (``fast_pass:
null``), and `sift`. The measure is the mean pose AUC over the test sets of each bucket in percent,
convention `paper`. A test set without a reconstruction counts as zero registered images. Seconds
are wall times of whole runs, with features and depth from the cache.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Mapping, Sequence
from itertools import groupby
from operator import attrgetter
from pathlib import Path

import numpy as np

from benchmarks._scenes import percent, shared_folder
from mpsfm_core.data import Pose
from mpsfm_core.data.errors import ReconstructionError
from mpsfm_core.evaluation.pose_auc import CONVENTIONS, pose_auc, pose_errors_deg
from mpsfm_core.evaluation.scene_folder import SceneFolder, read_scene
from mpsfm_core.pipeline.run import reconstruct

SCENES = ("rendered_kitchen", "hololens_room")
METHODS: Mapping[str, tuple[str, tuple[str, ...]]] = {
    "`fast-cpu`": ("fast-cpu", ()),
    "without fast pass": ("fast-cpu", ("fast_pass=null",)),
    "`sift`": ("sift", ()),
}
"""Configuration and additional settings, by the label in the table."""
CONVENTION = CONVENTIONS["paper"]


def main() -> None:
    """Parse the command line, reconstruct the test sets, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--scenes", nargs="+", default=list(SCENES), choices=SCENES)
    parser.add_argument("--buckets", nargs="+", help="default: all of a scene")
    parser.add_argument("--cache", type=Path, default=Path("build/benchmarks/low_overlap"))
    arguments = parser.parse_args()
    print("| scene | bucket | method | registered | AUC@1/5/20 | s |")
    print("| --- | --- | --- | ---: | ---: | ---: |")
    for name in arguments.scenes:
        scene = read_scene(shared_folder() / "data" / name)
        for bucket, chosen in groupby(scene.select_sets(arguments.buckets), attrgetter("bucket")):
            sets = [image_set.images for image_set in chosen]
            for method in METHODS:
                print(row(scene, bucket, sets, method, arguments.cache), flush=True)


def row(
    scene: SceneFolder, bucket: str, sets: Sequence[Sequence[str]], method: str, cache: Path
) -> str:
    """Format registered images, pose AUC and time of a bucket and configuration as a table row."""
    started, registered, areas = time.perf_counter(), 0, []
    for names in sets:
        poses = found(scene, names, method, cache)
        registered += len(poses)
        errors = pose_errors_deg(poses, {name: scene.truth[name] for name in names}, CONVENTION)
        areas.append(pose_auc(errors, CONVENTION))
    mean: dict[float, float] = {
        limit: float(np.mean([area[limit] for area in areas])) for limit in areas[0]
    }
    seconds = time.perf_counter() - started
    return (
        f"| {scene.images.parent.name} | {bucket} | {method} | "
        f"{registered} of {sum(map(len, sets))} | {percent(mean)} | {seconds:.0f} |"
    )


def found(scene: SceneFolder, names: Sequence[str], method: str, cache: Path) -> Mapping[str, Pose]:
    """Reconstruct a test set, and return the poses of the largest component."""
    config, settings = METHODS[method]
    overrides = ("dense.enabled=false", f"runtime.cache_dir={cache}", *settings)
    with tempfile.NamedTemporaryFile("w", suffix=".txt") as listed:
        listed.write("\n".join(names))
        listed.flush()
        try:
            result = reconstruct(
                scene.images,
                None,
                config,
                intrinsics=scene.intrinsics,
                image_list=Path(listed.name),
                overrides=overrides,
            )
        except ReconstructionError:
            return {}
    return result.mapping.reconstructions[0].poses


if __name__ == "__main__":
    main()
