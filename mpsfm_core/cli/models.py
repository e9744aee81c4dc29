"""``mpsfm models``: list, download, export and verify the weights of networks."""

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

app = typer.Typer(no_args_is_help=True, help="List, download and verify weights.")

Targets: TypeAlias = Annotated[
    list[str],
    typer.Argument(
        metavar="NAME_OR_URI...", help="Providers (xfeat, matcher/loftr) or URIs of weights files."
    ),
]
FetchTargets: TypeAlias = Annotated[
    list[str],
    typer.Argument(
        metavar="NAME_OR_URI...",
        help="Configurations (indoor, my.yaml), providers (xfeat, matcher/loftr) or URIs.",
    ),
]
_RESTRICTED = re.compile(r"\bNC\b|non-?commercial|research", re.IGNORECASE)
"""Regular expression for names of licenses that forbid commercial use."""

CacheDir: TypeAlias = Annotated[
    Path | None,
    typer.Option(
        "--cache", metavar="DIR", help="Use this cache; default: $MPSFM_CACHE or the user's cache."
    ),
]


@app.command("list")
def list_models(
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
    cache: CacheDir = None,
) -> None:
    """List the default weights of all providers and their local files."""
    from mpsfm_core.cli.tables import print_table
    from mpsfm_core.providers.weights import WeightStore

    store = WeightStore(cache)
    files = [(provider, file, store.locate(file.uri)) for provider, file in _default_weights()]
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
    print_table(("provider", "license", "state", "file"), rows)


@app.command()
def fetch(
    targets: FetchTargets,
    sha256: Annotated[
        str | None, typer.Option("--sha256", help="Require this hash, for a single URI.")
    ] = None,
    overrides: Overrides = None,
    accepted: Annotated[
        list[str] | None,
        typer.Option(
            "--accept",
            metavar="PROVIDER",
            help="Accept the non-commercial license of a provider's weights without a prompt.",
        ),
    ] = None,
    cache: CacheDir = None,
) -> None:
    """Download missing weights, verify them, and print their files.

    For a configuration, download all weights that a run needs. Licenses and the total download size
    are printed first. If a license forbids commercial use, the user must accept the license of each
    provider by name.
    """
    from mpsfm_core.providers.weights import WeightStore

    provider_files = _resolve_targets(targets, overrides or [])
    store = WeightStore(cache)
    for provider in _print_downloads(provider_files, store):
        _require_acceptance(provider, accepted or [])
    files = [file for _, file in provider_files]
    with _progress_bars() as progress:
        store = WeightStore(cache, progress=progress)
        paths = [store.resolve(file.uri, sha256 or file.sha256) for file in files]
    for path in paths:
        typer.echo(path)


@app.command()
def export(
    name: Annotated[
        str, typer.Argument(help="Network: dsine, mast3r, metric3d, moge or unidepth.")
    ],
    code: Annotated[
        list[Path],
        typer.Option(
            metavar="CHECKOUT", help="Checkout of the authors' code; repeat for its libraries."
        ),
    ],
    checkpoint: Annotated[
        str,
        typer.Option(
            metavar="FILE_OR_URI", help="The authors' weights; 'random' tests the export without."
        ),
    ],
    output: Annotated[
        Path | None,
        typer.Option(metavar="FILE.onnx", help="Write here; default: the user's data folder."),
    ] = None,
    size: Annotated[str, typer.Option(help="Size, if the network has several.")] = "",
    sha256: Annotated[str | None, typer.Option(help="Require this hash of the checkpoint.")] = None,
    environment: Annotated[
        str | None,
        typer.Option(
            metavar="NAME", help="Run the authors' code in this environment (mpsfm env create)."
        ),
    ] = None,
    cache: CacheDir = None,
) -> None:
    """Export a network that is not published as a file, from its authors' code and weights.

    The code of the network's authors runs in a subprocess. The outputs of the exported file are
    compared with those of the authors' network. The network's provider then finds the file by name.
    """
    from mpsfm_core.data.errors import InputError, did_you_mean
    from mpsfm_core.providers.environments.environment import find_environment
    from mpsfm_core.providers.model_export.export import export_model
    from mpsfm_core.providers.registry import Registry
    from mpsfm_core.providers.weights import WeightStore

    known = {
        key: recipe
        for exports in Registry.discover().call_hook("mpsfm_exports")
        for key, recipe in exports.items()
    }
    if name not in known:
        raise InputError(
            f"no installed plugin exports the network {name!r}{did_you_mean(name, known)}"
        )
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
    max_difference = max(manifest["largest_differences"].values())
    typer.echo(f"license of the weights: {manifest['license']}", err=True)
    typer.echo(f"maximum difference to the authors' network: {max_difference:.1e}", err=True)
    typer.echo(manifest["file"])


