"""Command-line options shared by several commands."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, TypeAlias

import typer

PhotosOrVideo: TypeAlias = Annotated[
    Path, typer.Argument(help="Folder of photos or of videos, or a video.")
]
ImageList: TypeAlias = Annotated[
    Path | None, typer.Option(metavar="FILE", help="Use only these photos, one name per line.")
]
ConfigName: TypeAlias = Annotated[
    str,
    typer.Option(
        "--config", metavar="NAME_OR_FILE", help="Use a shipped configuration or a YAML file."
    ),
]
Overrides: TypeAlias = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="KEY=VALUE", help="Change a setting, e.g. runtime.workers=2."),
]
Offline: TypeAlias = Annotated[
    bool, typer.Option("--offline", help="Download nothing; use only local files.")
]
Quiet: TypeAlias = Annotated[
    bool, typer.Option("--quiet", "-q", help="Print errors only: no progress, no summary.")
]
Distances: TypeAlias = Annotated[
    list[float] | None,
    typer.Option(
        "--distance",
        metavar="D",
        min=1e-6,
        help="Add a distance threshold for the cloud, in the unit of the truth; may be repeated. "
        "Default: 1 to 50 cm.",
    ),
]
ViewerName: TypeAlias = Annotated[
    str | None,
    typer.Option("--viewer", metavar="NAME", help="Show the run in a viewer: viser or rerun."),
]


def config_overrides(overrides: list[str] | None, offline: bool) -> list[str]:
    """Convert the options ``--set`` and ``--offline`` to configuration overrides."""
    return [*(overrides or ()), *(["runtime.offline=true"] if offline else [])]


def distance_thresholds(distances: list[float] | None) -> tuple[float, ...]:
    """Return the sorted, unique thresholds of ``--distance``, or the default thresholds."""
    from mpsfm_core.evaluation.cloud_accuracy import TOLERANCES

    return tuple(sorted(set(distances or TOLERANCES)))


def parse_overrides(overrides: list[str] | None) -> dict[str, Any]:
    """Parse the ``--set KEY=VALUE`` options of a command to a dictionary.

    Raises:
        ConfigError: A ``--set`` option does not have the form ``KEY=VALUE``.
    """
    from mpsfm_core.support.yaml_text import parse_assignment

    values: dict[str, Any] = {}
    for text in overrides or ():
        values |= parse_assignment(text)
    return values
