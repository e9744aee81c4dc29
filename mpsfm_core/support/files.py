"""Every write of ours: a file or a set of results is replaced as a whole or not at all.

Whatever ends a process while it writes, what stood there before stays, or what is new is complete;
what a killed run leaves behind is finished or taken away by the next run in the same folder.
"""

from __future__ import annotations

import errno
import importlib
import json
import logging
import os
import shutil
import tempfile
import time
import uuid
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any, BinaryIO

from mpsfm_core.data.errors import InputError, OutputError
from mpsfm_core.support.format_versions import VERSION, check_version

fcntl: Any = None
with suppress(ImportError):  # not on Windows
    fcntl = importlib.import_module("fcntl")

_log = logging.getLogger(__name__)

_SCRATCH = ".mpsfm-"
_TEMPORARY = ".tmp"
_GRACE_S = 60.0
"""A younger file may be one that its writer has not locked yet."""
_READY = "ready.json"
FORMAT = 1
"""Of what a scratch folder says of the exchange that it was made for."""
_FULL = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG}
_NO_LOCKS = {errno.ENOTSUP, errno.ENOSYS, errno.EBADF, errno.EINVAL, errno.ENOLCK}


def write_file(
    path: Path, content: bytes | str | Callable[[BinaryIO], None], temporary: Path | None = None
) -> None:
    """Write a file as a whole or not at all; its folder is made. Raises :class:`OSError`.

    ``content``: bytes, a text (as UTF-8), or what writes into an open file. ``temporary``: folder
    on the same disk that holds the file until it is complete, by default its own.
    """
    folder = temporary or path.parent
    for needed in (folder, path.parent):
        needed.mkdir(parents=True, exist_ok=True)
    unfinished = folder / f".{uuid.uuid4().hex}{_TEMPORARY}"
    try:
        with unfinished.open("xb") as file:
            _mark_in_use(file)
            if callable(content):
                content(file)
            else:
                file.write(content.encode() if isinstance(content, str) else content)
            file.flush()
            os.fsync(file.fileno())
            unfinished.replace(path)
    except BaseException:
        with suppress(OSError):
            unfinished.unlink()
        raise


def remove_temporary_files(folder: Path) -> None:
    """Take away what killed processes left of :func:`write_file` in its ``temporary`` folder."""
    for path in folder.glob(f".*{_TEMPORARY}"):
        with suppress(OSError), path.open("rb") as file:
            if time.time() - path.stat().st_mtime > _GRACE_S and not _is_in_use(file):
                path.unlink()


@contextmanager
def lock_output_folder(output: Path) -> Iterator[None]:
    """Have an output folder to oneself, made if need be and found writable.

    What an earlier run that was killed left there is finished or taken away. A folder that was made
    for nothing is gone again in the end.

    Raises:
        InputError: ``output`` cannot be a folder or cannot be written, or another run has it.
        OutputError: the disk is full or fails.
    """
    created = _make(output)
    try:
        with ExitStack() as stack:
            with _explained(output):
                if stack.enter_context(_lock(output)):
                    _clear_up(output)
                with _scratch(output):
                    pass
            yield
    finally:
        _remove_empty(created)


@contextmanager
def replace_entries(output: Path, entries: tuple[str, ...]) -> Iterator[Path]:
    """A scratch folder whose content takes the place of ``output``'s ``entries`` on success.

    ``entries``: names below ``output`` that belong to us. When the block ends well, the old ones
    are taken away and what the block wrote takes their place, by renaming; nothing else in
    ``output`` is touched. When it fails, or is interrupted, ``output`` is as it was before. When
    the process is killed amid the renaming, the next :func:`lock_output_folder` finishes it.

    Raises:
        InputError: ``output`` cannot be a folder or cannot be written.
        OutputError: the disk is full or fails.
    """
    created = _make(output)
    try:
        with _explained(output), _scratch(output) as own:
            fresh = own / "new"
            fresh.mkdir()
            (own / "old").mkdir()
            yield fresh
            _sync(fresh)
            new = sorted(entry.name for entry in fresh.iterdir())
            plan = {VERSION: FORMAT, "entries": entries, "new": new}
            write_file(own / _READY, json.dumps(plan))
            _swap(output, own)
    except BaseException:
        _remove_empty(created)
        raise


