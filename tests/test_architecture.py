"""The arrows between the rooms run one way, as docs/architecture.md draws them."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "mpsfm_core"
FRONT_DOOR = "__init__"
"""Imports the rooms when one of its functions is called, see there."""
NUMERICS = {"optimize", "scene", "mapping", "dense"}
BELOW_NUMERICS = {
    "errors",
    "options",
    "jit",
    "threads",
    "data",
    "geometry",
    "statistics",
    "patch_alignment",
    *NUMERICS,
}


def documented_rooms() -> dict[str, int]:
    """Each room with the number of its row in the table."""
    text = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| (`.*?) \|", text, re.MULTILINE)
    return {name: row for row, cell in enumerate(rows) for name in re.findall(r"`(\w+)`", cell)}


def modules() -> Iterator[tuple[str, Path]]:
    """Every module with its room."""
    for path in sorted(PACKAGE.rglob("*.py")):
        parts = path.relative_to(PACKAGE).with_suffix("").parts
        if "templates" not in parts and parts != (FRONT_DOOR,):
            yield parts[0], path


def imported_rooms(path: Path) -> Iterator[str]:
    """The rooms that a module imports from; the options of a room are settings, not the room."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        names: list[str] = []
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module == "mpsfm_core":
            names = [f"mpsfm_core.{alias.name}" for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module:
            names = [node.module]
        for name in names:
            package, *parts = name.split(".")
            if package == "mpsfm_core" and parts:
                yield "options" if parts[1:] == ["options"] else parts[0]


def test_every_room_is_in_the_table() -> None:
    assert {room for room, _ in modules()} == documented_rooms().keys()


@pytest.mark.parametrize("room", documented_rooms())
def test_a_room_imports_only_what_stands_before_it(room: str) -> None:
    rows = documented_rooms()
    upwards = {
        f"{path.relative_to(ROOT)} imports {other}"
        for name, path in modules()
        if name == room
        for other in imported_rooms(path)
        if rows[other] > rows[room]
    }
    assert not upwards


@pytest.mark.parametrize("room", sorted(NUMERICS))
def test_the_numerics_know_no_plugin(room: str) -> None:
    known = {other for name, path in modules() if name == room for other in imported_rooms(path)}
    assert known <= BELOW_NUMERICS
