"""Export a reconstruction to a format of the core or of a plugin."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from pkgutil import resolve_name
from typing import Any

from mpsfm_core.data.errors import InputError, did_you_mean
from mpsfm_core.providers import ExportFormat
from mpsfm_core.providers.first_party import EXPORTS, install_hint
from mpsfm_core.providers.registry import Registry
from mpsfm_core.results.exports import colmap_database, colmap_text, glb, gsplat, nerfstudio
from mpsfm_core.results.exports.source import ExportSource
from mpsfm_core.support.files import replace_entries
from mpsfm_core.support.format_versions import VERSION

DESCRIPTION = "export.json"
"""File in every export folder with the number of images and points, unit, orientation and
transform."""

DESCRIPTION_FORMAT = 1
"""Version of :data:`DESCRIPTION`."""


FORMATS = (
    ExportFormat(
        "nerfstudio",
        "transforms.json with undistorted photos, depth, normals and points",
        nerfstudio.ENTRIES,
        nerfstudio.write,
        align_gravity=True,
    ),
    ExportFormat(
        "gsplat",
        "COLMAP folder of undistorted photos with points, depth and normals for splatting",
        gsplat.ENTRIES,
        gsplat.write,
        align_gravity=True,
    ),
    ExportFormat(
        "colmap-db",
        "COLMAP database with cameras, keypoints and verified matches",
        colmap_database.ENTRIES,
        colmap_database.write,
    ),
    ExportFormat("colmap-text", "COLMAP model as text", colmap_text.ENTRIES, colmap_text.write),
    ExportFormat(
        "glb",
        "points and cameras as glTF, for Blender and browsers",
        glb.ENTRIES,
        glb.write,
        align_gravity=True,
    ),
)
"""Export formats that the core package provides."""


def known_formats(registry: Registry | None = None) -> dict[str, ExportFormat]:
    """Return all export formats of the core and of plugins by name.

    Args:
        registry: registry of plugins, by default of all installed plugins.
    """
    registry = registry or Registry.discover()
    plugin_formats = [f for formats in registry.call_hook("mpsfm_export_formats") for f in formats]
    by_name: dict[str, ExportFormat] = {}
    for export_format in (*FORMATS, *plugin_formats):
        by_name.setdefault(export_format.name, export_format)
    return by_name


def export(
    folder: str | Path,
    format_name: str,
    output: str | Path | None = None,
    *,
    photos: str | Path | None = None,
    turn: bool | None = None,
    registry: Registry | None = None,
) -> dict[str, Any]:
    """Export a result folder or COLMAP model to another file format.

    Args:
        folder: result folder or COLMAP model.
        format_name: name of the export format, see :func:`known_formats`.
        output: export folder to write, by default ``exports/FORMAT`` below ``folder``.
        photos: folder of the original images, if it has moved since the run.
        turn: true to rotate gravity to -z and move the origin to the median point, None for the
            default of the export format.
        registry: registry of plugins, by default of all installed plugins.

    Returns:
        The content of the file :data:`DESCRIPTION`, and the path of the export folder as
        ``output``.

    Raises:
        InputError: the export format is unknown, or the reconstruction is damaged or incomplete.

    Examples:
        >>> mpsfm.export("out/", "nerfstudio")["images"]
        8
    """
    folder = Path(folder)
    known = known_formats(registry)
    if format_name not in known:
        hint = install_hint(EXPORTS, format_name) or did_you_mean(format_name, known)
        raise InputError(f"no format {format_name!r}{hint}")
    chosen = known[format_name]
    source = ExportSource.read(folder, None if photos is None else Path(photos))
    if turn is None:
        turn = chosen.align_gravity and not source.is_georeferenced
    if turn:
        source = source.turned()
    output = folder / "exports" / format_name if output is None else Path(output)
    described = _describe(source, format_name)
    with replace_entries(output, (*chosen.entries, DESCRIPTION)) as fresh:
        _writer_of(chosen)(source, fresh)
        text = json.dumps(described, indent=2) + "\n"
        (fresh / DESCRIPTION).write_text(text, encoding="utf-8")
    return {**described, "output": str(output)}


def _writer_of(chosen: ExportFormat) -> Callable[[ExportSource, Path], None]:
    if callable(chosen.write):
        return chosen.write
    try:
        writer: Callable[[ExportSource, Path], None] = resolve_name(chosen.write)
    except Exception as error:  # a plugin may raise any exception
        text = f"format {chosen.name!r} cannot be written: {type(error).__name__}: {error}"
        raise InputError(text) from error
    return writer


def _describe(source: ExportSource, format_name: str) -> dict[str, Any]:
    orientation = "east, north, up" if source.is_georeferenced else "as in the model"
    if source.gravity is not None:
        orientation = f"z is up: {source.gravity}"
    return {
        VERSION: DESCRIPTION_FORMAT,
        "format": format_name,
        "images": len(source.names),
        "points": source.model.num_points3D(),
        "left_out": list(source.left_out),
        "metres_per_unit": source.metres_per_unit,
        "scale_spread": source.scale_spread,
        "orientation": orientation,
        "world_from_model": source.world_from_model.matrix().tolist(),
    }
