"""The table of formats, and the one function that exports."""

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
from mpsfm_core.results.exports import (
    bundler,
    colmap_database,
    colmap_text,
    glb,
    gsplat,
    nerfstudio,
    nvm,
)
from mpsfm_core.results.exports.source import ExportSource
from mpsfm_core.support.files import replacing
from mpsfm_core.support.format_versions import VERSION

DESCRIPTION = "export.json"
"""Beside every export: what it holds, its unit, which way is up, and how it came from the run."""

DESCRIPTION_FORMAT = 1
"""Of :data:`DESCRIPTION`."""


FORMATS = (
    ExportFormat(
        "nerfstudio",
        "transforms.json with undistorted photos, depth, normals and points",
        nerfstudio.ENTRIES,
        nerfstudio.write,
        turned=True,
    ),
    ExportFormat(
        "gsplat",
        "COLMAP folder of undistorted photos with points, depth and normals for splatting",
        gsplat.ENTRIES,
        gsplat.write,
        turned=True,
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
        turned=True,
    ),
    ExportFormat("bundler", "bundle.out of Bundler, undistorted", bundler.ENTRIES, bundler.write),
    ExportFormat("nvm", "N-View Match of VisualSFM, undistorted", nvm.ENTRIES, nvm.write),
)
"""Those of the core."""


def known_formats(registry: Registry | None = None) -> dict[str, ExportFormat]:
    """All formats by name: the core's, then the plugins'.

    ``registry``: by default that of all installed plugins.
    """
    registry = registry or Registry.discover()
    brought = [one for more in registry.call_hook("mpsfm_export_formats") for one in more]
    known: dict[str, ExportFormat] = {}
    for one in (*FORMATS, *brought):
        known.setdefault(one.name, one)
    return known


def export(
    folder: Path,
    format_name: str,
    output: Path | None = None,
    *,
    photos: Path | None = None,
    turn: bool | None = None,
    registry: Registry | None = None,
) -> dict[str, Any]:
    """Write a result folder or COLMAP model in another format.

    ``output``: folder, by default ``exports/FORMAT`` below ``folder``. ``photos``: folder of the
    photos, if they are not where the run found them. ``turn``: whether gravity becomes -z and the
    middle the origin, None for what suits the format. ``registry``: by default that of all
    installed plugins, which may bring formats.

    Returns what :data:`DESCRIPTION` says. Raises :class:`InputError` when the input is damaged or
    lacks what the format needs.
    """
    known = known_formats(registry)
    if format_name not in known:
        hint = install_hint(EXPORTS, format_name) or did_you_mean(format_name, known)
        raise InputError(f"no format {format_name!r}{hint}")
    chosen = known[format_name]
    source = ExportSource.read(folder, photos)
    if turn is None:
        turn = chosen.turned and not source.is_georeferenced
    if turn:
        source = source.turned()
    output = output or folder / "exports" / format_name
    described = _describe(source, format_name)
    with replacing(output, (*chosen.entries, DESCRIPTION)) as fresh:
        _writer_of(chosen)(source, fresh)
        text = json.dumps(described, indent=2) + "\n"
        (fresh / DESCRIPTION).write_text(text, encoding="utf-8")
    return {**described, "output": str(output)}


def _writer_of(chosen: ExportFormat) -> Callable[[ExportSource, Path], None]:
    if callable(chosen.write):
        return chosen.write
    try:
        writer: Callable[[ExportSource, Path], None] = resolve_name(chosen.write)
    except Exception as error:  # a plugin's
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
