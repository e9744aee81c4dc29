"""Mapping of many images in one piece and in overlapping parts, and COLMAP's mappers.

    python -m benchmarks.scale [--scene hall] [--views 200 500 ...] [--methods NAME ...]
        [--part-images 100] [--joins 20] [--folder build/benchmarks/scale] [--output FILE]

The first table maps synthetic halls (:mod:`mpsfm_core.testing.synthetic.halls`), or cities with a
grid of streets (:mod:`mpsfm_core.testing.synthetic.streets`), with calibrated depth priors, 5 %
wrong matches in each pair, and 1 % of pairs between distant views that look alike. Each run has its
own process with one thread, which loads compiled code before timing starts. CPU time includes the
depth maps of our mapper, and the Dask workers, which load compiled code within that time. Memory is
the peak of the first process without pages of mapped files, sampled ten times a second, and the
peak of the largest worker with these pages. As in a run, the maps of many images are in mapped
files. Results are kept in ``--folder``, so that an interrupted benchmark continues.

The second table joins two parts of twin rooms (:mod:`mpsfm_core.testing.synthetic.two_rooms`) at
given poses. A true join has common images in the corridor. In a false join, some images of the
second room have also poses in the first room, where the same furniture stands.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import resource
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import psutil

from benchmarks._scenes import percent
from benchmarks.everyday import CONVENTION
from mpsfm_core.config import RuntimeOptions
from mpsfm_core.data import MappingProblem, Pose, VerifiedPair
from mpsfm_core.evaluation.methods import initialize_process
from mpsfm_core.evaluation.peers import PEERS, run_peer
from mpsfm_core.evaluation.pose_auc import pose_auc, pose_errors_deg
from mpsfm_core.mapping import mapper
from mpsfm_core.mapping.options import MapperOptions
from mpsfm_core.mapping.parts import part_mapping
from mpsfm_core.mapping.parts.joining import join_reconstructions
from mpsfm_core.mapping.problem_state import problem_from_state, problem_to_state
from mpsfm_core.mapping.scene.reconstruction import Reconstruction, compute_depth_maps
from mpsfm_core.mapping.state import flatten_state, unflatten_state
from mpsfm_core.pipeline.parts import PartMapper
from mpsfm_core.pipeline.stages import Stages
from mpsfm_core.providers.registry import Registry
from mpsfm_core.support.disk_arrays import store_on_disk
from mpsfm_core.support.npz import read_npz
from mpsfm_core.support.threads import limit_threads
from mpsfm_core.testing.synthetic.degraded_depth import DepthErrors
from mpsfm_core.testing.synthetic.halls import (
    CALIBRATED_PRIORS,
    HallProblem,
    PriorErrors,
    make_hall_problem,
)
from mpsfm_core.testing.synthetic.streets import make_street_problem
from mpsfm_core.testing.synthetic.two_rooms import (
    SymmetricProblem,
    make_twin_room_problem,
    shift_pose,
)

ONE_PIECE, IN_PARTS = "ours, one piece", "ours, in parts"
WORKERS = {f"{IN_PARTS}, 1 Dask worker": 1, f"{IN_PARTS}, 2 Dask workers": 2}
METHODS = (ONE_PIECE, IN_PARTS, *WORKERS, "colmap", "colmap-hierarchical", "colmap-global")
SCENES: Mapping[str, Callable[[int, PriorErrors], HallProblem]] = {
    "hall": make_hall_problem,
    "streets": make_street_problem,
}
LOOK_ALIKE_RATIO = 0.01
"""Number of added false pairs, relative to the number of pairs."""
MIN_DISTANCE = 4
"""Smallest distance between views that look alike, in views of a row of the hall."""


def main() -> None:
    """Parse the command line, run all methods that have no result yet, and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--scene", choices=list(SCENES), default="hall")
    parser.add_argument("--views", type=int, nargs="*", default=[200, 500])
    parser.add_argument("--methods", nargs="+", choices=METHODS, default=list(METHODS))
    parser.add_argument("--part-images", type=int, default=100)
    parser.add_argument("--joins", type=int, default=20, help="number of twin rooms")
    parser.add_argument("--folder", type=Path, default=Path("build/benchmarks/scale"))
    parser.add_argument("--output", type=Path, help="also write the tables to this file")
    arguments = parser.parse_args()
    rows = []
    for views in arguments.views:
        for method in arguments.methods:
            scene = store_scene(arguments.scene, views, arguments.folder)
            rows.append(_measure(scene, views, method, arguments.part_images))
    text = f"{_table(rows)}\n\n{_count_joins(arguments.joins)}\n"
    print(text)
    if arguments.output:
        arguments.output.write_text(text, encoding="utf-8")


