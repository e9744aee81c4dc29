"""What a result folder holds, so that two runs can be compared."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

_SAME_AGAIN = ("status", "reconstructions", "pairs", "images")
"""Parts of the summary that do not tell the time, nor what came from the cache."""


def content(folder: Path) -> dict[str, str]:
    """SHA-256 of each file by its path; of the summary only what is the same in every run, of the
    report nothing, which tells the time and is made of the other files."""
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
