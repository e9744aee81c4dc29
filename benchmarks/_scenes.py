"""Locate the scenes and the result folder of the benchmarks, and format their results."""

from __future__ import annotations

import os
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

from mpsfm_core.evaluation.records import BenchmarkRecord
from mpsfm_core.support.yaml_text import write_yaml

RESULTS = Path(__file__).parent / "results"
MPSFM = [sys.executable, "-m", "mpsfm_core"]
"""Path of the command ``mpsfm`` of the running Python environment."""


def shared_folder() -> Path:
    """Return the folder with real scenes ($MPSFM_SHARED or ../shared); exit if it is missing."""
    default = Path(__file__).resolve().parents[2] / "shared"
    folder = Path(os.environ.get("MPSFM_SHARED", default))
    if not (folder / "data").is_dir():
        raise SystemExit(
            f"no benchmark scenes in {folder}: set MPSFM_SHARED to the folder that contains data/ "
            f"and models/"
        )
    return folder


def frame_names(scene: Path) -> list[str]:
    """Return the sorted image names of a scene folder without their suffix."""
    return sorted(path.stem for path in (scene / "images").iterdir())


def with_sets(scene: Path, folder: Path, sets: Mapping[str, Sequence[Sequence[str]]]) -> Path:
    """Copy a scene folder to ``folder``, with new test sets (lists of images)."""
    folder.mkdir(parents=True, exist_ok=True)
    for item in scene.iterdir():
        if item.name != "testsets.yaml" and not (folder / item.name).exists():
            (folder / item.name).symlink_to(item.resolve())
    buckets = {bucket: [{"images": list(images)} for images in of] for bucket, of in sets.items()}
    (folder / "testsets.yaml").write_text(write_yaml(buckets), encoding="utf-8")
    return folder


def percent(area: Mapping[float, float]) -> str:
    """Format pose AUC in percent, by threshold in degrees, as a cell of a table."""
    return " / ".join(f"{100 * value:.1f}" for value in area.values())


def print_progress(record: BenchmarkRecord, known: bool) -> None:
    """Print to stderr that a step of a benchmark is complete, or was read from an earlier run."""
    what = "known" if known else record.error or f"{record.cpu_seconds:.1f} s"
    print(f"{record.config} {record.set_name} {record.label}: {what}", file=sys.stderr)
