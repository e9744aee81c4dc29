"""Tests of the prose: docstrings start with a sentence, and rejected words are not used."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.support.prose import docstrings, sentences_of

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("mpsfm_core", "plugins")
FRAGMENT = re.compile(r"(Of|By|As|To|What|How|Whether|With|Where|Which|Beside|From|Who)\b")
PRIVATE = re.compile(
    r"\b(beside|anew|reseat\w*|outgrow\w*|upkeep|weak holds?|failure ladder|as far as|"
    r"is to be had|that counts which|workbench)\b",
    re.IGNORECASE,
)
MAX_FIRST_LINE = 90


def python_files() -> list[Path]:
    """List the modules of the core and of the plugins."""
    files = (path for package in PACKAGES for path in (ROOT / package).rglob("*.py"))
    return sorted(path for path in files if "templates" not in path.parts)


def pages() -> list[Path]:
    """List the pages that users read."""
    return sorted([*ROOT.glob("*.md"), *(ROOT / "docs").glob("*.md")])


def first_lines(path: Path) -> Iterator[tuple[int, str]]:
    """Yield the first lines of the docstrings of modules, classes and functions."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)):
            text = ast.get_docstring(node)
            if text:
                yield getattr(node, "lineno", 1), text.splitlines()[0]


@pytest.mark.parametrize("package", PACKAGES)
def test_docstring_first_line_is_a_short_sentence(package: str) -> None:
    faults = [
        f"{path.relative_to(ROOT)}:{line}: {first}"
        for path in python_files()
        if path.relative_to(ROOT).parts[0] == package
        for line, first in first_lines(path)
        if FRAGMENT.match(first) or len(first) > MAX_FIRST_LINE
    ]
    assert not faults, "\n".join(faults)


def test_no_private_words_in_code_and_docs() -> None:
    faults = [
        f"{sentence.path}:{sentence.line}: {sentence.text}"
        for path in [*python_files(), *pages()]
        for sentence in sentences_of(path, ROOT)
        if PRIVATE.search(sentence.text)
    ]
    assert not faults, "\n".join(faults)


def test_attribute_docstrings_are_found() -> None:
    tree = ast.parse('class A:\n    x: int\n    """Width in pixels."""\n')
    assert [text for _, text in docstrings(tree)] == ["Width in pixels."]
