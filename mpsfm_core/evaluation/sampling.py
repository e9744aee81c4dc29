"""Sets of images with little overlap, sampled as in the paper (appendix, low-overlap evaluation).

A set starts with a random image. An image is added when it has enough two-view overlap with some
member and no triplet that it completes has more three-view overlap than the bucket allows; the set
is finished when no image can be added. Sets of a bucket differ by two images or more. The same
overlap and seed give the same sets.

The paper lets a minimal set also take images of more overlap when those lead to new ones of none,
to span a whole scene. Ours do not: a minimal set is minimal throughout.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import combinations
from types import MappingProxyType
from typing import Any

import numpy as np

from mpsfm_core.evaluation.overlap import Overlap

LIMITS: Mapping[str, float] = MappingProxyType(
    {"minimal": 0.01, "leq5": 0.05, "leq10": 0.10, "leq30": 0.30}
)
"""Bucket -> largest three-view overlap (paper; minimal means none, up to rounding)."""
TRIPLETS: Mapping[str, tuple[float, float]] = MappingProxyType(
    {
        "0": (0.0, 0.0),
        "0-5": (0.0, 0.05),
        "5-10": (0.05, 0.10),
        "10-20": (0.10, 0.20),
        "20-40": (0.20, 0.40),
        "40+": (0.40, 1.0),
    }
)
"""Group of triplets -> three-view overlap, above the first and up to the second (paper)."""


@dataclass(frozen=True)
class SamplingOptions:
    """How sets are sampled.

    ``min_two_view``: overlap an image needs with some member. ``sets``: of each bucket, twice as
    many minimal ones (paper: 5 and 10). ``min_images``: of a set (paper: 5). ``max_images``: None
    for no limit. ``attempts``: starts for each wanted set.
    """

    min_two_view: float = 0.25
    sets: int = 5
    min_images: int = 5
    max_images: int | None = None
    attempts: int = 20
    seed: int = 0


def sample_buckets(overlap: Overlap, options: SamplingOptions | None = None) -> dict[str, Any]:
    """All buckets in the form of ``testsets.yaml``; those without a set are left out."""
    options = options or SamplingOptions()
    buckets: dict[str, Any] = {}
    for number, (bucket, limit) in enumerate(LIMITS.items()):
        rng = np.random.default_rng([options.seed, number])
        wanted = options.sets * (2 if bucket == "minimal" else 1)
        sets = _distinct(_grow_many(overlap, limit, options, rng, wanted), wanted)
        if sets:
            buckets[bucket] = [_described(overlap, members) for members in sets]
    triplets = sample_triplets(overlap, options)
    if triplets:
        buckets["triplets"] = triplets
    buckets["all"] = [{"images": list(overlap.names)}]
    return buckets


def sample_triplets(overlap: Overlap, options: SamplingOptions) -> dict[str, list[list[str]]]:
    """Group -> triplets of which one view overlaps enough with both others."""
    rng = np.random.default_rng([options.seed, len(LIMITS)])
    linked = overlap.two_view >= options.min_two_view
    np.fill_diagonal(linked, False)
    found: dict[str, dict[frozenset[int], None]] = {name: {} for name in TRIPLETS}
    centers = np.flatnonzero(linked.sum(axis=1) >= 2)
    tries = options.attempts * options.sets * len(TRIPLETS) * 10 if len(centers) else 0
    for _ in range(tries):
        center = int(rng.choice(centers))
        a, b = map(int, rng.choice(np.flatnonzero(linked[center]), 2, replace=False))
        group = _group(overlap.three_view(center, a, b))
        if len(found[group]) < options.sets:
            found[group][frozenset((center, a, b))] = None
        if all(len(triplets) == options.sets for triplets in found.values()):
            break
    return {
        group: [[overlap.names[i] for i in sorted(triplet)] for triplet in triplets]
        for group, triplets in found.items()
        if triplets
    }


def _group(three_view: float) -> str:
    return next(name for name, (_, high) in TRIPLETS.items() if three_view <= high)


def _grow_many(
    overlap: Overlap, limit: float, options: SamplingOptions, rng: np.random.Generator, wanted: int
) -> Iterator[frozenset[int]]:
    """Sets that are large enough, as many starts as allowed."""
    for _ in range(options.attempts * wanted):
        members = _grow(overlap, limit, options, rng)
        if len(members) >= options.min_images:
            yield frozenset(members)


def _grow(
    overlap: Overlap, limit: float, options: SamplingOptions, rng: np.random.Generator
) -> list[int]:
    """One set: candidates in random order, again and again until none can be added.

    An image that exceeds the limit once does so for good, as members only become more.
    """
    order = [int(i) for i in rng.permutation(len(overlap))]
    members, waiting = order[:1], order[1:]
    added = True
    while added:
        added = False
        for candidate in list(waiting):
            if len(members) == options.max_images:
                return members
            if overlap.two_view[candidate, members].max() < options.min_two_view:
                continue
            waiting.remove(candidate)
            if all(
                overlap.three_view(candidate, a, b) <= limit for a, b in combinations(members, 2)
            ):
                members.append(candidate)
                added = True
    return members


def _distinct(sets: Iterator[frozenset[int]], wanted: int) -> list[frozenset[int]]:
    """The first sets that differ from each other by two images or more."""
    chosen: list[frozenset[int]] = []
    for members in sets:
        if all(max(len(members - other), len(other - members)) >= 2 for other in chosen):
            chosen.append(members)
        if len(chosen) == wanted:
            break
    return chosen


def _described(overlap: Overlap, members: frozenset[int]) -> dict[str, Any]:
    ordered = sorted(members)
    three = max(overlap.three_view(*triplet) for triplet in combinations(ordered, 3))
    two = max(float(overlap.two_view[a, b]) for a, b in combinations(ordered, 2))
    return {
        "images": [overlap.names[i] for i in ordered],
        "max_three_view_overlap": round(three, 4),
        "max_two_view_overlap": round(two, 4),
    }
