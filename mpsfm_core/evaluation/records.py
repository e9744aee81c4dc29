"""Benchmark records on disk: one JSON file per test set and method.

Records contain poses instead of metrics, so that any AUC convention can be applied later.
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
"""Format version of the benchmark record files."""
RUNS = "runs"
"""Folder of the records below a benchmark's output folder."""


@dataclass(frozen=True, eq=False)
class BenchmarkRecord:
    """Result of a benchmark method on a test set of images."""

    scene: str
    """Name of the scene folder."""
    config: str
    """Name of the configuration."""
    bucket: str
    """Overlap bucket of the test set, such as ``leq5``."""
    set_name: str
    """Name of the test set."""
    label: str
    """Name of the method, with the prior quality for methods that use priors."""
    key: str
    """Hash of all inputs that determine the result of the run."""
    estimated: Mapping[str, Pose]
    """Estimated poses ``cam_from_world`` of the largest model by image name."""
    truth: Mapping[str, Pose]
    """True poses ``cam_from_world`` of all images of the test set by image name."""
    pairs: int
    """Number of verified image pairs."""
    seconds: float
    """Wall time of the reconstruction in seconds."""
    cpu_seconds: float
    """CPU time of the reconstruction in seconds."""
    error: str = ""
    """Error message of a failed run; empty on success."""
    others: Sequence[Mapping[str, Pose]] = ()
    """Poses ``cam_from_world`` by image name of each further model."""
    dense: Mapping[str, Any] | None = None
    """Accuracy of the dense results from
    :meth:`~mpsfm_core.evaluation.dense_geometry.DenseEvaluation.evaluate`, or None."""

    def errors_deg(self, convention: PoseConvention) -> Float64:
        """Compute the relative pose errors of all image pairs of the test set in degrees."""
        models = (self.estimated, *(self.others if convention.every_model else ()))
        errors = [pose_errors_deg(model, self.truth, convention) for model in models]
        best: Float64 = np.min(errors, axis=0)
        return best

    @property
    def file(self) -> Path:
        """Relative path of the record below the benchmark's output folder."""
        return record_file(*self.name)

    @property
    def name(self) -> tuple[str, str, str, str]:
        """Scene, configuration, test set and method label, which identify a benchmark run."""
        return self.scene, self.config, self.set_name, self.label


def record_file(scene: str, config: str, set_name: str, label: str) -> Path:
    """Return the relative path of a record below the benchmark's output folder."""
    return Path(RUNS, scene, config, set_name, f"{label}.json")


def write_record(output: Path, record: BenchmarkRecord) -> None:
    """Write a benchmark record atomically to its file."""
    path = output / record.file
    content = {VERSION: FORMAT, **asdict(record)}
    content["estimated"] = _flatten_poses(record.estimated)
    content["others"] = [_flatten_poses(model) for model in record.others]
    content["truth"] = _flatten_poses(record.truth)
    write_file(path, json.dumps(content, indent=1))


def read_record(path: Path) -> BenchmarkRecord:
    """Read a record.

    Raises:
        InputError: The record file is damaged or has a newer format.
    """
    try:
        content: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        check_version(content, FORMAT, path)
        content.pop(VERSION, None)
        content["estimated"] = _restore_poses(content["estimated"])
        content["others"] = [_restore_poses(model) for model in content["others"]]
        content["truth"] = _restore_poses(content["truth"])
        return BenchmarkRecord(**content)
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise InputError(f"{path}: the file is not a benchmark record: {error}") from error


def read_records(output: Path) -> list[BenchmarkRecord]:
    """Read all records of a benchmark in the order of their file names.

    Raises:
        InputError: The folder has no benchmark records, or a record is damaged.
    """
    paths = sorted((output / RUNS).glob("*/*/*/*.json"))
    if not paths:
        raise InputError(
            f"{output}: the folder has no benchmark results; run mpsfm benchmark -o {output}"
        )
    return [read_record(path) for path in paths]


def _flatten_poses(poses: Mapping[str, Pose]) -> dict[str, list[float]]:
    """Convert each pose to the 12 values of its 3 x 4 matrix, row-major."""
    return {name: np.column_stack(pose).ravel().tolist() for name, pose in poses.items()}


def _restore_poses(packed: Mapping[str, list[float]]) -> dict[str, Pose]:
    matrices = {name: np.array(values).reshape(3, 4) for name, values in packed.items()}
    return {name: (matrix[:, :3], matrix[:, 3]) for name, matrix in matrices.items()}
