"""Hashes of the files in a result folder, to compare two runs."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

_SAME_AGAIN = ("status", "reconstructions", "pairs", "images")
"""Parts of the summary that depend neither on run time nor on the cache."""


def content(folder: Path) -> dict[str, str]:
    """Return the SHA-256 of each result file by path.

    Of the summary only reproducible parts count. The report is skipped, because it contains times.
    """
    found = {}
    for path in sorted(folder.rglob("*")):
        name = path.relative_to(folder).as_posix()
        if path.name == "report.html":
            found[name] = ""
        elif path.is_file():
            data = path.read_bytes()
            if path.name == "summary.json" and data.startswith(b"{"):
                summary = json.loads(data)
                data = json.dumps([summary.get(part) for part in _SAME_AGAIN]).encode()
            found[name] = hashlib.sha256(data).hexdigest()
    return found
