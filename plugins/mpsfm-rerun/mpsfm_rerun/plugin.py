"""Names the viewer; rerun is imported when it is wanted."""

from __future__ import annotations

from collections.abc import Mapping

from mpsfm_core import hookimpl


@hookimpl
def mpsfm_viewers() -> Mapping[str, str]:
    """``mpsfm view DIR --viewer rerun``, ``mpsfm reconstruct ... --viewer rerun``."""
    return {"rerun": "mpsfm_rerun.viewer:RerunViewer"}