def add_look_alike_pairs(hall: HallProblem, seed: int = 0) -> MappingProblem:
    """Add pairs of distant views, of which one seems to be a neighbor of the other.

    The second view gets the keypoints of a true neighbor of the first view, so matches and relative
    pose are those of the true pair.
    """
    rng = np.random.default_rng([seed, 2])
    images, pairs = list(hall.problem.images), list(hall.problem.pairs)
    matched = {(pair.image_a, pair.image_b) for pair in pairs}
    side = int(np.ceil(np.sqrt(len(images))))
    for row in rng.choice(len(pairs), round(LOOK_ALIKE_RATIO * len(pairs)), replace=False):
        pair = pairs[row]
        distant = np.arange(pair.image_a + MIN_DISTANCE * side, len(images))
        if not len(distant):
            continue
        view = int(rng.choice(distant))
        if (pair.image_a, view) in matched:
            continue
        matched.add((pair.image_a, view))
        xy = images[pair.image_b].keypoints[pair.matches[:, 1]]
        noise = images[view].keypoint_std_px * rng.normal(size=xy.shape)
        first = len(images[view].keypoints)
        images[view] = replace(
            images[view], keypoints=np.concatenate([images[view].keypoints, xy + noise])
        )
        matches = np.column_stack([pair.matches[:, 0], first + np.arange(len(xy))])
        pairs.append(
            VerifiedPair(pair.image_a, view, matches, pair.scores, pair.rotation, pair.translation)
        )
    return MappingProblem(tuple(images), tuple(pairs))


def _measure(scene: Path, views: int, method: str, part_images: int) -> dict[str, Any]:
    """Map a synthetic scene with one mapper in a new process, or load its stored result."""
    name = f"{scene.stem}-{method}" + (f"-{part_images}" if method.startswith(IN_PARTS) else "")
    path = scene.with_name(f"{name.replace(' ', '_')}.json")
    if not path.exists():
        context = multiprocessing.get_context("spawn")
        process = context.Process(target=_run, args=(scene, method, part_images, path))
        process.start()
        process.join()
        print(f"{name}: exit code {process.exitcode}", file=sys.stderr)
    row: dict[str, Any] = {"views": views, "method": method}
    return row | (json.loads(path.read_text(encoding="utf-8")) if path.exists() else {})


def store_scene(scene: str, views: int, folder: Path) -> Path:
    """Return the path of the file of a scene, which is written if it does not exist."""
    path = folder / f"{scene}-{views}.npz"
    if not path.exists():
        folder.mkdir(parents=True, exist_ok=True)
        made = SCENES[scene](views, CALIBRATED_PRIORS)
        problem = problem_to_state(add_look_alike_pairs(made))
        state: Any = flatten_state({"problem": problem, "truth": dict(made.truth)})
        np.savez(path, **state)
    return path


def _run(scene: Path, method: str, part_images: int, path: Path) -> None:
    """Map a scene, and write result, time and memory."""
    with limit_threads(1), store_on_disk(path.parent):
        state = unflatten_state(read_npz(scene))
        problem = problem_from_state(state["problem"])
        truth = {name: (rotation, shift) for name, (rotation, shift) in state["truth"].items()}
        del state
        initialize_process()
        started, cpu_started = time.perf_counter(), _cpu_seconds()
        with watch_memory() as peaks_mib:
            models, worker_mib = _map(problem, method, part_images)
    seconds, cpu_seconds = time.perf_counter() - started, _cpu_seconds() - cpu_started
    largest = models[0] if models else {}
    errors = pose_errors_deg(largest, truth, CONVENTION)
    row = {
        "registered": len(largest),
        "models": len(models),
        "auc": percent(pose_auc(errors, CONVENTION)),
        "seconds": seconds,
        "cpu_seconds": cpu_seconds,
        "peak_mib": max(peaks_mib),
        "worker_mib": worker_mib,
    }
    path.write_text(json.dumps(row), encoding="utf-8")


@contextmanager
def watch_memory() -> Iterator[list[float]]:
    """Sample the resident memory of this process without mapped files, in MiB."""
    samples: list[float] = []
    ended = threading.Event()

    def sample() -> None:
        while not ended.wait(0.1):
            memory = psutil.Process().memory_info()
            samples.append((memory.rss - memory.shared) / 2**20)

    thread = threading.Thread(target=sample)
    thread.start()
    try:
        yield samples
    finally:
        ended.set()
        thread.join()