@app.command()
def verify(
    targets: Annotated[list[str] | None, typer.Argument(metavar="[NAME_OR_URI...]")] = None,
    cache: CacheDir = None,
) -> None:
    """Verify the hashes of weights files, by default of all local default weights."""
    from mpsfm_core.providers.weights import WeightStore

    store = WeightStore(cache)
    if targets:
        files = _select_files(targets)
    else:
        files = [file for _, file in _default_weights() if store.locate(file.uri)]
    for file in files:
        typer.echo(f"{store.verify(file.uri, file.sha256)}  {file.uri}")


@app.command()
def path(targets: Targets, cache: CacheDir = None) -> None:
    """Print the local paths of weights files; fail if a weights file is missing."""
    from mpsfm_core.data.errors import WeightsError
    from mpsfm_core.providers.weights import WeightStore

    store = WeightStore(cache)
    for file in _select_files(targets):
        local = store.locate(file.uri)
        if local is None:
            raise WeightsError(f"{file.uri} is not on this machine; run 'mpsfm models fetch' first")
        typer.echo(local)


def _default_weights() -> Iterator[tuple[str, WeightsFile]]:
    """Yield (kind/name of provider, weights file) for all default weights files."""
    from mpsfm_core.data.errors import InputError
    from mpsfm_core.providers.registry import Registry

    registry = Registry.discover()
    for status in registry.status():
        if status.available and status.kind != "plugin":
            # Providers without default weights raise an InputError and are omitted.
            with suppress(InputError):
                for file in registry.weights(status.kind, status.name):
                    yield f"{status.kind}/{status.name}", file


def _select_files(targets: list[str]) -> list[WeightsFile]:
    """Find the unique weights files of provider names and URIs.

    Raises:
        InputError: A name is neither a provider with weights nor a URI.
    """
    from mpsfm_core.data.errors import InputError, did_you_mean
    from mpsfm_core.providers import WeightsFile

    known = [(provider.split("/")[1], provider, file) for provider, file in _default_weights()]
    selected: dict[str, WeightsFile] = {}
    for target in targets:
        files = [file for name, provider, file in known if target in (name, provider, file.uri)]
        if not files and not _is_uri(target):
            raise InputError(
                f"no provider {target!r} with weights"
                f"{did_you_mean(target, [name for name, _, _ in known])}; "
                f"'mpsfm models list' shows all"
            )
        selected |= {file.uri: file for file in files or [WeightsFile(target)]}
    return list(selected.values())


def _resolve_targets(targets: list[str], overrides: list[str]) -> list[tuple[str, WeightsFile]]:
    """Find the unique pairs (provider, weights file) of configurations, providers and URIs."""
    from mpsfm_core.config import load_config, shipped_configs
    from mpsfm_core.pipeline.provider_resolution import preview_providers
    from mpsfm_core.providers.registry import Registry

    selected: dict[str, tuple[str, WeightsFile]] = {}
    for target in targets:
        if target not in shipped_configs() and not target.endswith((".yaml", ".yml")):
            files = [(target, file) for file in _select_files([target])]
        else:
            registry = Registry.discover()
            provision = preview_providers(load_config(target, overrides, registry), registry)
            files = [
                (spec.name, file)
                for path, kind, backend in provision.config.provider_configs()
                for spec in [registry.spec(kind, backend.use)]
                for file in registry.weights(kind, backend.use, backend.options)
            ]
        for name, file in files:
            selected.setdefault(file.uri, (name, file))
    return list(selected.values())


def _print_downloads(
    files: list[tuple[str, WeightsFile]], store: WeightStore
) -> list[tuple[str, str]]:
    """Print licenses and the total download size on stderr.

    Returns:
        Name and license of each provider whose license forbids commercial use.
    """
    from mpsfm_core.providers.weights import is_remote

    total, unknown, restricted = 0, 0, {}
    for name, file in files:
        typer.echo(f"license of {file.uri}: {file.license}", err=True)
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


def _require_acceptance(restricted: tuple[str, str], accepted: list[str]) -> None:
    """Prompt the user to accept a license that forbids commercial use.

    Raises:
        InputError: The user does not accept the license.
    """
    from mpsfm_core.data.errors import InputError

    name, license = restricted
    if name in accepted:
        return
    question = f"The weights of {name} are not for commercial use ({license}). To accept, type"
    if not sys.stdin.isatty() or typer.prompt(f"{question} {name}", err=True) != name:
        raise InputError(
            f"the weights of {name} are not for commercial use ({license}): nothing was "
            f"downloaded; to accept, add '--accept {name}'"
        )


def _is_uri(target: str) -> bool:
    return ":" in target or Path(target).suffix != "" or Path(target).exists()


def _state(uri: str, path: Path | None) -> str:
    """Describe whether a weights file is local or must be downloaded."""
    if path:
        return "local"
    return "to be downloaded" if "://" in uri else "its package is not installed"


@contextmanager
def _progress_bars() -> Iterator[Progress]:
    """Show a progress bar on stderr for each downloaded file."""
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
