"""Version numbers of file formats.

The module that reads a file format defines its version number. The version number increases when
the meaning of existing content changes, not when content is added. A file without version number
has version 1. ``docs/formats.md`` lists all formats.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from mpsfm_core.data.errors import InputError

VERSION = "format_version"
"""Key of the version number in YAML and JSON files; name of its array in NPZ files."""


def check_version(
    content: Mapping[str, Any], known: int, path: Path, error: type[InputError] = InputError
) -> int:
    """Check and return the format version of a file's content.

    Args:
        content: Content of the file by key.
        known: Newest format version that the caller can read.
        path: Path of the file, for error messages.
        error: Exception class to raise if the format version cannot be read.

    Raises:
        InputError: the format version is newer than `known` or no number (raised as `error`).
    """
    value = content.get(VERSION, 1)
    try:
        number = int(value)
    except (TypeError, ValueError, OverflowError):
        number = 0
    if number < 1:
        raise error(
            f"file {path}: the key {VERSION!r} is {str(value)[:60]!r}, not a positive integer"
        )
    if number > known:
        raise error(
            f"{path}: the file is of format {number}, written by a newer mpsfm-core; this version "
            f"reads formats up to {known}: pip install --upgrade mpsfm-core, or recreate the file"
        )
    return number
