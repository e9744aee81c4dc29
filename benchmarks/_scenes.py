"""Where benchmarks find scenes and leave results."""

from __future__ import annotations

import os
from pathlib import Path

RESULTS = Path(__file__).parent / "results"


def shared_folder() -> Path:
    """Real scenes and models: $MPSFM_SHARED or ../shared. Ends the script when they are absent."""
    default = Path(__file__).resolve().parents[2] / "shared"
    folder = Path(os.environ.get("MPSFM_SHARED", default))
    if not (folder / "data").is_dir():
        raise SystemExit(f"no scenes in {folder}: set MPSFM_SHARED")
    return folder
