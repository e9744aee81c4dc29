"""The version of a file's format, beside its content.

Each format that we define has a number, in the module that reads it. It is raised when a file would
mean something else to its readers than it did before, not when something is added. A file without a
number is of the first version: there were none before. ``docs/formats.md`` lists all.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from mpsfm_core.data.errors import InputError

VERSION = "format_version"
"""Key, or name of the array, that holds it."""


def check_version(
    content: Mapping[str, Any], known: int, path: Path, error: type[InputError] = InputError
) -> int:
    """The version of a file's content, from 1 to ``known``, the newest that can be read.

    Raises ``error`` when the file is newer, or its version is no number.
    """
    found = content.get(VERSION, 1)
    try:
        number = int(found)
    except (TypeError, ValueError, OverflowError):
        number = 0
    if number < 1:
        raise error(f"{path}: its {VERSION} is {str(found)[:60]!r}, not a number from 1 on")
    if number > known:
        raise error(
            f"{path}: is of format {number}, of a newer mpsfm-core; this one reads formats up to "
            f"{known}: pip install --upgrade mpsfm-core, or make the file anew"
        )
    return number
