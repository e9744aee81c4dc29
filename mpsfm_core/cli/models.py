"""``mpsfm models``: the weights of networks, on this machine and elsewhere."""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TypeAlias

import typer

from mpsfm_core.cli.arguments import Overrides

if TYPE_CHECKING:
    from mpsfm_core.providers import WeightsFile
    from mpsfm_core.providers.weights import Progress, WeightStore

app = typer.Typer(no_args_is_help=True, help="Weights: list, download, check.")

Targets: TypeAlias = Annotated[
    list[str],
    typer.Argument(
        metavar="NAME_OR_URI...", help="Providers (xfeat, matcher/loftr) or URIs of weights files."
    ),
]
Wanted: TypeAlias = Annotated[
    list[str],
    typer.Argument(
        metavar="NAME_OR_URI...",
        help="Configurations (indoor, my.yaml), providers (xfeat, matcher/loftr) or URIs.",
    ),
]
_RESTRICTED = re.compile(r"\bNC\b|non-?commercial|research", re.IGNORECASE)
"""Licences that forbid commercial use, by their text."""

CacheDir: TypeAlias = Annotated[
    Path | None,
    typer.Option("--cache", metavar="DIR", help="Instead of $MPSFM_CACHE or the user's cache."),
]


@app.command("list")
def list_models(
    as_json: Annotated[bool, typer.Option("--json", help="For scripts.")] = False,
    cache: CacheDir = None,
) -> None:
    """List the default weights of all providers, and whether they are on this machine."""
    from mpsfm_core.cli.tables import print_table
    from mpsfm_core.providers.weights import WeightStore

    store = WeightStore(cache)
    files = [(provider, file, store.locate(file.uri)) for provider, file in _known()]
    if as_json:
        lines = [
            {"provider": provider, **asdict(file), "path": path and str(path)}
            for provider, file, path in files
        ]
        typer.echo(json.dumps(lines, indent=2))
        return
    rows = [
        (provider, file.license, _state(file.uri, path), str(path or file.uri))
        for provider, file, path in files
    ]
    print_table(("provider", "licence", "state", "file"), rows)


@app.command()
def fetch(
    targets: Wanted,
    sha256: Annotated[
        str | None, typer.Option("--sha256", help="Expected hash, for a single URI.")
    ] = None,
    overrides: Overrides = None,
    accepted: Annotated[
        list[str] | None,
        typer.Option(
            "--accept",
            metavar="PROVIDER",
            help="Accept the non-commercial licence of its weights without being asked.",
        ),
    ] = None,
    cache: CacheDir = None,
) -> None:
    """Download weights that are missing, check them, and print where they are.

    Of a configuration all that a run with it needs. What will be downloaded is shown first, with
    licences and the total size; weights that are not for commercial use are asked for by name.
    """
    from mpsfm_core.providers.weights import WeightStore

    wanted = _wanted(targets, overrides or [])
    store = WeightStore(cache)
    for provider in _show_plan(wanted, store):
        _ask_for(provider, accepted or [])
    files = [file for _, file in wanted]
    with _progress_bars() as progress:
        store = WeightStore(cache, progress=progress)
        paths = [store.resolve(file.uri, sha256 or file.sha256) for file in files]
    for path in paths:
        typer.echo(path)


@app.command()
def export(
    name: Annotated[str, typer.Argument(help="dsine, mast3r, metric3d, moge, unidepth.")],
    code: Annotated[
        list[Path],
        typer.Option(
            metavar="CHECKOUT", help="Of the authors' code; again for libraries that it needs."
        ),
    ],
    checkpoint: Annotated[
        str,
        typer.Option(
            metavar="FILE_OR_URI", help="Their weights; 'random' tries the export without."
        ),
    ],
    output: Annotated[
        Path | None, typer.Option(metavar="FILE.onnx", help="Instead of the user's data folder.")
    ] = None,
    size: Annotated[str, typer.Option(help="Of a network that comes in several.")] = "",
    sha256: Annotated[str | None, typer.Option(help="Expected hash of the checkpoint.")] = None,
    environment: Annotated[
        str | None, typer.Option(metavar="NAME", help="Run their code there (mpsfm env create).")
    ] = None,
    cache: CacheDir = None,
) -> None:
    """Make the file of a network that nobody publishes, from its authors' code and weights.

    Their code runs in a process of its own. The file is checked against what their network says,
    and its provider takes it by name from then on.
    """
    from mpsfm_core.data.errors import InputError, did_you_mean
    from mpsfm_core.providers.environments.environment import find_environment
    from mpsfm_core.providers.model_export.export import export_model
    from mpsfm_core.providers.registry import Registry
    from mpsfm_core.providers.weights import WeightStore

    known = {
        n: r for found in Registry.discover().call_hook("mpsfm_exports") for n, r in found.items()
    }
    if name not in known:
        raise InputError(f"no installed plugin exports {name!r}{did_you_mean(name, known)}")
    python = find_environment(environment).python if environment else None
    with _progress_bars() as progress:
        manifest = export_model(
            name,
            known[name],
            code,
            checkpoint,
            output,
            sha256=sha256,
            size=size,
            python=python,
            store=WeightStore(cache, progress=progress),
        )
    worst = max(manifest["largest_differences"].values())
    typer.echo(f"licence of the weights: {manifest['license']}", err=True)
    typer.echo(f"differs from the authors' network by {worst:.1e} at most", err=True)
    typer.echo(manifest["file"])


