"""Execute the example notebooks and store their outputs, by run_notebooks.py [NAME...]."""

from __future__ import annotations

import base64
import io
import sys
import time
from pathlib import Path

import nbformat
from nbclient import NotebookClient
from PIL import Image

HERE = Path(__file__).parent
COLORS = 48
"""Number of colors of the pictures in notebooks; few colors keep the notebook files small."""


def execute(path: Path) -> nbformat.NotebookNode:
    """Execute a notebook in its folder, and return the notebook with the outputs of its cells."""
    notebook = nbformat.read(path, as_version=4)
    where = {"metadata": {"path": str(path.parent)}}
    NotebookClient(notebook, timeout=600, resources=where).execute()
    notebook.metadata = {"kernelspec": notebook.metadata["kernelspec"]}
    for cell in notebook.cells:
        cell.metadata = {}
        for output in cell.get("outputs", ()):
            if "image/png" in output.get("data", {}):
                output.data["image/png"] = reduce_colors(output.data["image/png"])
    return notebook


def reduce_colors(png: str) -> str:
    """Reduce the colors of a base64-encoded PNG picture."""
    picture = Image.open(io.BytesIO(base64.b64decode(png))).convert("RGB").quantize(COLORS)
    file = io.BytesIO()
    picture.save(file, "PNG", optimize=True)
    return base64.b64encode(file.getvalue()).decode()


def main() -> None:
    """Execute the notebooks named on the command line, or all notebooks, and store the outputs."""
    for path in sorted(HERE.glob("*.ipynb")):
        if len(sys.argv) == 1 or path.stem in sys.argv[1:]:
            started = time.perf_counter()
            nbformat.write(execute(path), path)
            size = path.stat().st_size // 1000
            print(f"{path.stem}: {time.perf_counter() - started:.0f} s, {size} kB")


if __name__ == "__main__":
    main()
