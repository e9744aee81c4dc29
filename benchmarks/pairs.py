"""Recall, number and time of the image pairs that ``pairs.mode: auto`` selects.

    python -m benchmarks.pairs [--scenes rendered_kitchen ...] [--output DIR]

Photos of real scenes are in $MPSFM_SHARED or ../shared; features are XFeat as in `fast-cpu`. The
scene `hall` is a synthetic hall of 200 views (mpsfm_core/testing/synthetic/halls.py) with random
descriptors. Each view of the hall detects half of its points, and as many outliers. The norm of the
descriptor noise is half the norm of a descriptor. At most a quarter of the keypoints are
repeatable, as for XFeat on rendered_kitchen (18 to 25 %).

A pair is true if its two-view overlap (mpsfm_core/evaluation/overlap.py) is above a limit. The
column *matched* counts true pairs that can contribute to a reconstruction. A real pair counts as
matched if its overlap is at least 0.15 and its verified LighterGlue matches give a rotation error
below 10 degrees. A pair of the hall counts as matched if it has 30 common points with similar
descriptors.

A second table has the share of true pairs among the candidate pairs, whose match scores are
computed. The images of the table are synthetic: each image along a street shares 7/8 of its
repeatable descriptors with the next image, 6/8 with the image after it, and so on. Half of the
descriptors of an image are repeatable. Writes benchmarks/results/pairs.md.
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
from mpsfm_core.data import Float32, Float64
from mpsfm_core.evaluation.overlap import overlap_from_depth
from mpsfm_core.evaluation.prior_quality import read_depth
from mpsfm_core.evaluation.scene_folder import read_scene
from mpsfm_core.extraction.context import ExtractionContext
from mpsfm_core.extraction.events import NullExtractionEvents
from mpsfm_core.extraction.features import FeatureTable
from mpsfm_core.extraction.matching.pair_matching import PairMatcher, PairVerifier
from mpsfm_core.extraction.options import PairOptions
from mpsfm_core.extraction.pairs import similarity as pair_similarity
from mpsfm_core.extraction.pairs.pairing import Pair, most_similar_pairs, numbered_neighbor_pairs
from mpsfm_core.extraction.pairs.similarity import PairSimilarity
from mpsfm_core.inputs.images import load_images
from mpsfm_core.providers.registry import Registry
from mpsfm_core.testing.synthetic.halls import make_hall_problem

SCENES = ("rendered_kitchen", "hololens_room", "hall")
OVERLAPS = (0.1, 0.25, 0.4)
MATCHED_OVERLAP = 0.15
RIGHT_DEG = 10.0
VIEWS = 200
STREETS = (1000, 4000, 10000)
_STEP = pair_similarity.NUM_DESCRIPTORS // 16
"""Number of repeatable descriptors of an image along a street that the next image does not have."""


class Case(NamedTuple):
    """Scene with descriptors, pairwise two-view overlap (n, n), and pairs that can be matched."""

    names: Sequence[str]
    descriptors: Sequence[Float32]
    overlap: Float64
    matched: Sequence[Pair]


def main() -> None:
    """Select the pairs of each scene, and write the table of recall."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", nargs="+", default=list(SCENES), choices=SCENES)
    parser.add_argument("--output", type=Path, default=Path("build/benchmarks"))
    arguments = parser.parse_args()
    limits = " | ".join(f"overlap > {limit}" for limit in OVERLAPS)
    lines = [
        f"| scene | photos | pairs per photo | of all pairs | {limits} | matched | CPU seconds |",
        "|---" * (len(OVERLAPS) + 6) + "|",
    ]
    for name in arguments.scenes:
        case = _hall() if name == "hall" else _real(name, arguments.output / "pairs")
        lines.append(_row(name, case))
        print(lines[-1], flush=True)
    lines += [
        "",
        f"The table lists which share of the pairs with at least {6 * _STEP} or {_STEP} common "
        "points is among the candidate pairs. The images are synthetic views along a street with "
        f"{16 * _STEP} descriptors each.",
        "",
        f"| images | candidate pairs per image | {6 * _STEP} common points | {_STEP} common points "
        "| CPU seconds |",
        "|---" * 5 + "|",
    ]
    lines += [_candidate_row(count) for count in STREETS]
    text = "# Recall of `pairs.mode: auto`\n\n" + "\n".join(lines) + "\n"
    RESULTS.mkdir(exist_ok=True)
    (RESULTS / "pairs.md").write_text(text, encoding="utf-8")
    print(text)


