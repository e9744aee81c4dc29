"""COLMAP's model as text."""

from __future__ import annotations

from pathlib import Path

from mpsfm_core.results.colmap_model import write_model
from mpsfm_core.results.exports.source import ExportSource

ENTRIES = ("cameras.txt", "images.txt", "points3D.txt", "rigs.txt", "frames.txt")


def write(source: ExportSource, folder: Path) -> None:
    """Write the text files of the model of the original photos."""
    write_model(folder, source.model, text=True)
