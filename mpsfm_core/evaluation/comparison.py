"""Is one benchmark better than another? Differences of AUC and whether they are chance.

Both sides are compared on the sets they share. Intervals are those of a paired bootstrap, which
draws sets with replacement. P-values are those of a randomisation test: if the sides were equal,
each set's results could as well be swapped. (With few sets it is exact, while a bootstrap of eight
rejects 13 % of equal sides at 5 %, as we measured.) Where a bucket has too few sets, image pairs
are drawn and swapped instead, those of the two orders together. Pairs of a set share images, so
that this promises more than new sets would hold; the table says what was drawn.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations, permutations
from pathlib import Path

import numpy as np

from mpsfm_core.data import Float64
from mpsfm_core.data.errors import InputError
from mpsfm_core.evaluation.pose_auc import (
    CONVENTIONS,
    THRESHOLDS_DEG,
    PoseConvention,
    pose_auc,
)
from mpsfm_core.evaluation.records import BenchmarkRecord, read_records

MIN_SETS = 6
"""Fewer sets have too few different resamples to tell a 95 % interval (ours)."""
RESAMPLES = 2000
_CONFIDENCE = 0.95
_ROUNDING = 1e-9


@dataclass(frozen=True)
class AucDifference:
    """Second side minus first, in percent points of AUC.

    ``auc``: threshold -> (first, second). ``interval``: threshold -> 95 % interval of the
    difference. ``p_value``: threshold -> two-sided, share of random swaps that make a difference
    as large.
    ``unit``: what was drawn, ``sets`` or ``pairs``.
    """

    scene: str
    config: str
    bucket: str
    method: str
    sets: int
    unit: str
    auc: Mapping[int, tuple[float, float]]
    interval: Mapping[int, tuple[float, float]]
    p_value: Mapping[int, float]


def read_benchmark(place: str) -> dict[str, list[BenchmarkRecord]]:
    """Records of a benchmark by method; ``DIR``, or ``DIR:METHOD`` for one method, called ``*``."""
    folder, colon, method = place.rpartition(":")
    if not colon or Path(place).is_dir():
        folder, method = place, ""
    sides: dict[str, list[BenchmarkRecord]] = {}
    for record in read_records(Path(folder)):
        sides.setdefault(record.label, []).append(record)
    if not method:
        return sides
    if method not in sides:
        raise InputError(f"{folder}: no method {method!r}; it has {', '.join(sides)}")
    return {"*": sides[method]}


def compare_benchmarks(
    first: Mapping[str, Sequence[BenchmarkRecord]],
    second: Mapping[str, Sequence[BenchmarkRecord]],
    convention: PoseConvention = CONVENTIONS["paper"],
    *,
    resamples: int = RESAMPLES,
    seed: int = 0,
) -> list[AucDifference]:
    """Differences for each scene, configuration, bucket and method that both sides have.

    Raises :class:`InputError` when they share nothing.
    """
    rng = np.random.default_rng(seed)
    differences = []
    for method in first:
        if method not in second:
            continue
        matched = _matched(first[method], second[method])
        for (scene, config, bucket), pairs in matched.items():
            errors = [tuple(_unordered(r, convention) for r in pair) for pair in pairs]
            place = (scene, config, bucket, _name(method, pairs[0]))
            differences.append(_difference(place, errors, convention, resamples, rng))
    if not differences:
        raise InputError("the two benchmarks have no set and method in common")
    return differences


def format_differences(
    differences: Sequence[AucDifference], convention: PoseConvention = CONVENTIONS["paper"]
) -> str:
    """A Markdown table, the convention in words above it."""
    head = ["scene", "bucket", "method", "sets", "drawn"]
    head += [f"AUC@{t}°" for t in THRESHOLDS_DEG]
    lines = [head, ["---"] * len(head)]
    for d in differences:
        cells = [d.scene, d.bucket, d.method, str(d.sets), d.unit]
        for t in THRESHOLDS_DEG:
            (a, b), (low, high) = d.auc[t], d.interval[t]
            cells.append(f"{a:.1f} → {b:.1f} ({low:+.1f} .. {high:+.1f}, p {d.p_value[t]:.2g})")
        lines.append(cells)
    table = "\n".join(f"| {' | '.join(line)} |" for line in lines)
    return (
        f"Pose AUC in percent, convention `{convention.name}`: {convention.description}. "
        "In brackets: 95 % interval of the difference (paired bootstrap), p-value (random swaps)."
        f"\n\n{table}\n"
    )


_Place = tuple[str, str, str, str]
_SetErrors = tuple[Float64, ...]
"""Errors (pairs, orders) of both sides on one set."""


def _matched(
    first: Iterable[BenchmarkRecord], second: Iterable[BenchmarkRecord]
) -> dict[tuple[str, str, str], list[tuple[BenchmarkRecord, BenchmarkRecord]]]:
    """Records of the same set of images, by scene, configuration and bucket."""
    others = {record.name[:3]: record for record in second}
    matched: dict[tuple[str, str, str], list[tuple[BenchmarkRecord, BenchmarkRecord]]] = {}
    for record in first:
        other = others.get(record.name[:3])
        if other is not None and set(other.truth) == set(record.truth):
            place = record.scene, record.config, record.bucket
            matched.setdefault(place, []).append((record, other))
    return matched


def _name(method: str, pair: tuple[BenchmarkRecord, BenchmarkRecord]) -> str:
    return f"{pair[0].label} → {pair[1].label}" if method == "*" else method


def _unordered(record: BenchmarkRecord, convention: PoseConvention) -> Float64:
    """Errors (pairs, orders): those of both orders of a pair in one row."""
    errors = record.errors_deg(convention)
    count = len(record.truth)
    if not convention.ordered:
        return errors[:, None]
    row = {pair: number for number, pair in enumerate(permutations(range(count), 2))}
    rows = [[row[a, b], row[b, a]] for a, b in combinations(range(count), 2)]
    return np.asarray(errors[np.array(rows)])


def _difference(
    place: _Place,
    errors: Sequence[_SetErrors],
    convention: PoseConvention,
    resamples: int,
    rng: np.random.Generator,
) -> AucDifference:
    units = list(errors) if len(errors) >= MIN_SETS else _pairs(errors)
    drawn = _gains((_drawn(units, rng) for _ in range(resamples)), convention)
    swapped = _gains((_swapped(units, rng) for _ in range(resamples)), convention)
    low, high = np.quantile(drawn, [(1 - _CONFIDENCE) / 2, (1 + _CONFIDENCE) / 2], axis=0)
    both = [_areas([side[k] for side in errors], convention) for k in (0, 1)]
    extreme = np.abs(swapped) >= np.abs(both[1] - both[0]) - _ROUNDING
    p_value = (1 + extreme.sum(axis=0)) / (1 + resamples)
    columns = list(enumerate(THRESHOLDS_DEG))
    return AucDifference(
        *place,
        sets=len(errors),
        unit="sets" if len(errors) >= MIN_SETS else "pairs",
        auc={t: (float(both[0][k]), float(both[1][k])) for k, t in columns},
        interval={t: (float(low[k]), float(high[k])) for k, t in columns},
        p_value={t: float(p_value[k]) for k, t in columns},
    )


def _pairs(errors: Sequence[_SetErrors]) -> list[_SetErrors]:
    """The rows of all sets as units of their own."""
    return [
        (a[None], b[None]) for first, second in errors for a, b in zip(first, second, strict=True)
    ]


def _drawn(units: Sequence[_SetErrors], rng: np.random.Generator) -> list[_SetErrors]:
    """As many units, drawn with replacement."""
    return [units[k] for k in rng.integers(len(units), size=len(units))]


def _swapped(units: Sequence[_SetErrors], rng: np.random.Generator) -> list[_SetErrors]:
    """The units, the sides of each swapped with probability one half."""
    flips = rng.integers(2, size=len(units))
    return [unit[::-1] if flip else unit for unit, flip in zip(units, flips, strict=True)]


def _gains(samples: Iterable[Sequence[_SetErrors]], convention: PoseConvention) -> Float64:
    """Second side minus first, (samples, thresholds), in percent points."""
    both = [
        [_areas([unit[k] for unit in sample], convention) for k in (0, 1)] for sample in samples
    ]
    values = np.array(both)
    difference: Float64 = values[:, 1] - values[:, 0]
    return difference


def _areas(errors: Sequence[Float64], convention: PoseConvention) -> Float64:
    """AUC in percent at all thresholds of errors that are pooled."""
    pooled = np.concatenate([values.ravel() for values in errors])
    return 100 * np.array(list(pose_auc(pooled, convention).values()))
