"""``mpsfm cache``: what is kept on this machine between runs, and less of it."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Annotated

import typer

from mpsfm_core.cli.models import CacheDir

app = typer.Typer(no_args_is_help=True, help="What is kept between runs: size, less of it.")

_DAY_S = 86_400
PARTS = {
    "extraction": "results of providers, computed again when they are missed",
    "mapping": "checkpoints of interrupted runs",
    "weights": "downloaded networks",
}


@app.command()
def show(cache: CacheDir = None) -> None:
    """Show where the cache is and how large its parts are."""
    from mpsfm_core.cli.tables import print_table
    from mpsfm_core.extraction.cache import cache_folder

    folder = cache_folder(cache)
    typer.echo(folder)
    rows = []
    for part, meaning in PARTS.items():
        files = list(_files(folder / part))
        rows.append((part, f"{len(files)}", size_text(sum(s for _, s, _ in files)), meaning))
    print_table(("part", "files", "size", "what it is"), rows)


@app.command()
def prune(
    days: Annotated[
        float, typer.Option("--older-than", min=0, metavar="DAYS", help="Not used for so long.")
    ] = 30,
    weights: Annotated[
        bool, typer.Option("--weights", help="Downloaded networks too; they are fetched again.")
    ] = False,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Only say what would go.")] = False,
    cache: CacheDir = None,
) -> None:
    """Remove what was not used for some time.

    Nothing is lost but time: what a later run misses it computes or fetches again.
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
    typer.echo(f"{verb} {size_text(sum(size for _, size, _ in old))}, {len(old)} files")


def cache_size(folder: Path) -> int:
    """Bytes of all parts."""
    return sum(size for part in PARTS for _, size, _ in _files(folder / part))


def size_text(size: int) -> str:
    """Bytes in words."""
    return f"{size / 1e9:.1f} GB" if size >= 1e9 else f"{size / 1e6:.1f} MB"


def _files(folder: Path) -> Iterator[tuple[Path, int, float]]:
    """Files with their sizes and when they were last used; one that goes meanwhile is left out."""
    for path in sorted(folder.rglob("*")):
        with suppress(OSError):
            if path.is_file():
                found = path.stat()
                yield path, found.st_size, max(found.st_atime, found.st_mtime)


def _remove_empty(folder: Path) -> None:
    for path in sorted(folder.rglob("*"), reverse=True):
        if path.is_dir():
            with suppress(OSError):  # it is not empty
                path.rmdir()