def _row(name: str, case: Case) -> str:
    started = time.process_time()
    count, options = len(case.names), PairOptions()
    pairs = pair_similarity.candidate_pairs(case.descriptors, options.num_candidates)
    scores = [pair_similarity.match_score(*(case.descriptors[i] for i in pair)) for pair in pairs]
    similarity = pair_similarity.diffuse_similarity(PairSimilarity(pairs, np.array(scores)), count)
    alike = most_similar_pairs(similarity, options.partners)
    chosen = {*alike, *numbered_neighbor_pairs(case.names, options)}
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


def _candidate_row(count: int) -> str:
    """Measure recall and time of the candidate pairs of images along a street."""
    rng = np.random.default_rng(0)
    points = _unit(rng.normal(size=(_STEP * (count + 7), 64)))
    positions = rng.permutation(count)
    descriptors = []
    for position in positions:
        seen = points[_STEP * position : _STEP * (position + 8)]
        noise = 0.5 * _unit(rng.normal(size=seen.shape))
        outliers = _unit(rng.normal(size=seen.shape))
        descriptors.append(np.concatenate([_unit(seen + noise), outliers]).astype(np.float32))
    started = time.process_time()
    pairs = pair_similarity.candidate_pairs(descriptors, PairOptions().num_candidates)
    seconds = time.process_time() - started
    distances = np.abs(np.diff(positions[pairs], axis=1))
    cells = [str(count), f"{len(pairs) / count:.0f}"]
    for steps in (2, 7):
        true = sum(count - step for step in range(1, steps + 1))
        cells.append(f"{100 * (distances <= steps).sum() / true:.1f} % of {true}")
    return f"| {' | '.join([*cells, f'{seconds:.1f}'])} |"


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
    bench = ExtractionContext(images, config, Registry.discover(), NullExtractionEvents())
    assert config.features is not None
    table = FeatureTable(bench, config.features)
    located = table.extract(range(len(names)))
    true = [p for p in combinations(range(len(names)), 2) if overlap[p] > MATCHED_OVERLAP]
    candidates = PairMatcher(bench, table).match(true, located)
    outcomes = PairVerifier(bench, located).verify(candidates)
    matched = []
    for (a, b), outcome in zip(true, outcomes, strict=True):
        rotation = scene.truth[names[b]][0] @ scene.truth[names[a]][0].T
        cosine = (np.trace(outcome.rotation @ rotation.T) - 1) / 2
        if not outcome.dropped and cosine > math.cos(math.radians(RIGHT_DEG)):
            matched.append((a, b))
    descriptors = [
        pair_similarity.strongest_descriptors(table[index]) for index in range(len(names))
    ]
    return Case(names, descriptors, overlap, matched)


def _hall(seed: int = 0) -> Case:
    """Create descriptors and overlaps of the views of a synthetic hall, in random order."""
    hall = make_hall_problem(VIEWS, seed=seed)
    images = hall.problem.images
    depths = {image.name: image.depth.depth for image in images}
    rng = np.random.default_rng(seed)
    overlap = overlap_from_depth(
        [image.name for image in images],
        hall.truth,
        {image.name: image.camera for image in images},
        depths.__getitem__,
    )
    vectors = _unit(rng.normal(size=(1 + max(points.max() for points in hall.points), 64)))
    descriptors = []
    for points in hall.points:
        repeated = rng.permutation(points)[: min(len(points), pair_similarity.NUM_DESCRIPTORS) // 2]
        noise = 0.5 * _unit(rng.normal(size=(len(repeated), 64)))
        outliers = _unit(rng.normal(size=(len(repeated), 64)))
        descriptors.append(
            np.concatenate([_unit(vectors[repeated] + noise), outliers]).astype(np.float32)
        )
    names = [f"{number:03d}.png" for number in rng.permutation(VIEWS)]
    matched = [(pair.image_a, pair.image_b) for pair in hall.problem.pairs]
    return Case(names, descriptors, overlap.two_view, matched)


def _unit(vectors: Float64) -> Float64:
    unit: Float64 = vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
    return unit


if __name__ == "__main__":
    main()
