"""The documentation: its commands are ours, its links lead somewhere, it asks no other server."""

from __future__ import annotations

import importlib.util
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest
import typer.main

from mpsfm_core.cli import build_app

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]


def commands_of(page: Path) -> list[str]:
    """The lines of a page's shell blocks that run mpsfm."""
    text = page.read_text(encoding="utf-8")
    blocks = re.findall(r"^```(?:sh|bash|console)\n(.*?)^```", text, re.MULTILINE | re.DOTALL)
    lines = "".join(blocks).replace("\\\n", " ").splitlines()
    return [line.strip() for line in lines if line.strip().startswith("mpsfm ")]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_commands_are_understood(page: Path) -> None:
    for line in commands_of(page):
        if "..." in line:
            continue
        node, arguments = typer.main.get_command(build_app()), shlex.split(line, comments=True)[1:]
        while hasattr(node, "commands"):
            assert arguments[0] in node.commands, line
            node = node.commands[arguments.pop(0)]
        node.make_context("mpsfm", arguments)


def test_the_first_pages_have_commands() -> None:
    assert len(commands_of(ROOT / "docs" / "first-run.md")) >= 3
    assert len(commands_of(ROOT / "README.md")) >= 3


def test_the_site_builds_and_asks_no_other_server(tmp_path: Path) -> None:
    for module in ("mkdocs", "material", "mkdocstrings"):
        if importlib.util.find_spec(module) is None:
            pytest.skip(f"{module} is not installed: pip install 'mpsfm-core[docs]'")
    built = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(tmp_path)],
        cwd=ROOT,
        capture_output=True,
        text=True,
    )
    assert built.returncode == 0, built.stderr
    assert (tmp_path / "pictures" / "report.jpg").is_file()
    reference = (tmp_path / "reference.html").read_text(encoding="utf-8")
    assert 'id="mpsfm_core.data.DepthPrior"' in reference
    for page in tmp_path.glob("*.html"):
        fetched = re.findall(
            r"<(?:script|img|link)[^>]*(?:src|href)=\"(https?://[^\"]*)", page.read_text()
        )
        assert fetched == [], page.name
