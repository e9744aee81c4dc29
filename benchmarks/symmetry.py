"""Depth check on two identical rooms: rejected pose hypotheses and pose accuracy.

    python -m benchmarks.symmetry [--seeds 9] [--placed-only] [--output FILE]

The first table (*placed*) checks images at given poses, with refined depth. The depth check
compares each view at its true pose with all other views. The depth check also compares each view at
the corresponding wrong pose in the other room with the views of the other room and of the corridor.
The second table (*mapped*) lists results of the whole mapper, with and without the depth check. A
registered image counts as wrong if it is nearer to the corresponding position in the other room
than to its true position. Positions are relative to an image of the initial pair.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from unittest.mock import patch

import numpy as np

from benchmarks._scenes import percent
from mpsfm_core.data import MappingProblem
from mpsfm_core.evaluation.pose_auc import CONVENTIONS, pose_auc, pose_errors_deg
from mpsfm_core.geometry import camera_center
from mpsfm_core.mapping import component
from mpsfm_core.mapping.consistency.depth_consistency import DepthConsistencyCheck
from mpsfm_core.mapping.events import NullMappingEvents
from mpsfm_core.mapping.mapper import Mapper
from mpsfm_core.mapping.model_maintenance import ModelMaintenance
from mpsfm_core.mapping.options import MapperOptions
from mpsfm_core.mapping.scene.tracks import NO_POINT
from mpsfm_core.testing.synthetic.degraded_depth import DepthErrors
from mpsfm_core.testing.synthetic.two_rooms import (
    SymmetricProblem,
    make_twin_room_problem,
    shift_pose,
)

PRIORS = {"exact, declared 1 %": None, "5 % + 5 % scale, declared 5 %": DepthErrors()}
HEADER = "| priors | wrong rejected | correct rejected | check, ms |\n|---|---|---|---|"
HEADER_MAPPED = (
    "| priors | check | AUC@1/5/20 | registered | wrong rejected | correct rejected | time, s |\n"
    "|---|---|---|---|---|---|---|"
)


def placed(case: SymmetricProblem) -> Iterator[tuple[bool, bool, float]]:
    """Check the depth of each view at a correct and a wrong pose; yield (wrong, rejected,
    seconds)."""
    views = zip(case.problem.images, case.poses, strict=True)
    images = tuple(replace(i, known_pose=(p[:, :3].copy(), p[:, 3].copy())) for i, p in views)
    pairs = tuple(p for p, false in zip(case.problem.pairs, case.false, strict=True) if not false)
    options = MapperOptions(known_poses="fixed")
    mapper = Mapper(MappingProblem(images, pairs), options, NullMappingEvents())
    mapper.reconstruct_component()
    scene, std_factor = mapper.component.scene, mapper.component.refiner.std_factor
    room = np.array(case.room)
    everything = scene.registered.copy()
    for image in np.flatnonzero(room >= 0):
        for wrong in (False, True):
            pose = shift_pose(case.poses[image], 2 * int(room[image]) - 1) if wrong else None
            truth, seen = scene.translations[image].copy(), scene.tracks.point_of.copy()
            if pose is not None:
                scene.registered = everything & (room != room[image])
                scene.translations[image] = truth + pose[:, 3] - case.poses[image][:, 3]
                # keep the view's observations of points, because only the pose of the view is wrong
                scene.tracks.point_of[scene.graph.keypoints_of(int(image))] = NO_POINT
            start = time.perf_counter()
            check = DepthConsistencyCheck(scene, options.consistency).check_image(
                int(image), std_factor
            )
            seconds = time.perf_counter() - start
            yield wrong, check.ratio > options.consistency.max_violations, seconds
            scene.translations[image], scene.registered = truth, everything
            scene.tracks.point_of = seen


class Observed(ModelMaintenance):
    """Scene that records for every depth check whether the pose is wrong and whether it is
    rejected."""

    case: SymmetricProblem
    verdicts: list[tuple[bool, bool]]
    first: int | None = None

    def check_depth(self, image: int, limit: float) -> str | None:
        reason = super().check_depth(image, limit)
        self.verdicts.append((self._misplaced(image), reason is not None))
        return reason

    def _misplaced(self, image: int) -> bool:
        """Return true if an image is registered nearer to its position in the other room."""
        scene, poses = self.scene, np.array(self.case.poses)
        if self.first is None or self.size == 2:
            others = scene.registered.copy()
            others[image] = False
            self.first = int(others.argmax())
        first = self.first
        turn = poses[first, :, :3].T @ scene.rotations[first]
        centers, truth = scene.centers(), camera_center(poses[..., :3], poses[..., 3])
        step = turn @ (centers[image] - centers[first]) / scene.maps[first].scale
        return bool(np.linalg.norm(truth[first] + step - truth[image]) > 2.6)


def mapped(case: SymmetricProblem, enabled: bool) -> tuple[np.ndarray, int, list, float]:  # type: ignore[type-arg]
    """Map a scene; return pose errors, size of the largest component, check results and seconds."""
    options = MapperOptions.model_validate({"consistency": {"enabled": enabled}})
    verdicts: list[tuple[bool, bool]] = []
    mapper = Mapper(case.problem, options, NullMappingEvents())
    observed = type("ObservedCase", (Observed,), {"case": case, "verdicts": verdicts})
    start = time.perf_counter()
    with patch.object(component, "ModelMaintenance", observed):
        components = mapper.reconstruct_components()
    seconds = time.perf_counter() - start
    best = max(components, key=lambda c: len(c.images), default=None)
    poses = best.poses if best else {}
    views = zip(case.problem.images, case.poses, strict=True)
    truth = {image.name: (pose[:, :3], pose[:, 3]) for image, pose in views}
    return pose_errors_deg(poses, truth, CONVENTIONS["paper"]), len(poses), verdicts, seconds


def shares(verdicts: list[tuple[bool, bool]]) -> str:
    """Format the rejected shares of wrong and of correct pose hypotheses as two table cells."""
    cells = []
    for kind in (True, False):
        chosen = [rejected for wrong, rejected in verdicts if wrong == kind]
        cells.append(f"{np.mean(chosen):.1%} of {len(chosen)}" if chosen else "-")
    return " | ".join(cells)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--seeds", type=int, default=9)
    parser.add_argument("--placed-only", action="store_true")
    parser.add_argument("--output", type=Path)
    arguments = parser.parse_args()
    lines = ["Depth check at given poses:", "", HEADER]
    for name, errors in PRIORS.items():
        cases = [make_twin_room_problem(seed, errors=errors) for seed in range(arguments.seeds)]
        rows = [row for case in cases for row in placed(case)]
        milliseconds = 1e3 * float(np.median([seconds for _, _, seconds in rows]))
        lines.append(f"| {name} | {shares([row[:2] for row in rows])} | {milliseconds:.1f} |")
    if not arguments.placed_only:
        convention = CONVENTIONS["paper"]
        lines += ["", f"Whole mapper; pose AUC in percent, convention `{convention.name}`:"]
        lines += [f"{convention.description}.", "", HEADER_MAPPED]
        for name, errors in PRIORS.items():
            cases = [make_twin_room_problem(seed, errors=errors) for seed in range(arguments.seeds)]
            for enabled in (False, True):
                runs = [mapped(case, enabled) for case in cases]
                area = pose_auc(np.concatenate([run[0] for run in runs]), convention)
                auc = percent(area)
                size = sum(run[1] for run in runs) / sum(len(case.poses) for case in cases)
                verdicts = [v for run in runs for v in run[2]] if enabled else []
                seconds = np.mean([run[3] for run in runs])
                lines.append(
                    f"| {name} | {'on' if enabled else 'off'} | {auc} | {size:.0%} | "
                    f"{shares(verdicts)} | {seconds:.0f} |"
                )
    table = "\n".join(lines)
    print(table)
    if arguments.output:
        arguments.output.write_text(table + "\n")


if __name__ == "__main__":
    main()
