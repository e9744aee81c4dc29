"""Plugin hook that removes image pairs to which an external classifier gave a low score."""

from __future__ import annotations

import csv
import math
import os
from collections.abc import Mapping, Sequence
from pathlib import Path

from mpsfm_core import hookimpl
from mpsfm_core.data.errors import InputError

SCORES_VARIABLE = "MPSFM_PAIR_SCORES"
"""Environment variable with the path of a CSV file of image pairs and scores. If the environment
variable is not set, no image pair is removed.
"""
THRESHOLD_VARIABLE = "MPSFM_PAIR_MIN_SCORE"
"""Environment variable with the minimum score of an image pair."""
DEFAULT_THRESHOLD = 0.8
"""Minimum probability that an image pair is a true match."""

Pair = tuple[str, str]


@hookimpl
def mpsfm_filter_pairs(pairs: Sequence[Pair]) -> Sequence[Pair] | None:
    """Return the image pairs whose score reaches the threshold, and those without a score."""
    path = os.environ.get(SCORES_VARIABLE)
    if not path:
        return None
    scores = read_scores(Path(path))
    threshold = float(os.environ.get(THRESHOLD_VARIABLE, DEFAULT_THRESHOLD))
    return [pair for pair in pairs if scores.get(frozenset(pair), math.inf) >= threshold]


def read_scores(path: Path) -> Mapping[frozenset[str], float]:
    """Read scores by unordered pairs of image names, keeping the lowest of repeated pairs.

    Raises:
        InputError: The CSV file cannot be read, or a line does not have two image names and a
            score.
    """
    scores: dict[frozenset[str], float] = {}
    try:
        with path.open(newline="", encoding="utf-8") as file:
            for number, row in enumerate(csv.reader(file, skipinitialspace=True), start=1):
                if not row or row[0].startswith("#"):
                    continue
                try:
                    first, second, score = row
                    pair = frozenset((first.strip(), second.strip()))
                    scores[pair] = min(float(score), scores.get(pair, math.inf))
                except ValueError as error:
                    text = f"{path}:{number}: expected image, image, score; got {','.join(row)!r}"
                    raise InputError(text) from error
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"${SCORES_VARIABLE}: {path} cannot be read: {error}") from error
    return scores
