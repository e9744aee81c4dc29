"""Tests that the example notebooks run, pass mypy, and print plausible numbers."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

EXAMPLES = Path(__file__).parents[2] / "examples"
NOTEBOOKS = sorted(path.stem for path in EXAMPLES.glob("*.ipynb"))
MAX_CODE_LINES = 40


def cells(name: str) -> list[dict[str, Any]]:
    notebook = json.loads((EXAMPLES / f"{name}.ipynb").read_text(encoding="utf-8"))
    found: list[dict[str, Any]] = notebook["cells"]
    return found


def code(name: str) -> list[str]:
    """Return the lines of code of a notebook, without magic commands."""
    sources = ["".join(cell["source"]) for cell in cells(name) if cell["cell_type"] == "code"]
    lines = "\n".join(sources).splitlines()
    return [line for line in lines if line.strip() and not line.startswith("%")]


@pytest.mark.parametrize("name", NOTEBOOKS)
def test_notebook_is_short_and_has_outputs(name: str) -> None:
    assert len(code(name)) < MAX_CODE_LINES
    assert any(cell.get("outputs") for cell in cells(name))
    assert (EXAMPLES / f"{name}.ipynb").stat().st_size < 200_000


def test_notebooks_use_only_public_names() -> None:
    for name in NOTEBOOKS:
        assert not [line for line in code(name) if "mpsfm_core." in line], name


@pytest.mark.slow
def test_examples_pass_strict_mypy(tmp_path: Path) -> None:
    for name in NOTEBOOKS:
        (tmp_path / f"{name}.py").write_text("\n".join(code(name)))
    options = ["--strict", "--allow-untyped-calls", "--cache-dir", str(tmp_path / "cache")]
    options += ["--config-file", str(EXAMPLES.parent / "pyproject.toml")]
    package = EXAMPLES / "third-party-depth" / "ridge_depth"
    for path in (*(tmp_path / f"{name}.py" for name in NOTEBOOKS), package):
        run = [sys.executable, "-m", "mypy", *options, str(path)]
        ended = subprocess.run(run, capture_output=True, text=True, cwd=EXAMPLES.parent)
        assert ended.returncode == 0, ended.stdout


@pytest.mark.slow
@pytest.mark.parametrize("name", NOTEBOOKS)
def test_notebook_runs(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("ipykernel")
    nbformat, nbclient = (pytest.importorskip(module) for module in ("nbformat", "nbclient"))
    monkeypatch.setenv("MPSFM_OFFLINE", "1")
    monkeypatch.setenv("MPSFM_CACHE", str(tmp_path / "cache"))
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(EXAMPLES.parent), *sys.path]))
    shutil.copytree(EXAMPLES / "sample_scene", tmp_path / "sample_scene")
    notebook = nbformat.read(EXAMPLES / f"{name}.ipynb", as_version=4)
    where = {"metadata": {"path": str(tmp_path)}}
    nbclient.NotebookClient(notebook, timeout=600, resources=where).execute()
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", ())]
    assert outputs
    assert not [output for output in outputs if output.output_type == "error"]