def _swap(output: Path, own: Path) -> None:
    """Renames only, undone in reverse when one fails; goes on where an earlier one was killed."""
    entries, new = _plan(own)
    fresh, old = own / "new", own / "old"
    remaining = sorted(entry.name for entry in fresh.iterdir())
    moves = []
    if remaining == new:  # else all old entries have gone, as they go first
        moves = [(output / name, old / name) for name in entries]
        moves = [(source, target) for source, target in moves if source.exists()]
    moves += [(fresh / name, output / name) for name in remaining]
    done: list[tuple[Path, Path]] = []
    try:
        for source, target in moves:
            source.rename(target)
            done.append((source, target))
    except BaseException:
        for source, target in reversed(done):
            target.rename(source)
        raise
    (own / _READY).unlink()


def _plan(own: Path) -> tuple[list[str], list[str]]:
    """Names that are to go from the output folder, and those that are to come.

    Raises :class:`InputError` unless we wrote it: a folder that came from elsewhere may name files
    anywhere.
    """
    path = own / _READY
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        check_version(content, FORMAT, path)
        entries, new = list(content["entries"]), list(content["new"])
        if any(Path(name).name != name or name in ("", "..") for name in (*entries, *new)):
            raise ValueError("names what is not in the folder")
        if any((own / part).is_symlink() for part in ("new", "old")):
            raise ValueError("leads elsewhere")
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError) as error:
        raise InputError(
            f"{path}: no run of ours left this ({error}); remove {own} if you know where it is from"
        ) from error
    return entries, new


def _clear_up(output: Path) -> None:
    """Finish or take away what killed runs left; the caller is alone in the folder."""
    for own in output.glob(f"{_SCRATCH}*"):
        if own.is_symlink() or not own.is_dir():
            continue  # not ours
        if (own / _READY).is_file() and (own / "new").is_dir():
            _log.warning("%s: finishing what a killed run was about to put in place", output)
            _swap(output, own)
        shutil.rmtree(own)


@contextmanager
def _lock(folder: Path) -> Iterator[bool]:
    """Lock a folder until the end of the block or of the process; yields whether that is possible.

    The folder itself is locked, so that no file need be left in it. Some network disks and Windows
    do not know such locks: there runs are not kept apart, and leftovers stay.
    """
    if fcntl is None:
        yield False
        return
    handle = os.open(folder, os.O_RDONLY)
    try:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            alone = True
        except OSError as error:
            if error.errno not in _NO_LOCKS:
                if isinstance(error, BlockingIOError):
                    raise InputError(
                        f"{folder}: another run is writing its results there; wait for its end or "
                        f"choose another output folder"
                    ) from error
                raise
            alone = False
        yield alone
    finally:
        os.close(handle)


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
    """A temporary folder below ``output``, on the same disk."""
    own = Path(tempfile.mkdtemp(prefix=_SCRATCH, dir=output))
    try:
        yield own
    finally:
        shutil.rmtree(own, ignore_errors=True)  # what stays is taken away by the next run


@contextmanager
def _explained(output: Path) -> Iterator[None]:
    """Errors of the disk as errors that say what to do."""
    try:
        yield
    except OSError as error:
        what = error.strerror or str(error)
        if error.errno in (errno.EACCES, errno.EPERM, errno.EROFS):
            raise InputError(f"{output}: cannot be written: {what}") from error
        full = "the disk is full" if error.errno in _FULL else "the disk fails"
        raise OutputError(f"{output}: {full} ({what}); earlier results are unchanged") from error


def _sync(folder: Path) -> None:
    """Have the disk hold every file, before anything old goes."""
    for path in folder.rglob("*"):
        if path.is_file():
            with path.open("rb") as file:
                os.fsync(file.fileno())


def _mark_in_use(file: BinaryIO) -> None:
    if fcntl is not None:
        with suppress(OSError):
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)


def _is_in_use(file: BinaryIO) -> bool:
    """Whether a living process writes the file; yes where that cannot be told."""
    if fcntl is None:
        return True
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return True
    return False
