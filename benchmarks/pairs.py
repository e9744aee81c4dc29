"""Which true pairs of photos ``pairs.mode: auto`` finds, how many it proposes, and its time.

    python -m benchmarks.pairs [--scenes rendered_kitchen ...] [--output DIR]

The real scenes are those in $MPSFM_SHARED or ../shared, with XFeat as in `fast-cpu`; `hall` is an
analytic one of 200 views, with random descriptors of surface points that each view finds again
with some noise, as many again that are its own. A pair is true when its views overlap by more than
a limit (mpsfm_core/evaluation/overlap.py). *Matched*: by 0.15, and verified with a rotation within
10 degrees of the truth when it is given to LighterGlue; on real photos these are the pairs that a
reconstruction can miss. Writes benchmarks/results/pairs.md.
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Sequence
from itertools import combinations
from pathlib import Path
from typing import NamedTuple

import numpy as np

from benchmarks._scenes import RESULTS, shared_folder
from mpsfm_core.config import load_config
from mpsfm_core.data import Float32, Float64, PinholeCamera
from mpsfm_core.evaluation.overlap import overlap_from_depth
from mpsfm_core.evaluation.prior_quality import read_depth
from mpsfm_core.evaluation.scene_folder import read_scene
from mpsfm_core.extraction import first_look
from mpsfm_core.extraction.events import Silent
from mpsfm_core.extraction.features import FeatureTable
from mpsfm_core.extraction.matching import PairMatcher, PairVerifier
from mpsfm_core.extraction.options import PairOptions
from mpsfm_core.extraction.pairs import Pair, most_alike, neighbours
from mpsfm_core.extraction.workbench import Workbench
from mpsfm_core.inputs.images import load_images
from mpsfm_core.registry import Registry
from mpsfm_core.testing.scenes import AnalyticScene, Box, Texture, look_at

SCENES = ("rendered_kitchen", "hololens_room", "hall")
OVERLAPS = (0.1, 0.25, 0.4)
MATCHED_OVERLAP = 0.15
RIGHT_DEG = 10.0
VIEWS = 200
HALL = (12.0, 8.0, 2.5)
"""Half its size in metres."""
CAMERA = PinholeCamera(160, 120, 130.0, 130.0, 80.0, 60.0)


class Case(NamedTuple):
    """``overlap``: (n, n). ``matched``: those of the true pairs that can be matched, if known."""

    names: Sequence[str]
    descriptors: Sequence[Float32]
    overlap: Float64
    matched: Sequence[Pair]


def main() -> None:
    """Run the scenes and write the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", nargs="+", default=list(SCENES), choices=SCENES)
    parser.add_argument("--output", type=Path, default=Path("build/benchmarks"))
    arguments = parser.parse_args()
    limits = " | ".join(f"overlap > {limit}" for limit in OVERLAPS)
    lines = [
        f"| scene | photos | pairs a photo | of all pairs | {limits} | matched | CPU seconds |",
        "|---" * (len(OVERLAPS) + 6) + "|",
    ]
    for name in arguments.scenes:
        case = _hall() if name == "hall" else _real(name, arguments.output / "pairs")
        lines.append(_row(name, case))
        print(lines[-1], flush=True)
    text = "# Pairs found by a first look\n\nRecall of true pairs.\n\n" + "\n".join(lines) + "\n"
    RESULTS.mkdir(exist_ok=True)
    (RESULTS / "pairs.md").write_text(text, encoding="utf-8")
    print(text)


def _row(name: str, case: Case) -> str:
    started = time.process_time()
    count, options = len(case.names), PairOptions()
    found = np.zeros((count, count))
    for a, b in combinations(range(count), 2):
        found[a, b] = found[b, a] = first_look.evidence(case.descriptors[a], case.descriptors[b])
    alike = most_alike(first_look.likeness(found), options.partners)
    chosen = {*alike, *neighbours(case.names, options)}
    seconds = time.process_time() - started
    recalls = []
    for limit in OVERLAPS:
        true = [pair for pair in combinations(range(count), 2) if case.overlap[pair] > limit]
        recalls.append(_recall(chosen, true))
    cells = [
        name,
        str(count),
        f"{len(chosen) / count:.1f}",
        f"{100 * len(chosen) / math.comb(count, 2):.0f} %",
        *recalls,
        _recall(chosen, case.matched),
        f"{seconds:.1f}",
    ]
    return f"| {' | '.join(cells)} |"


def _recall(chosen: set[Pair], true: Sequence[Pair]) -> str:
    if not true:
        return "-"
    return f"{100 * sum(pair in chosen for pair in true) / len(true):.1f} % of {len(true)}"


