"""Read text files that other programs wrote, with any byte-order mark."""

from __future__ import annotations

import codecs
from pathlib import Path

_ENCODINGS = (
    (codecs.BOM_UTF8, "utf-8-sig"),
    (codecs.BOM_UTF16_LE, "utf-16"),
    (codecs.BOM_UTF16_BE, "utf-16"),
)


def read_text_file(path: Path) -> str:
    """Read a text file in UTF-8, or in the encoding of its byte-order mark.

    Windows editors and PowerShell write UTF-8 and UTF-16 with a byte-order mark.

    Raises:
        OSError: the text file cannot be read.
        UnicodeDecodeError: the file is not text in UTF-8 or the encoding of its byte-order mark.
    """
    data = path.read_bytes()
    encoding = next((name for mark, name in _ENCODINGS if data.startswith(mark)), "utf-8")
    return data.decode(encoding)
