"""Results of a benchmark on disk: one JSON file for each set and method.

Poses are kept, not numbers made of them, so that any convention can be applied later.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mpsfm_core.data import Float64, Pose
from mpsfm_core.data.errors import InputError
from mpsfm_core.evaluation.pose_auc import PoseConvention, pose_errors_deg
from mpsfm_core.support.files import write_file
from mpsfm_core.support.format_versions import VERSION, check_version

FORMAT = 1
"""Of the records."""
RUNS = "runs"
"""Folder of the records below a benchmark's output folder."""


@dataclass(frozen=True, eq=False)
class BenchmarkRecord:
    """What a method made of a set of images.

    ``label``: the method, ours with its prior. ``key``: names all it depends on. ``estimated``,
    ``truth``: ``cam_from_world`` by image name; images that only ``truth`` has are unregistered.
    ``estimated`` is the largest model, ``others`` are further ones. ``pairs``: number of verified
    pairs. ``error``: why it failed, empty if it did not. ``dense``: what
    :func:`~mpsfm_core.evaluation.dense_geometry.evaluate_dense_geometry` says, None where that was not
    asked or cannot be told.
    """

    scene: str
    config: str
    bucket: str
    set_name: str
    label: str
    key: str
    estimated: Mapping[str, Pose]
    truth: Mapping[str, Pose]
    pairs: int
    seconds: float
    cpu_seconds: float
    error: str = ""
    others: Sequence[Mapping[str, Pose]] = ()
    dense: Mapping[str, Any] | None = None

    def errors_deg(self, convention: PoseConvention) -> Float64:
        """Errors of all pairs, see :func:`~mpsfm_core.evaluation.pose_auc.pose_errors_deg`."""
        models = (self.estimated, *(self.others if convention.every_model else ()))
        errors = [pose_errors_deg(model, self.truth, convention) for model in models]
        best: Float64 = np.min(errors, axis=0)
        return best

    @property
    def file(self) -> Path:
        """Place of the record below the output folder."""
        return record_file(*self.name)

    @property
    def name(self) -> tuple[str, str, str, str]:
        """What the same run is called in another benchmark."""
        return self.scene, self.config, self.set_name, self.label


def record_file(scene: str, config: str, set_name: str, label: str) -> Path:
    """Place of a record below the output folder."""
    return Path(RUNS, scene, config, set_name, f"{label}.json")


def write_record(output: Path, record: BenchmarkRecord) -> None:
    """Write a record; a reader sees the whole of it or nothing."""
    path = output / record.file
    content = {VERSION: FORMAT, **asdict(record)}
    content["estimated"] = _packed(record.estimated)
    content["others"] = [_packed(model) for model in record.others]
    content["truth"] = _packed(record.truth)
    write_file(path, json.dumps(content, indent=1))


def read_record(path: Path) -> BenchmarkRecord:
    """Read a record; raises :class:`InputError` when it is damaged or of a newer version."""
    try:
        content: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        check_version(content, FORMAT, path)
        content.pop(VERSION, None)
        content["estimated"] = _unpacked(content["estimated"])
        content["others"] = [_unpacked(model) for model in content["others"]]
        content["truth"] = _unpacked(content["truth"])
        return BenchmarkRecord(**content)
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise InputError(f"{path}: no record of a benchmark: {error}") from error


def read_records(output: Path) -> list[BenchmarkRecord]:
    """All records of a benchmark in the order of their files' names.

    Raises :class:`InputError` when there are none.
    """
    paths = sorted((output / RUNS).glob("*/*/*/*.json"))
    if not paths:
        raise InputError(f"{output}: no results of a benchmark here")
    return [read_record(path) for path in paths]


def _packed(poses: Mapping[str, Pose]) -> dict[str, list[float]]:
    """Each pose as the 12 numbers of its 3 x 4 matrix, row by row."""
    return {name: np.column_stack(pose).ravel().tolist() for name, pose in poses.items()}


def _unpacked(packed: Mapping[str, list[float]]) -> dict[str, Pose]:
    matrices = {name: np.array(values).reshape(3, 4) for name, values in packed.items()}
    return {name: (matrix[:, :3], matrix[:, 3]) for name, matrix in matrices.items()}
