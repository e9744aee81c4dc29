"""Sampling of image sets with little overlap, after the paper's low-overlap evaluation.

Test sets are sampled for buckets, each with a maximum three-view overlap. A test set starts with a
random image. An image is added if its two-view overlap with an image of the set is sufficient and
no triplet exceeds the three-view overlap of the bucket. A test set is complete when no image can be
added. Test sets of a bucket differ by at least two images. The sampling is deterministic for the
same image overlap and random seed.

In contrast to the paper, all triplets of a set in the bucket ``minimal`` satisfy the overlap limit.
The paper adds images of higher overlap to the sets of ``minimal``, to span a whole scene.
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
"""Maximum three-view overlap of each bucket [paper, appendix]; the bucket minimal allows 0 up to
rounding."""
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
"""Range of three-view overlap of each group of image triplets, upper bound included [paper,
appendix]."""


@dataclass(frozen=True)
class SamplingOptions:
    """Options for the sampling of test sets."""

    min_two_view: float = 0.25
    """Minimum two-view overlap of an added image with at least one image of the test set."""
    sets: int = 5
    """Number of test sets per bucket; the bucket minimal has twice as many [paper: 5 and 10]."""
    min_images: int = 5
    """Minimum number of images of a test set [paper]."""
    max_images: int | None = None
    """Maximum number of images of a test set, or None for no limit."""
    attempts: int = 20
    """Number of random start images that are tried per requested test set."""
    seed: int = 0
    """Random seed for the sampling of test sets."""


def sample_buckets(overlap: Overlap, options: SamplingOptions | None = None) -> dict[str, Any]:
    """Sample test sets for the overlap buckets of ``testsets.yaml``; omit empty buckets."""
    options = options or SamplingOptions()
    buckets: dict[str, Any] = {}
    for number, (bucket, limit) in enumerate(LIMITS.items()):
        rng = np.random.default_rng([options.seed, number])
        count = options.sets * (2 if bucket == "minimal" else 1)
        sets = _select_distinct(_grow_sets(overlap, limit, options, rng, count), count)
        if sets:
            buckets[bucket] = [_describe_set(overlap, members) for members in sets]
    triplets = sample_triplets(overlap, options)
    if triplets:
        buckets["triplets"] = triplets
    buckets["all"] = [{"images": list(overlap.names)}]
    return buckets


def sample_triplets(overlap: Overlap, options: SamplingOptions) -> dict[str, list[list[str]]]:
    """Sample image triplets by three-view overlap, in which one image overlaps with both others."""
    rng = np.random.default_rng([options.seed, len(LIMITS)])
    linked = overlap.two_view >= options.min_two_view
    np.fill_diagonal(linked, False)
    groups: dict[str, dict[frozenset[int], None]] = {name: {} for name in TRIPLETS}
    centers = np.flatnonzero(linked.sum(axis=1) >= 2)
    attempts = options.attempts * options.sets * len(TRIPLETS) * 10 if len(centers) else 0
    for _ in range(attempts):
        center = int(rng.choice(centers))
        a, b = map(int, rng.choice(np.flatnonzero(linked[center]), 2, replace=False))
        group = _triplet_group(overlap.three_view(center, a, b))
        if len(groups[group]) < options.sets:
            groups[group][frozenset((center, a, b))] = None
        if all(len(triplets) == options.sets for triplets in groups.values()):
            break
    return {
        group: [[overlap.names[i] for i in sorted(triplet)] for triplet in triplets]
        for group, triplets in groups.items()
        if triplets
    }


def _triplet_group(three_view: float) -> str:
    return next(name for name, (_, high) in TRIPLETS.items() if three_view <= high)


def _grow_sets(
    overlap: Overlap, limit: float, options: SamplingOptions, rng: np.random.Generator, count: int
) -> Iterator[frozenset[int]]:
    """Yield test sets with enough images from a limited number of random starts."""
    for _ in range(options.attempts * count):
        members = _grow_set(overlap, limit, options, rng)
        if len(members) >= options.min_images:
            yield frozenset(members)


def _grow_set(
    overlap: Overlap, limit: float, options: SamplingOptions, rng: np.random.Generator
) -> list[int]:
    """Add random images to a test set until no image satisfies the overlap limits.

    A rejected image is not tested again, because images are never removed from the set.
    """
    order = [int(i) for i in rng.permutation(len(overlap))]
    members, candidates = order[:1], order[1:]
    added = True
    while added:
        added = False
        for candidate in list(candidates):
            if len(members) == options.max_images:
                return members
            if overlap.two_view[candidate, members].max() < options.min_two_view:
                continue
            candidates.remove(candidate)
            if all(
                overlap.three_view(candidate, a, b) <= limit for a, b in combinations(members, 2)
            ):
                members.append(candidate)
                added = True
    return members


def _select_distinct(sets: Iterator[frozenset[int]], count: int) -> list[frozenset[int]]:
    """Select the first test sets that differ from each other by at least two images."""
    selected: list[frozenset[int]] = []
    for members in sets:
        if all(max(len(members - other), len(other - members)) >= 2 for other in selected):
            selected.append(members)
        if len(selected) == count:
            break
    return selected


def _describe_set(overlap: Overlap, members: frozenset[int]) -> dict[str, Any]:
    """Return image names and overlap of a test set for ``testsets.yaml``."""
    ordered = sorted(members)
    three = max(overlap.three_view(*triplet) for triplet in combinations(ordered, 3))
    two = max(float(overlap.two_view[a, b]) for a, b in combinations(ordered, 2))
    return {
        "images": [overlap.names[i] for i in ordered],
        "max_three_view_overlap": round(three, 4),
        "max_two_view_overlap": round(two, 4),
    }