def _real(name: str, output: Path) -> Case:
    scene = read_scene(shared_folder() / "data" / name, with_sets=False)
    images = load_images(scene.images, scene.intrinsics)
    names = images.names
    depth = shared_folder() / "data" / name / "gt_depth"
    overlap = overlap_from_depth(
        names,
        scene.truth,
        {image.name: image.pinhole for image in images},
        lambda image: read_depth(depth / Path(image).with_suffix(".png")),
    ).two_view
    config = load_config("fast-cpu", [f"runtime.cache_dir={output}"])
    bench = Workbench(images, config, Registry.discover(), Silent())
    assert config.features is not None
    table = FeatureTable(bench, config.features)
    located = table.extract()
    true = [p for p in combinations(range(len(names)), 2) if overlap[p] > MATCHED_OVERLAP]
    candidates = PairMatcher(bench, table).match(true, located)
    outcomes = PairVerifier(bench, located).verify(candidates)
    matched = []
    for (a, b), outcome in zip(true, outcomes, strict=True):
        rotation = scene.truth[names[b]][0] @ scene.truth[names[a]][0].T
        cosine = (np.trace(outcome.rotation @ rotation.T) - 1) / 2
        if not outcome.reason and cosine > math.cos(math.radians(RIGHT_DEG)):
            matched.append((a, b))
    descriptors = [first_look.strongest(table[index]) for index in range(len(names))]
    return Case(names, descriptors, overlap, matched)


def _hall(seed: int = 0) -> Case:
    """Views at eye level everywhere in a hall with pillars and boxes, looking anywhere."""
    rng = np.random.default_rng(seed)
    boxes = [
        Box((x, y, 0.8), (0.6, 0.6, 0.8), yaw_deg=float(rng.uniform(0, 90)))
        for x in (-8.0, -4.0, 0.0, 4.0, 8.0)
        for y in (-4.5, 0.0, 4.5)
    ]
    scene = AnalyticScene((Box((0.0, 0.0, HALL[2]), HALL), *boxes), Texture(seed=seed))
    poses = []
    while len(poses) < VIEWS:
        eye = rng.uniform((-11, -7, 1.4), (11, 7, 1.8))
        if all(np.hypot(*(eye[:2] - box.center[:2])) > 1.5 for box in boxes):
            turn = rng.uniform(0, 2 * np.pi)
            toward = np.array([np.cos(turn), np.sin(turn), rng.uniform(-0.2, 0.1)])
            poses.append(look_at(eye, eye + toward))
    names = [f"{number:03d}.png" for number in rng.permutation(VIEWS)]
    depths = {
        name: scene.render(CAMERA, pose).depth for name, pose in zip(names, poses, strict=True)
    }
    truth = {name: (pose[:, :3], pose[:, 3]) for name, pose in zip(names, poses, strict=True)}
    overlap = overlap_from_depth(names, truth, dict.fromkeys(names, CAMERA), depths.__getitem__)
    return Case(names, _descriptors(scene, poses, rng), overlap.two_view, ())


def _descriptors(
    scene: AnalyticScene, poses: Sequence[Float64], rng: np.random.Generator
) -> list[Float32]:
    """Of points on all surfaces, each with a random unit vector; a view finds half of those it
    sees, with noise as long as half of the vector, and as many that nobody else finds."""
    size = np.array(CAMERA.size, dtype=np.float64)
    points = [scene.sample(CAMERA, pose, rng.uniform(0, 1, (60, 2)) * size) for pose in poses]
    world = np.concatenate([sample.points[sample.valid] for sample in points])
    vectors = _unit(rng.normal(size=(len(world), 64)))
    found = []
    for pose in poses:
        rows = rng.permutation(_visible(scene, pose, world))
        rows = rows[rng.uniform(size=len(rows)) < 0.5][: first_look.STRONGEST // 2]
        noise = 0.5 * _unit(rng.normal(size=(len(rows), 64)))
        own = rng.normal(size=(max(len(rows), 50), 64))
        found.append(np.concatenate([_unit(vectors[rows] + noise), _unit(own)]).astype(np.float32))
    return found


def _visible(scene: AnalyticScene, pose: Float64, world: Float64) -> np.ndarray:
    local = world @ pose[:, :3].T + pose[:, 3]
    xy = local[:, :2] / np.maximum(local[:, 2:], 1e-6) * CAMERA.fx + np.array(CAMERA.size) / 2
    inside = (local[:, 2] > 0.1) & ((xy > 0) & (xy < CAMERA.size)).all(axis=1)
    center = -pose[:, :3].T @ pose[:, 3]
    rows = np.flatnonzero(inside)
    distance, _, _ = scene.first_hit(center, world[rows] - center)
    return rows[np.abs(distance - 1) < 1e-6]


def _unit(vectors: Float64) -> Float64:
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


if __name__ == "__main__":
    main()
