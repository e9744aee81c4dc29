"""Replaces results in a folder as a whole or not at all."""

from __future__ import annotations

import errno
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from mpsfm_core.errors import InputError, OutputError

_FULL = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG}


@contextmanager
def replacing(output: Path, entries: tuple[str, ...]) -> Iterator[Path]:
    """A scratch folder whose content takes the place of ``output``'s ``entries`` on success.

    ``entries``: names below ``output`` that belong to us. When the block ends well, the old ones
    are taken away and what the block wrote takes their place, by renaming; nothing else in
    ``output`` is touched. When it fails, or is interrupted, ``output`` is as it was before.

    Raises:
        InputError: ``output`` cannot be a folder or cannot be written.
        OutputError: the disk is full.
    """
    created = _make(output)
    try:
        with _scratch(output) as own:
            fresh, old = own / "new", own / "old"
            fresh.mkdir()
            old.mkdir()
            yield fresh
            _swap(output, entries, fresh, old)
    except BaseException:
        _remove_empty(created)
        raise


def check_writable(output: Path) -> None:
    """Raise :class:`InputError` now if :func:`replacing` would later; leaves nothing behind."""
    created = _make(output)
    try:
        with _scratch(output):
            pass
    finally:
        _remove_empty(created)


def _swap(output: Path, entries: tuple[str, ...], fresh: Path, old: Path) -> None:
    """Renames only, undone in reverse when one fails."""
    moves = [(output / name, old / name) for name in entries if (output / name).exists()]
    moves += [(entry, output / entry.name) for entry in sorted(fresh.iterdir())]
    done: list[tuple[Path, Path]] = []
    try:
        for source, target in moves:
            source.rename(target)
            done.append((source, target))
    except BaseException:
        for source, target in reversed(done):
            target.rename(source)
        raise


def _make(output: Path) -> list[Path]:
    """Create the folder; returns the folders that did not exist, innermost first."""
    missing = [folder for folder in (output, *output.parents) if not folder.exists()]
    try:
        output.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{output}: cannot be the output folder: {error.strerror}") from error
    return missing


def _remove_empty(folders: list[Path]) -> None:
    for folder in folders:
        with suppress(OSError):
            folder.rmdir()


@contextmanager
def _scratch(output: Path) -> Iterator[Path]:
    """A temporary folder below ``output``, on the same disk; errors of the disk are explained."""
    try:
        with tempfile.TemporaryDirectory(prefix=".mpsfm-", dir=output) as own:
            yield Path(own)
    except OSError as error:
        if error.errno in _FULL:
            raise OutputError(
                f"{output}: the disk is full ({error.strerror}); earlier results are unchanged"
            ) from error
        if isinstance(error, PermissionError):
            raise InputError(f"{output}: cannot be written: {error.strerror}") from error
        raise