@app.command()
def verify(
    targets: Annotated[list[str] | None, typer.Argument(metavar="[NAME_OR_URI...]")] = None,
    cache: CacheDir = None,
) -> None:
    """Hash weights and compare; without arguments, all default weights on this machine."""
    from mpsfm_core.providers.weights import WeightStore

    store = WeightStore(cache)
    if targets:
        chosen = _select(targets)
    else:
        chosen = [file for _, file in _known() if store.locate(file.uri)]
    for file in chosen:
        typer.echo(f"{store.verify(file.uri, file.sha256)}  {file.uri}")


@app.command()
def path(targets: Targets, cache: CacheDir = None) -> None:
    """Print where weights are on this machine; fails if they are not."""
    from mpsfm_core.data.errors import WeightsError
    from mpsfm_core.providers.weights import WeightStore

    store = WeightStore(cache)
    for file in _select(targets):
        found = store.locate(file.uri)
        if found is None:
            raise WeightsError(f"{file.uri} is not on this machine; 'mpsfm models fetch' gets it")
        typer.echo(found)


def _known() -> Iterator[tuple[str, WeightsFile]]:
    """Kind and name of each usable provider with each of its default weights files."""
    from mpsfm_core.data.errors import InputError
    from mpsfm_core.providers.registry import Registry

    registry = Registry.discover()
    for status in registry.status():
        if status.available and status.kind != "plugin":
            with suppress(InputError):  # the user has to name the file: there is no default
                for file in registry.weights(status.kind, status.name):
                    yield f"{status.kind}/{status.name}", file


def _select(targets: list[str]) -> list[WeightsFile]:
    """The weights files that names and URIs stand for, each once."""
    from mpsfm_core.data.errors import InputError, did_you_mean
    from mpsfm_core.providers import WeightsFile

    known = [(provider.split("/")[1], provider, file) for provider, file in _known()]
    chosen: dict[str, WeightsFile] = {}
    for target in targets:
        found = [file for name, provider, file in known if target in (name, provider, file.uri)]
        if not found and not _is_uri(target):
            raise InputError(
                f"no provider {target!r} with weights"
                f"{did_you_mean(target, [name for name, _, _ in known])}; "
                f"'mpsfm models list' shows all"
            )
        chosen |= {file.uri: file for file in found or [WeightsFile(target)]}
    return list(chosen.values())


def _wanted(targets: list[str], overrides: list[str]) -> list[tuple[str, WeightsFile]]:
    """The files that configurations, providers and URIs stand for, each once, with the name of a
    provider that loads it."""
    from mpsfm_core.config import load_config, shipped_configs
    from mpsfm_core.pipeline.provider_resolution import preview_providers
    from mpsfm_core.providers.registry import Registry

    chosen: dict[str, tuple[str, WeightsFile]] = {}
    for target in targets:
        if target not in shipped_configs() and not target.endswith((".yaml", ".yml")):
            found = [(target, file) for file in _select([target])]
        else:
            registry = Registry.discover()
            provision = preview_providers(load_config(target, overrides, registry), registry)
            found = [
                (spec.name, file)
                for path, kind, backend in provision.config.provider_configs()
                for spec in [registry.spec(kind, backend.use)]
                for file in registry.weights(kind, backend.use, backend.options)
            ]
        for name, file in found:
            chosen.setdefault(file.uri, (name, file))
    return list(chosen.values())


def _show_plan(wanted: list[tuple[str, WeightsFile]], store: WeightStore) -> list[tuple[str, str]]:
    """Tell on stderr what will be downloaded; the providers whose licence forbids commercial use,
    with that licence."""
    from mpsfm_core.providers.weights import is_remote

    total, unknown, restricted = 0, 0, {}
    for name, file in wanted:
        typer.echo(f"licence of {file.uri}: {file.license}", err=True)
        if not is_remote(file.uri) or store.locate(file.uri) is not None:
            continue
        size = file.size or store.size(file.uri)
        total, unknown = total + (size or 0), unknown + (size is None)
        if _RESTRICTED.search(file.license):
            restricted[name] = file.license
    rest = f", and {unknown} of unknown size" if unknown else ""
    if total or unknown:
        typer.echo(f"to be downloaded: {total / 1e6:.0f} MB{rest}", err=True)
    return list(restricted.items())


def _ask_for(restricted: tuple[str, str], accepted: list[str]) -> None:
    """Raise unless the user accepts a licence that forbids commercial use."""
    from mpsfm_core.data.errors import InputError

    name, license = restricted
    if name in accepted:
        return
    question = f"The weights of {name} are not for commercial use ({license}). To accept, type"
    if not sys.stdin.isatty() or typer.prompt(f"{question} {name}", err=True) != name:
        raise InputError(
            f"the weights of {name} are not for commercial use ({license}): nothing was "
            f"downloaded; '--accept {name}' accepts that"
        )


def _is_uri(target: str) -> bool:
    return ":" in target or Path(target).suffix != "" or Path(target).exists()


def _state(uri: str, path: Path | None) -> str:
    if path:
        return "here"
    return "to be fetched" if "://" in uri else "its package is not installed"


@contextmanager
def _progress_bars() -> Iterator[Progress]:
    """A bar on stderr for each file that is downloaded."""
    from rich.console import Console
    from rich.progress import BarColumn, DownloadColumn, Progress, TextColumn, TransferSpeedColumn

    columns = (TextColumn("{task.description}"), BarColumn(), DownloadColumn())
    bars = Progress(*columns, TransferSpeedColumn(), console=Console(stderr=True))
    tasks = {}

    def show(name: str, done: int, total: int | None) -> None:
        if name not in tasks:
            bars.start()
            tasks[name] = bars.add_task(name)
        bars.update(tasks[name], completed=done, total=total)

    try:
        yield show
    finally:
        if tasks:
            bars.stop()
