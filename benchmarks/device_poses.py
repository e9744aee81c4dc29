"""How a set that hangs on one pair of images fares beside better poses than the device's.

    python -m benchmarks.device_poses [--output DIR]

The true poses of hololens_room are what the device tracked, good to a degree or two. In its set
of the bucket `minimal` only one pair can be posed, so that the figure of that bucket says how far
one pose is from the device's. Frames around that pair overlap much; COLMAP poses them without any
depth, on matches of two features. Here these poses take the place of the device's. Writes
benchmarks/results/device_poses.md.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from itertools import combinations
from pathlib import Path, PurePosixPath

import numpy as np

from benchmarks._scenes import RESULTS, frame_names, percent, shared_folder, tell, with_sets
from benchmarks.accuracy import ALIKED
from mpsfm_core.data import Pose
from mpsfm_core.evaluation.benchmark import Plan, run_benchmark
from mpsfm_core.evaluation.pose_auc import CONVENTIONS, pose_auc, pose_errors_deg
from mpsfm_core.evaluation.records import Record
from mpsfm_core.evaluation.scene_folder import read_scene

SCENE = "hololens_room"
BUCKET = "minimal"
WINDOW = 12
"""Frames around a pair; it may be half as far apart."""
PEERS = ("colmap-tuned", "colmap-global")
METHODS = ("ours-sensor", "colmap-tuned")
"""Whose poses of the bucket are held against the device's and those of the window."""
CONVENTION = CONVENTIONS["paper"]
FEATURES = {"benchmark": "XFeat", ALIKED[0]: "ALIKED"}
"""Of each configuration."""
Poses = Mapping[str, Pose]


def main() -> None:
    """Run the bucket and the windows, and write the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--output", type=Path, default=Path("build/benchmarks"))
    output = parser.parse_args().output / "device_poses"
    folder = shared_folder() / "data" / SCENE
    frames = frame_names(folder)
    (hard,) = (item.images for item in read_scene(folder).chosen([BUCKET]))
    stems = [PurePosixPath(image).stem for image in hard]
    around = [_around(*pair, frames) for pair in combinations(stems, 2)]
    sets = {"around": [window for window in around if window], BUCKET: [stems]}
    output.mkdir(parents=True, exist_ok=True)
    aliked = output / f"{ALIKED[0]}.yaml"
    aliked.write_text("extends: benchmark\n" + ALIKED[1], encoding="utf-8")
    plan = Plan(
        (with_sets(folder, output / SCENE, sets),),
        ("benchmark", str(aliked)),
        priors=("sensor",),
        peers=PEERS,
        overrides=("runtime.workers=1",),
    )
    records = run_benchmark(plan, output, done=tell)
    text = (
        f"# Truth of {SCENE}, {BUCKET}\n\n"
        f"AUC@20 in percent of the bucket's one set, when the pair that is in a window of {WINDOW} "
        "frames takes COLMAP's pose of that window for true, not the device's. Beside it how far "
        "that pose is from the device's, and at most from the other windows', in degrees.\n\n"
        f"{_table(records)}\n"
    )
    RESULTS.mkdir(exist_ok=True)
    (RESULTS / "device_poses.md").write_text(text, encoding="utf-8")
    print(text)


def _around(a: str, b: str, frames: Sequence[str]) -> list[str]:
    """The window in whose middle two frames are; none if they are too far apart."""
    first, last = sorted((frames.index(a), frames.index(b)))
    if last - first > WINDOW // 2:
        return []
    start = min(max((first + last + 1 - WINDOW) // 2, 0), len(frames) - WINDOW)
    return list(frames[start : start + WINDOW])


def _table(records: Sequence[Record]) -> str:
    """A row for each truth: the device's, and that of each peer and feature."""
    hard = {r.label: r for r in records if r.bucket == BUCKET and r.config == "benchmark"}
    device = hard[METHODS[0]].truth
    truths: dict[str, list[Poses]] = {}
    for record in records:
        if record.bucket == "around" and record.label in PEERS:
            name = f"{record.label}, {FEATURES[record.config]}, {len(record.estimated)} images"
            truths.setdefault(name, []).append(record.estimated)
    lines = [
        f"| truth | {' | '.join(METHODS)} | from the device | from each other |",
        f"| --- |{' ---: |' * len(METHODS)} ---: | ---: |",
        f"| device | {' | '.join(_area(hard[method], []) for method in METHODS)} | | |",
    ]
    for name, windows in sorted(truths.items()):
        cells = [_area(hard[method], windows) for method in METHODS]
        off = _apart(windows, [device], device)
        rivals = [other for rival, other in truths.items() if rival != name]
        others = max(_apart(windows, rival, device) for rival in rivals)
        lines.append(f"| {name} | {' | '.join(cells)} | {off:.1f} | {others:.1f} |")
    return "\n".join(lines)


def _area(record: Record, truths: Sequence[Poses]) -> str:
    """AUC@20, each pair held against the first of some truths that has it, at last the device."""
    errors = []
    for pair in combinations(record.truth, 2):
        truth = _of_pair(truths, pair) or {name: record.truth[name] for name in pair}
        errors.append(pose_errors_deg(record.estimated, truth, CONVENTION))
    return percent(pose_auc(np.concatenate(errors), CONVENTION, (20,)))


def _apart(some: Sequence[Poses], others: Sequence[Poses], images: Poses) -> float:
    """Largest difference of the pairs of these images that are in one model of both, in degrees."""
    errors = [0.0]
    for pair in combinations(images, 2):
        ours, theirs = _of_pair(some, pair), _of_pair(others, pair)
        if ours and theirs:
            errors.append(float(pose_errors_deg(ours, theirs, CONVENTION).mean()))
    return max(errors)


def _of_pair(models: Sequence[Poses], pair: tuple[str, str]) -> Poses:
    """The poses of two images in the first model that has both; empty if none has."""
    model = next((model for model in models if model.keys() >= set(pair)), None)
    return {name: model[name] for name in pair} if model else {}


if __name__ == "__main__":
    main()
