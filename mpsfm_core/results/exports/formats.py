"""The table of formats, and the one function that exports."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mpsfm_core.errors import InputError, did_you_mean
from mpsfm_core.files import replacing
from mpsfm_core.formats import VERSION
from mpsfm_core.results.exports import (
    bundler,
    colmap_database,
    colmap_text,
    glb,
    gsplat,
    nerfstudio,
    nvm,
)
from mpsfm_core.results.exports.source import Source

DESCRIPTION = "export.json"
"""Beside every export: what it holds, its unit, which way is up, and how it came from the run."""

DESCRIPTION_FORMAT = 1
"""Of :data:`DESCRIPTION`."""


@dataclass(frozen=True)
class Format:
    """``description``: one line for people. ``entries``: what it writes into its folder.
    ``write``: writes them; raises :class:`InputError`. ``turned``: gravity is -z unless the user
    wants otherwise, for programs that show or render the scene."""

    description: str
    entries: tuple[str, ...]
    write: Callable[[Source, Path], None]
    turned: bool = False


FORMATS = {
    "nerfstudio": Format(
        "transforms.json with undistorted photos, depth, normals and points",
        nerfstudio.ENTRIES,
        nerfstudio.write,
        turned=True,
    ),
    "gsplat": Format(
        "COLMAP folder of undistorted photos with points, depth and normals for splatting",
        gsplat.ENTRIES,
        gsplat.write,
        turned=True,
    ),
    "colmap-db": Format(
        "COLMAP database with cameras, keypoints and verified matches",
        colmap_database.ENTRIES,
        colmap_database.write,
    ),
    "colmap-text": Format("COLMAP model as text", colmap_text.ENTRIES, colmap_text.write),
    "glb": Format(
        "points and cameras as glTF, for Blender and browsers", glb.ENTRIES, glb.write, turned=True
    ),
    "bundler": Format("bundle.out of Bundler, undistorted", bundler.ENTRIES, bundler.write),
    "nvm": Format("N-View Match of VisualSFM, undistorted", nvm.ENTRIES, nvm.write),
}


def export(
    folder: Path,
    format_name: str,
    output: Path | None = None,
    *,
    photos: Path | None = None,
    turn: bool | None = None,
) -> dict[str, Any]:
    """Write a result folder or COLMAP model in another format.

    ``output``: folder, by default ``exports/FORMAT`` below ``folder``. ``photos``: folder of the
    photos, if they are not where the run found them. ``turn``: whether gravity becomes -z and the
    middle the origin, None for what suits the format.

    Returns what :data:`DESCRIPTION` says. Raises :class:`InputError` when the input is damaged or
    lacks what the format needs.
    """
    if format_name not in FORMATS:
        raise InputError(f"no format {format_name!r}{did_you_mean(format_name, FORMATS)}")
    chosen = FORMATS[format_name]
    source = Source.read(folder, photos)
    if turn is None:
        turn = chosen.turned and not source.is_georeferenced
    if turn:
        source = source.turned()
    output = output or folder / "exports" / format_name
    described = _describe(source, format_name)
    with replacing(output, (*chosen.entries, DESCRIPTION)) as fresh:
        chosen.write(source, fresh)
        text = json.dumps(described, indent=2) + "\n"
        (fresh / DESCRIPTION).write_text(text, encoding="utf-8")
    return {**described, "output": str(output)}


def _describe(source: Source, format_name: str) -> dict[str, Any]:
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
        "orientation": orientation,
        "world_from_model": source.world_from_model.matrix().tolist(),
    }
