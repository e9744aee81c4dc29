"""Names the viewer; viser is imported when it is wanted."""

from __future__ import annotations

from collections.abc import Mapping

from mpsfm_core import hookimpl


@hookimpl
def mpsfm_viewers() -> Mapping[str, str]:
    """``mpsfm view DIR``, ``mpsfm reconstruct ... --viewer viser``."""
    return {"viser": "mpsfm_viser.viewer:ViserViewer"}