def _map(
    problem: MappingProblem, method: str, part_images: int
) -> tuple[list[Mapping[str, Pose]], float]:
    """Return the poses of each model, the largest first, and the peak memory of workers in MiB."""
    if method in PEERS:
        return list(run_peer(method, problem)), 0.0
    options = MapperOptions(parts=None if method == ONE_PIECE else part_images)
    worker_mib = 0.0
    with tempfile.TemporaryDirectory(prefix="mpsfm-scale-") as cache:
        part_mapper = None
        if method in WORKERS:
            runtime = RuntimeOptions(
                cache_dir=Path(cache),
                workers=1,
                executor="dask",
                executor_options={"workers": WORKERS[method]},
            )
            part_mapper = PartMapper(runtime, Registry.discover(), Stages(Registry()))
        result = part_mapping.reconstruct(problem, options, map_parts=part_mapper)
        models = compute_depth_maps(result.reconstructions)
        if part_mapper is not None:
            worker_mib = max(record.peak_memory_mb or 0.0 for record in part_mapper.records)
    return [model.poses for model in models], worker_mib


def _cpu_seconds() -> float:
    """Return the CPU time of this process and of its finished child processes."""
    kinds = (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)
    usages = [resource.getrusage(kind) for kind in kinds]
    return sum(usage.ru_utime + usage.ru_stime for usage in usages)


def _table(rows: Sequence[Mapping[str, Any]]) -> str:
    """Format a table row for each run, with CPU time relative to mapping in one piece."""
    lines = [
        "| views | method | registered | AUC@1/5/20 | wall, s | CPU, s | CPU / one piece | "
        "memory, MiB | worker, MiB |",
        "|---" * 9 + "|",
    ]
    whole = {row["views"]: row.get("cpu_seconds") for row in rows if row["method"] == ONE_PIECE}
    for row in rows:
        if "seconds" not in row:
            lines.append(f"| {row['views']} | {row['method']} | failed |" + " |" * 6)
            continue
        base = whole.get(row["views"])
        ratio = f"{row['cpu_seconds'] / base:.2f}x" if base else ""
        worker = f"{row['worker_mib']:.0f}" if row["method"] in WORKERS else ""
        lines.append(
            f"| {row['views']} | {row['method']} | {row['registered']} | {row['auc']} | "
            f"{row['seconds']:.1f} | {row['cpu_seconds']:.1f} | {ratio} | "
            f"{row['peak_mib']:.0f} | {worker} |"
        )
    return "\n".join(lines)


def _count_joins(num_rooms: int) -> str:
    """Count the accepted true joins and the refused false joins of rooms that look alike.

    Args:
        num_rooms: Number of scenes with two rooms that look alike.

    Returns:
        Table in Markdown.
    """
    lines = ["| depth priors | true joins made | false joins refused |", "|---|---|---|"]
    for name, errors in (("exact", None), ("5 % + 5 % scale", DepthErrors())):
        made, refused = 0, 0
        for seed in range(num_rooms):
            case = make_twin_room_problem(seed, errors=errors)
            made += _joins(case, *_true_parts(case))
            refused += not _joins(case, *_false_parts(case, num_common=3 + seed % 4))
        lines.append(f"| {name} | {made} of {num_rooms} | {refused} of {num_rooms} |")
    return "\n".join(lines)


Poses = dict[int, np.ndarray[Any, np.dtype[np.float64]]]
"""Poses ``cam_from_world`` (3, 4) by image index."""


def _true_parts(case: SymmetricProblem) -> tuple[Poses, Poses]:
    """Return the poses of two parts that both have the images of the corridor."""
    rooms = list(enumerate(case.room))
    return (
        {image: case.poses[image] for image, room in rooms if room <= 0},
        {image: case.poses[image] for image, room in rooms if room != 0},
    )


def _false_parts(case: SymmetricProblem, num_common: int) -> tuple[Poses, Poses]:
    """Return the poses of both rooms, the first with some images of the second room."""
    first, second = (
        {image: case.poses[image] for image, room in enumerate(case.room) if room == number}
        for number in (0, 1)
    )
    moved = {image: shift_pose(second[image], 1) for image in list(second)[:num_common]}
    return first | moved, second


def _joins(case: SymmetricProblem, first: Poses, second: Poses) -> bool:
    """Map two parts with fixed poses, and return True if the reconstructions are joined."""
    models = [_map_at_poses(case.problem, poses) for poses in (first, second)]
    return len(join_reconstructions(case.problem, models, MapperOptions())) == 1


def _map_at_poses(problem: MappingProblem, poses: Poses) -> Reconstruction:
    images = sorted(poses)
    known = {problem.images[i].name: (poses[i][:, :3], poses[i][:, 3]) for i in images}
    part = problem.subset(list(known)).with_poses(known)
    model = mapper.reconstruct(part, MapperOptions(known_poses="fixed")).reconstructions[0]
    registered = tuple(replace(image, index=images[image.index]) for image in model.images)
    return replace(model, images=registered)


if __name__ == "__main__":
    main()
