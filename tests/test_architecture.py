"""Tests that packages import in one direction, in the order of the table in
docs/architecture.md."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "mpsfm_core"
FRONT_DOOR = "__init__"
"""Package ``__init__`` that exports the public functions of :mod:`mpsfm_core.api`."""
NUMERICS = {"optimize", "mapping", "dense"}
BELOW_NUMERICS = {"data", "support", "geometry", *NUMERICS}


def documented_packages() -> dict[str, int]:
    """Map each package of the table to its row; a dotted name is a subpackage with its own row."""
    text = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| (`.*?) \|", text, re.MULTILINE)
    return {name: row for row, cell in enumerate(rows) for name in re.findall(r"`([\w.]+)`", cell)}


def package_of(module: str) -> str:
    """Return the entry of the table that a module (relative to the core) belongs to."""
    parts = module.split(".")
    documented = documented_packages()
    prefixes = [".".join(parts[:length]) for length in range(len(parts), 0, -1)]
    return next((prefix for prefix in prefixes if prefix in documented), parts[0])


def modules() -> Iterator[tuple[str, Path]]:
    """Yield every module with its package."""
    for path in sorted(PACKAGE.rglob("*.py")):
        parts = path.relative_to(PACKAGE).with_suffix("").parts
        if "templates" not in parts and parts != (FRONT_DOOR,):
            yield package_of(".".join(parts)), path


def imported_modules(path: Path) -> Iterator[str]:
    """Yield the imported modules of the core (with the imported name), relative to the core."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        names: list[str] = []
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module:
            names = [f"{node.module}.{alias.name}" for alias in node.names]
        for name in names:
            package, _, module = name.partition(".")
            if package == "mpsfm_core" and module:
                yield module


def imported_packages(path: Path) -> Iterator[str]:
    """Yield the packages that a module imports from, except the options of a package."""
    for module in imported_modules(path):
        yield "data" if module.split(".")[1:2] == ["options"] else package_of(module)


def part_of(package: str, module: str) -> str:
    """Return the module or subpackage directly below a package that contains a module."""
    return module.removeprefix(f"{package}.").partition(".")[0]


def test_table_lists_every_package() -> None:
    assert {package for package, _ in modules()} == documented_packages().keys()


def test_core_has_at_most_18_entries() -> None:
    entries = {path.name for path in PACKAGE.iterdir() if not path.name.startswith("__")}
    assert len(entries - {"py.typed"}) <= 18


@pytest.mark.parametrize("package", documented_packages())
def test_packages_import_only_packages_of_earlier_rows(package: str) -> None:
    rows = documented_packages()
    upwards = {
        f"{path.relative_to(ROOT)} imports {imported}"
        for name, path in modules()
        if name == package
        for imported in imported_packages(path)
        if rows[imported] > rows[package]
    }
    assert not upwards


@pytest.mark.parametrize("package", documented_packages())
def test_modules_and_subpackages_of_a_package_import_without_cycle(package: str) -> None:
    imports: dict[str, set[str]] = {}
    for name, path in modules():
        if name == package:
            part = part_of(package, ".".join(path.relative_to(PACKAGE).with_suffix("").parts))
            imported = {
                part_of(package, module)
                for module in imported_modules(path)
                if package_of(module) == package and module != package
            }
            imports.setdefault(part, set()).update(imported - {part})
    TopologicalSorter(imports).prepare()  # raises CycleError


@pytest.mark.parametrize("package", sorted(NUMERICS))
def test_numerics_import_no_plugin_file_or_configuration(package: str) -> None:
    imported = {
        other for name, path in modules() if name == package for other in imported_packages(path)
    }
    assert imported <= BELOW_NUMERICS
