"""Registration of the rerun viewer and export format, without importing rerun."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from mpsfm_core import hookimpl
from mpsfm_core.providers import ExportFormat


@hookimpl
def mpsfm_viewers() -> Mapping[str, str]:
    """Register the viewer for ``mpsfm view DIR --viewer rerun`` and ``mpsfm reconstruct``."""
    return {"rerun": "mpsfm_rerun.viewer:RerunViewer"}


@hookimpl
def mpsfm_export_formats() -> Sequence[ExportFormat]:
    """Register the format for ``mpsfm export DIR --to rerun``."""
    return [
        ExportFormat(
            "rerun",
            "recording for the rerun viewer: cameras, photos, points, depth maps",
            ("scene.rrd",),
            "mpsfm_rerun.export:write",
            align_gravity=True,
        )
    ]
