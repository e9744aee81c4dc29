"""Where benchmarks find scenes and leave results, how they run commands and tell what is done."""

from __future__ import annotations

import os
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

from mpsfm_core.evaluation.records import Record
from mpsfm_core.support.yaml_text import write_yaml

RESULTS = Path(__file__).parent / "results"
MPSFM = [sys.executable, "-m", "mpsfm_core"]
"""The command ``mpsfm`` of this environment; its arguments follow."""


def shared_folder() -> Path:
    """Real scenes and models: $MPSFM_SHARED or ../shared. Ends the script when they are absent."""
    default = Path(__file__).resolve().parents[2] / "shared"
    folder = Path(os.environ.get("MPSFM_SHARED", default))
    if not (folder / "data").is_dir():
        raise SystemExit(f"no scenes in {folder}: set MPSFM_SHARED")
    return folder


def frame_names(scene: Path) -> list[str]:
    """Images of a scene folder without their ending, in order."""
    return sorted(path.stem for path in (scene / "images").iterdir())


def with_sets(scene: Path, folder: Path, sets: Mapping[str, Sequence[Sequence[str]]]) -> Path:
    """The scene once more in ``folder``, with sets of images of its own in each bucket."""
    folder.mkdir(parents=True, exist_ok=True)
    for item in scene.iterdir():
        if item.name != "testsets.yaml" and not (folder / item.name).exists():
            (folder / item.name).symlink_to(item.resolve())
    buckets = {bucket: [{"images": list(images)} for images in of] for bucket, of in sets.items()}
    (folder / "testsets.yaml").write_text(write_yaml(buckets), encoding="utf-8")
    return folder


def percent(area: Mapping[float, float]) -> str:
    """Pose AUC by threshold, in percent, for a cell of a table."""
    return " / ".join(f"{100 * value:.1f}" for value in area.values())


def tell(record: Record, known: bool) -> None:
    """Say on stderr that a run is done, or was before."""
    what = "known" if known else record.error or f"{record.cpu_seconds:.1f} s"
    print(f"{record.config} {record.set_name} {record.label}: {what}", file=sys.stderr)
