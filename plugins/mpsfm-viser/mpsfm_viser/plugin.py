"""Registration of the viser viewer, without importing viser."""

from __future__ import annotations

from collections.abc import Mapping

from mpsfm_core import hookimpl


@hookimpl
def mpsfm_viewers() -> Mapping[str, str]:
    """Register the viewer for ``mpsfm view DIR`` and ``mpsfm reconstruct ... --viewer viser``."""
    return {"viser": "mpsfm_viser.viewer:ViserViewer"}
