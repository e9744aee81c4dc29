"""Options that several commands share."""

from __future__ import annotations

from typing import Annotated, Any, TypeAlias

import typer

ConfigName: TypeAlias = Annotated[
    str,
    typer.Option(
        "--config", metavar="NAME_OR_FILE", help="A shipped configuration or a YAML file."
    ),
]
Overrides: TypeAlias = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="KEY=VALUE", help="Change a setting, e.g. runtime.workers=2."),
]
Offline: TypeAlias = Annotated[
    bool, typer.Option("--offline", help="Download nothing; take what is on this machine.")
]
Quiet: TypeAlias = Annotated[
    bool, typer.Option("--quiet", "-q", help="No progress, no summary; errors only.")
]
Distances: TypeAlias = Annotated[
    list[float] | None,
    typer.Option(
        "--distance",
        metavar="D",
        min=1e-6,
        help="Of the cloud, in the unit of the truth; may be repeated. Default: 1 to 50 cm.",
    ),
]
ViewerName: TypeAlias = Annotated[
    str | None,
    typer.Option("--viewer", metavar="NAME", help="Of a viewer plugin: viser, rerun."),
]


def settings(overrides: list[str] | None, offline: bool) -> list[str]:
    """The settings that the options ``--set`` and ``--offline`` mean."""
    return [*(overrides or ()), *(["runtime.offline=true"] if offline else [])]


def tolerances(distances: list[float] | None) -> tuple[float, ...]:
    """The distances that the options ``--distance`` mean, each once, the smallest first."""
    from mpsfm_core.evaluation.cloud_accuracy import TOLERANCES

    return tuple(sorted(set(distances or TOLERANCES)))


def assigned(overrides: list[str] | None) -> dict[str, Any]:
    """The values that ``--set`` gives to the settings of one command; raises ConfigError."""
    from mpsfm_core.support.yaml_text import parse_assignment

    values: dict[str, Any] = {}
    for text in overrides or ():
        values |= parse_assignment(text)
    return values
