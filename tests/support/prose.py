"""Extract the sentences of docstrings, comments, messages and Markdown files."""

from __future__ import annotations

import ast
import inspect
import io
import re
import tokenize
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

_BREAK = re.compile(r"(?<=[.!?:;])\s+(?=[A-Z`\"(])")
_MARKDOWN_NOISE = re.compile(
    r"^```(?s:.*?)^```|^\|.*$|^#.*$|^\s*[-*] *$|^\[[^]]+\]: .*$|<[^>\n]+>|^ {4,}.*$", re.M
)
_PARAGRAPH = re.compile(r"(?s:.+?)(?=\n\s*\n|\n\s*[-*] |\n\d+\. |\Z)")


class Sentence(NamedTuple):
    """One sentence with its source: a path, a line, and the kind of text."""

    path: str
    line: int
    kind: str
    text: str


def docstrings(tree: ast.Module) -> Iterator[tuple[int, str]]:
    """Yield the line and text of every docstring, those of attributes and constants included."""
    for node in ast.walk(tree):
        body = getattr(node, "body", [])
        for statement in body if isinstance(body, list) else []:
            if (
                isinstance(statement, ast.Expr)
                and isinstance(statement.value, ast.Constant)
                and isinstance(statement.value.value, str)
            ):
                yield statement.lineno, statement.value.value


def split_docstring(text: str) -> Iterator[str]:
    """Yield the paragraphs, list items and section items of a docstring, without code."""
    for paragraph in re.split(r"\n\s*\n", inspect.cleandoc(text)):
        if all(line.startswith("    ") for line in paragraph.splitlines()):
            continue  # a command or code
        yield from re.split(
            r"^\w+:\n    |\n    (?=\w+: )|(?:^|\n)(?:[*-]|\d+\.) (?=[A-Z`:])", paragraph
        )


def messages(tree: ast.Module) -> Iterator[tuple[int, str]]:
    """Yield the line and text of every message that is raised, warned or logged."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Raise) and isinstance(node.exc, ast.Call):
            arguments = node.exc.args
        elif isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute):
            arguments = node.args if node.func.attr in {"warning", "warn", "info"} else []
        else:
            continue
        for argument in arguments:
            if isinstance(argument, ast.Constant) and isinstance(argument.value, str):
                yield argument.lineno, argument.value
            elif isinstance(argument, ast.JoinedStr):
                parts = (
                    part.value if isinstance(part, ast.Constant) else "..."
                    for part in argument.values
                )
                yield argument.lineno, "".join(map(str, parts))


def comments(source: str) -> Iterator[tuple[int, str]]:
    """Yield the first line and text of every comment; adjacent comment lines are one comment."""
    block: list[str] = []
    start = last = 0
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.COMMENT:
            line, text = token.start[0], token.string.lstrip("#! ")
            if block and line == last + 1:
                block.append(text)
            else:
                if block:
                    yield start, " ".join(block)
                block, start = [text], line
            last = line
    if block:
        yield start, " ".join(block)


def split_sentences(text: str) -> list[str]:
    """Split running text into sentences of at least four words."""
    flat = re.sub(r"\s+", " ", text).strip()
    return [part for part in _BREAK.split(flat) if len(part.split()) >= 4]


def sentences_of(path: Path, root: Path) -> Iterator[Sentence]:
    """Yield the sentences of a Python or Markdown file."""
    name, source = path.relative_to(root).as_posix(), path.read_text(encoding="utf-8")
    texts: list[tuple[str, int, str]] = []
    if path.suffix == ".py":
        tree = ast.parse(source)
        texts += [
            ("docstring", line, part)
            for line, text in docstrings(tree)
            for part in split_docstring(text)
        ]
        texts += [("message", line, text) for line, text in messages(tree)]
        texts += [("comment", line, text) for line, text in comments(source)]
    else:
        # Noise is replaced by as many line breaks, so that line numbers stay those of the file.
        prose = _MARKDOWN_NOISE.sub(lambda noise: "\n" * noise[0].count("\n"), source)
        for part in _PARAGRAPH.finditer(prose):
            indent = len(part[0]) - len(part[0].lstrip())
            line = prose.count("\n", 0, part.start() + indent) + 1
            texts.append(("markdown", line, re.sub(r"^\s*(?:[-*]|\d+\.) ", "", part[0])))
    for kind, line, text in texts:
        for sentence in split_sentences(text):
            yield Sentence(name, line, kind, sentence)
