"""Statistical comparison of two benchmark runs by differences of pose AUC.

Two benchmark runs are compared on their common test sets. Confidence intervals come from a paired
bootstrap over test sets. P-values come from a randomization test that swaps the results of the two
benchmark runs in random test sets. If an overlap bucket (test sets of similar overlap) has too few
test sets, image pairs are resampled instead of test sets. Image pairs of a test set share images,
so pair resampling gives too narrow confidence intervals; the comparison table states whether test
sets or image pairs were resampled.
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
"""Minimum number of test sets for a bootstrap over sets, because few sets have few distinct
resamples [ours]."""
RESAMPLES = 2000
"""Number of resamples of the bootstrap and of the randomization test."""
_CONFIDENCE = 0.95
_ROUNDING = 1e-9
"""Tolerance for floating-point rounding when AUC differences are compared."""


@dataclass(frozen=True)
class AucDifference:
    """Difference of pose AUC in percentage points, second benchmark minus first."""

    scene: str
    """Name of the scene."""
    config: str
    """Name of the configuration, or the names of both configurations if they differ."""
    bucket: str
    """Overlap bucket of the test sets, such as ``leq5``."""
    method: str
    """Label of the mapper, with its prior quality."""
    sets: int
    """Number of test sets that both benchmarks have in common."""
    unit: str
    """Resampled unit: ``sets`` or ``pairs``."""
    auc: Mapping[int, tuple[float, float]]
    """Threshold in degrees -> pose AUC in percent of the first and the second benchmark."""
    interval: Mapping[int, tuple[float, float]]
    """Threshold in degrees -> 95 % confidence interval of the AUC difference."""
    p_value: Mapping[int, float]
    """Threshold in degrees -> two-sided p-value of the AUC difference."""


def read_benchmark(place: str) -> dict[str, list[BenchmarkRecord]]:
    """Read the records of a benchmark folder and group the records by method.

    Args:
        place: ``DIR`` for all records of a benchmark, ``DIR:CONFIG`` for one configuration, or
            ``DIR:METHOD`` for one method, whose key in the returned dictionary is ``*``.

    Raises:
        InputError: The folder has no benchmark records, or no such configuration or method.
    """
    folder, colon, name = place.rpartition(":")
    if not colon or Path(place).is_dir():
        folder, name = place, ""
    records = read_records(Path(folder))
    configs = dict.fromkeys(record.config for record in records)
    sides: dict[str, list[BenchmarkRecord]] = {}
    for record in records:
        if name not in configs or record.config == name:
            sides.setdefault(record.label, []).append(record)
    if not name or name in configs:
        return sides
    if name not in sides:
        raise InputError(
            f"{folder}: no configuration or method {name!r}; it has the configurations "
            f"{', '.join(configs)} and the methods {', '.join(sides)}"
        )
    return {"*": sides[name]}


def compare_benchmarks(
    first: Mapping[str, Sequence[BenchmarkRecord]],
    second: Mapping[str, Sequence[BenchmarkRecord]],
    convention: PoseConvention = CONVENTIONS["paper"],
    *,
    resamples: int = RESAMPLES,
) -> list[AucDifference]:
    """Compute the AUC differences for each common scene, configuration, bucket and method.

    If each benchmark has a single configuration, the configurations may differ.

    Args:
        first: Records of the first benchmark by method.
        second: Records of the second benchmark by method.
        convention: Convention of the pose AUC for image pairs, translation sign and integration.
        resamples: Number of resamples.

    Raises:
        InputError: The benchmarks have no test set and method in common.
    """
    rng = np.random.default_rng(0)
    by_config = max(len(_configs(first)), len(_configs(second))) > 1
    differences = []
    for method in first:
        if method not in second:
            continue
        matched = _match_records(first[method], second[method], by_config)
        for (scene, config, bucket), pairs in matched.items():
            errors = [tuple(_unordered_errors(r, convention) for r in pair) for pair in pairs]
            group = (scene, config, bucket, _join(pairs[0][0].label, pairs[0][1].label))
            differences.append(_compute_difference(group, errors, convention, resamples, rng))
    if not differences:
        raise InputError("the two benchmarks have no test set and method in common")
    return differences


def format_differences(
    differences: Sequence[AucDifference], convention: PoseConvention = CONVENTIONS["paper"]
) -> str:
    """Format a Markdown table of AUC differences below the name of the AUC convention."""
    head = ["scene", "configuration", "bucket", "method", "sets", "drawn"]
    head += [f"AUC@{t}°" for t in THRESHOLDS_DEG]
    lines = [head, ["---"] * len(head)]
    for d in differences:
        cells = [d.scene, d.config, d.bucket, d.method, str(d.sets), d.unit]
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


_Group = tuple[str, str, str, str]
"""Key that groups benchmark records by scene, configuration, overlap bucket and method."""
_SetErrors = tuple[Float64, ...]
"""Relative pose errors (pairs, orders) in degrees of both benchmarks on one test set."""


def _match_records(
    first: Iterable[BenchmarkRecord], second: Iterable[BenchmarkRecord], by_config: bool
) -> dict[tuple[str, str, str], list[tuple[BenchmarkRecord, BenchmarkRecord]]]:
    """Match records by scene, test set, image names and, if ``by_config``, configuration."""

    def key(record: BenchmarkRecord) -> tuple[str, str, str]:
        return record.scene, record.config if by_config else "", record.set_name

    others = {key(record): record for record in second}
    matched: dict[tuple[str, str, str], list[tuple[BenchmarkRecord, BenchmarkRecord]]] = {}
    for record in first:
        other = others.get(key(record))
        if other is not None and set(other.truth) == set(record.truth):
            group = record.scene, _join(record.config, other.config), record.bucket
            matched.setdefault(group, []).append((record, other))
    return matched


def _configs(sides: Mapping[str, Sequence[BenchmarkRecord]]) -> set[str]:
    return {record.config for records in sides.values() for record in records}


def _join(first: str, second: str) -> str:
    return first if first == second else f"{first} → {second}"


def _unordered_errors(record: BenchmarkRecord, convention: PoseConvention) -> Float64:
    """Return relative pose errors (pairs, orders) in degrees, one row per image pair."""
    errors = record.errors_deg(convention)
    count = len(record.truth)
    if not convention.ordered:
        return errors[:, None]
    row = {pair: number for number, pair in enumerate(permutations(range(count), 2))}
    rows = [[row[a, b], row[b, a]] for a, b in combinations(range(count), 2)]
    return np.asarray(errors[np.array(rows)])


def _compute_difference(
    group: _Group,
    errors: Sequence[_SetErrors],
    convention: PoseConvention,
    resamples: int,
    rng: np.random.Generator,
) -> AucDifference:
    """Compute AUC difference, bootstrap interval and p-value of records with the same key."""
    units = list(errors) if len(errors) >= MIN_SETS else _split_pairs(errors)
    resampled = _auc_differences((_resample(units, rng) for _ in range(resamples)), convention)
    swapped = _auc_differences((_swap_sides(units, rng) for _ in range(resamples)), convention)
    low, high = np.quantile(resampled, [(1 - _CONFIDENCE) / 2, (1 + _CONFIDENCE) / 2], axis=0)
    both = [_compute_aucs([side[k] for side in errors], convention) for k in (0, 1)]
    extreme = np.abs(swapped) >= np.abs(both[1] - both[0]) - _ROUNDING
    p_value = (1 + extreme.sum(axis=0)) / (1 + resamples)
    columns = list(enumerate(THRESHOLDS_DEG))
    return AucDifference(
        *group,
        sets=len(errors),
        unit="sets" if len(errors) >= MIN_SETS else "pairs",
        auc={t: (float(both[0][k]), float(both[1][k])) for k, t in columns},
        interval={t: (float(low[k]), float(high[k])) for k, t in columns},
        p_value={t: float(p_value[k]) for k, t in columns},
    )


def _split_pairs(errors: Sequence[_SetErrors]) -> list[_SetErrors]:
    """Split the pose errors of all test sets into single image pairs."""
    return [
        (a[None], b[None]) for first, second in errors for a, b in zip(first, second, strict=True)
    ]


def _resample(units: Sequence[_SetErrors], rng: np.random.Generator) -> list[_SetErrors]:
    """Draw a bootstrap sample of test sets or image pairs with replacement."""
    return [units[k] for k in rng.integers(len(units), size=len(units))]


def _swap_sides(units: Sequence[_SetErrors], rng: np.random.Generator) -> list[_SetErrors]:
    """Swap the two benchmarks in each test set (or image pair) with probability 1/2."""
    flips = rng.integers(2, size=len(units))
    return [unit[::-1] if flip else unit for unit, flip in zip(units, flips, strict=True)]


def _auc_differences(
    samples: Iterable[Sequence[_SetErrors]], convention: PoseConvention
) -> Float64:
    """Compute AUC differences (samples, thresholds) in percent, second minus first benchmark."""
    both = [
        [_compute_aucs([unit[k] for unit in sample], convention) for k in (0, 1)]
        for sample in samples
    ]
    values = np.array(both)
    difference: Float64 = values[:, 1] - values[:, 0]
    return difference


def _compute_aucs(errors: Sequence[Float64], convention: PoseConvention) -> Float64:
    """Compute the pose AUC in percent of pooled pose errors at all thresholds."""
    pooled = np.concatenate([values.ravel() for values in errors])
    return 100 * np.array(list(pose_auc(pooled, convention).values()))
