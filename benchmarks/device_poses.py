"""Sensitivity of pose AUC on hololens_room, bucket `minimal`, to errors of the true poses.

    python -m benchmarks.device_poses [--output DIR]

The true poses of hololens_room are tracked by the HoloLens, with an accuracy of one or two degrees.
Only one pair of the test set `minimal` can be registered, so pose AUC measures one relative pose.
COLMAP registers a window of well overlapping frames around this pair, with two kinds of features.
This benchmark computes pose AUC with COLMAP's poses of the image pair instead of the device poses
as truth. Writes benchmarks/results/device_poses.md.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from itertools import combinations
from pathlib import Path, PurePosixPath

import numpy as np

from benchmarks._scenes import (
    RESULTS,
    frame_names,
    percent,
    print_progress,
    shared_folder,
    with_sets,
)
from benchmarks.accuracy import ALIKED
from mpsfm_core.data import Pose
from mpsfm_core.evaluation.benchmark import BenchmarkPlan, run_benchmark
from mpsfm_core.evaluation.pose_auc import CONVENTIONS, pose_auc, pose_errors_deg
from mpsfm_core.evaluation.records import BenchmarkRecord
from mpsfm_core.evaluation.scene_folder import read_scene

SCENE = "hololens_room"
BUCKET = "minimal"
WINDOW = 12
"""Number of frames of a window; the two frames of the pair are at most half a window apart."""
PEERS = ("colmap-tuned", "colmap-global")
METHODS = ("ours-sensor", "colmap-tuned")
"""Methods whose poses are evaluated with the device poses and with the window poses."""
CONVENTION = CONVENTIONS["paper"]
FEATURES = {"benchmark": "XFeat", ALIKED[0]: "ALIKED"}
"""Settings of local features and matcher, by the name of the configuration."""
Poses = Mapping[str, Pose]


def main() -> None:
    """Map the test set `minimal` and the windows, and write the table of pose AUC."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--output", type=Path, default=Path("build/benchmarks"))
    output = parser.parse_args().output / "device_poses"
    folder = shared_folder() / "data" / SCENE
    frames = frame_names(folder)
    (hard,) = (item.images for item in read_scene(folder).select_sets([BUCKET]))
    stems = [PurePosixPath(image).stem for image in hard]
    around = [_around(*pair, frames) for pair in combinations(stems, 2)]
    sets = {"around": [window for window in around if window], BUCKET: [stems]}
    output.mkdir(parents=True, exist_ok=True)
    aliked = output / f"{ALIKED[0]}.yaml"
    aliked.write_text("extends: benchmark\n" + ALIKED[1], encoding="utf-8")
    plan = BenchmarkPlan(
        (with_sets(folder, output / SCENE, sets),),
        ("benchmark", str(aliked)),
        priors=("sensor",),
        peers=PEERS,
        overrides=("runtime.workers=1",),
    )
    records = run_benchmark(plan, output, on_record=print_progress)
    text = (
        f"# Accuracy of the device poses, {SCENE} `{BUCKET}`\n\n"
        "AUC@20 in percent of the one set of the bucket, if the pose of one pair is taken from "
        f"COLMAP on a window of {WINDOW} images instead of the device. The last columns: "
        "difference of that pose from the device pose, and the largest difference between "
        "windows, in degrees.\n\n"
        f"{_table(records)}\n"
    )
    RESULTS.mkdir(exist_ok=True)
    (RESULTS / "device_poses.md").write_text(text, encoding="utf-8")
    print(text)


def _around(a: str, b: str, frames: Sequence[str]) -> list[str]:
    """Return the window of frames around a pair, or no frames if the pair is too far apart."""
    first, last = sorted((frames.index(a), frames.index(b)))
    if last - first > WINDOW // 2:
        return []
    start = min(max((first + last + 1 - WINDOW) // 2, 0), len(frames) - WINDOW)
    return list(frames[start : start + WINDOW])


def _table(records: Sequence[BenchmarkRecord]) -> str:
    """Format one table row for each source of true poses: the device, and COLMAP on each window."""
    hard = {r.label: r for r in records if r.bucket == BUCKET and r.config == "benchmark"}
    device = hard[METHODS[0]].truth
    truths: dict[str, list[Poses]] = {}
    for record in records:
        if record.bucket == "around" and record.label in PEERS:
            name = f"{record.label}, {FEATURES[record.config]}, {len(record.estimated)} images"
            truths.setdefault(name, []).append(record.estimated)
    lines = [
        f"| truth | {' | '.join(METHODS)} | to device pose | between windows |",
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


def _area(record: BenchmarkRecord, truths: Sequence[Poses]) -> str:
    """Compute AUC@20 with the first set of true poses that contains both images of a pair."""
    errors = []
    for pair in combinations(record.truth, 2):
        truth = _of_pair(truths, pair) or {name: record.truth[name] for name in pair}
        errors.append(pose_errors_deg(record.estimated, truth, CONVENTION))
    return percent(pose_auc(np.concatenate(errors), CONVENTION, (20,)))


def _apart(some: Sequence[Poses], others: Sequence[Poses], images: Poses) -> float:
    """Compute the largest relative pose difference in degrees over the pairs of two models."""
    errors = [0.0]
    for pair in combinations(images, 2):
        ours, theirs = _of_pair(some, pair), _of_pair(others, pair)
        if ours and theirs:
            errors.append(float(pose_errors_deg(ours, theirs, CONVENTION).mean()))
    return max(errors)


def _of_pair(models: Sequence[Poses], pair: tuple[str, str]) -> Poses:
    """Return the poses of two images in the first model that contains both images."""
    model = next((model for model in models if model.keys() >= set(pair)), None)
    return {name: model[name] for name in pair} if model else {}


if __name__ == "__main__":
    main()
