"""``mpsfm cache``: show and delete cached provider results, checkpoints and weights."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Annotated

import typer

from mpsfm_core.cli.models import CacheDir

app = typer.Typer(no_args_is_help=True, help="Show and prune the files that runs reuse.")

_DAY_S = 86_400
PARTS = {
    "extraction": "results of providers, computed again if missing",
    "mapping": "checkpoints of interrupted runs",
    "run": "results of providers without version, kept during a run",
    "weights": "downloaded networks",
}
"""Description of each subfolder of the cache."""


@app.command()
def show(cache: CacheDir = None) -> None:
    """Show the folder of the cache and the size of its parts."""
    from mpsfm_core.cli.tables import print_table
    from mpsfm_core.extraction.cache import cache_folder

    folder = cache_folder(cache)
    typer.echo(folder)
    rows = []
    for part, meaning in PARTS.items():
        files = list(_files(folder / part))
        rows.append((part, f"{len(files)}", format_size(sum(s for _, s, _ in files)), meaning))
    print_table(("part", "files", "size", "content"), rows)


@app.command()
def prune(
    days: Annotated[
        float,
        typer.Option(
            "--older-than", min=0, metavar="DAYS", help="Remove files unused for so many days."
        ),
    ] = 30,
    weights: Annotated[
        bool, typer.Option("--weights", help="Remove downloaded networks, too.")
    ] = False,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Only print sizes.")] = False,
    cache: CacheDir = None,
) -> None:
    """Remove cached files that were not used for some time.

    Later runs compute or download the removed files again.
    """
    from mpsfm_core.extraction.cache import cache_folder

    folder, limit = cache_folder(cache), time.time() - days * _DAY_S
    parts = [part for part in PARTS if weights or part != "weights"]
    old = [f for part in parts for f in _files(folder / part) if f[2] <= limit]
    if not dry_run:
        for path, _, _ in old:
            path.unlink(missing_ok=True)
        for part in parts:
            _remove_empty(folder / part)
    verb = "would free" if dry_run else "freed"
    typer.echo(f"{verb} {format_size(sum(size for _, size, _ in old))}, {len(old)} files")


def cache_size(folder: Path) -> int:
    """Return the total size of a cache folder in bytes."""
    return sum(size for part in PARTS for _, size, _ in _files(folder / part))


def format_size(size: int) -> str:
    """Format a number of bytes in MB or GB."""
    return f"{size / 1e9:.1f} GB" if size >= 1e9 else f"{size / 1e6:.1f} MB"


def _files(folder: Path) -> Iterator[tuple[Path, int, float]]:
    """Yield path, size (bytes) and time of last use of each file in a folder."""
    for path in sorted(folder.rglob("*")):
        with suppress(OSError):
            if path.is_file():
                status = path.stat()
                yield path, status.st_size, max(status.st_atime, status.st_mtime)


def _remove_empty(folder: Path) -> None:
    """Remove the empty subfolders of a folder."""
    for path in sorted(folder.rglob("*"), reverse=True):
        if path.is_dir():
            with suppress(OSError):  # not empty
                path.rmdir()
