"""Draw sentences at random for a reader who judges whether they are understandable alone.

    python -m benchmarks.readability --seed 1

Each kind of prose (docstring, comment, message, docs, changelog) gets a number of sentences in
proportion to its share of words. The same seed and the same files give the same sentences.
"""

from __future__ import annotations

from collections import defaultdict
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from tests.support.prose import Sentence, sentences_of

ROOT = Path(__file__).resolve().parents[1]
CODE_FOLDERS = ("mpsfm_core", "plugins", "benchmarks")
DOCUMENT_PATTERNS = ("*.md", "docs/*.md", "plugins/*/README.md", "examples/*/README.md")
CHANGELOG = "CHANGELOG.md"


def collect_sentences(root: Path) -> dict[str, list[Sentence]]:
    """Collect the sentences of docstrings, comments, messages and Markdown files.

    Args:
        root: Folder of the repository.

    Returns:
        The sentences of each kind of prose, ordered by file and line.
    """
    paths = [path for folder in CODE_FOLDERS for path in sorted((root / folder).rglob("*.py"))]
    paths += [path for pattern in DOCUMENT_PATTERNS for path in sorted(root.glob(pattern))]
    by_kind: dict[str, list[Sentence]] = defaultdict(list)
    for path in paths:
        if {"tests", "templates", "node_modules"} & set(path.relative_to(root).parts):
            continue
        for sentence in sentences_of(path, root):
            kind = sentence.kind
            if kind == "markdown":
                kind = "changelog" if path.name == CHANGELOG else "docs"
            by_kind[kind].append(sentence)
    return dict(sorted(by_kind.items()))


def allocate_draws(sentences: dict[str, list[Sentence]], num: int) -> dict[str, int]:
    """Divide the number of drawn sentences among the kinds of prose by their share of words.

    Args:
        sentences: All sentences of the repository, by kind of prose.
        num: Total number of sentences to draw.

    Returns:
        The number of sentences to draw of each kind, at least one; their sum is `num`
        (largest-remainder method).
    """
    words = {
        kind: sum(len(sentence.text.split()) for sentence in group)
        for kind, group in sentences.items()
    }
    shares = {kind: num * count / sum(words.values()) for kind, count in words.items()}
    draws = {kind: max(1, int(share)) for kind, share in shares.items()}
    by_remainder = sorted(shares, key=lambda kind: draws[kind] - shares[kind])
    for kind in by_remainder[: max(0, num - sum(draws.values()))]:
        draws[kind] += 1
    return {kind: min(count, len(sentences[kind])) for kind, count in draws.items()}


def draw_sentences(root: Path, num: int, seed: int) -> list[tuple[str, Sentence]]:
    """Draw sentences of the repository at random without replacement, in random order.

    Args:
        root: Folder of the repository.
        num: Number of sentences to draw at random.
        seed: Seed of the random generator.

    Returns:
        Pairs of the kind of prose and the drawn sentence.
    """
    rng = np.random.default_rng(seed)
    sentences = collect_sentences(root)
    drawn = [
        (kind, sentences[kind][index])
        for kind, count in allocate_draws(sentences, num).items()
        for index in rng.choice(len(sentences[kind]), count, replace=False)
    ]
    return [drawn[index] for index in rng.permutation(len(drawn))]


def main(
    seed: Annotated[int, typer.Option(help="Seed of the draw.")] = 1,
    num: Annotated[int, typer.Option(help="Number of sentences.")] = 60,
) -> None:
    """Print the drawn sentences with number, kind of prose, file and line."""
    for number, (kind, sentence) in enumerate(draw_sentences(ROOT, num, seed), start=1):
        print(f"{number:3}. {sentence.text}\n     [{kind}, {sentence.path}:{sentence.line}]")


if __name__ == "__main__":
    typer.run(main)
