"""Report of a benchmark as Markdown, JSON, and HTML with recall curves."""

from __future__ import annotations

import html
import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mpsfm_core.data import Float64
from mpsfm_core.evaluation.dense_geometry import HELD_OUT_METRICS
from mpsfm_core.evaluation.pose_auc import (
    CONVENTIONS,
    THRESHOLDS_DEG,
    PoseConvention,
    pose_auc,
)
from mpsfm_core.evaluation.records import BenchmarkRecord
from mpsfm_core.support.files import write_file
from mpsfm_core.support.format_versions import VERSION

FORMAT = 1
"""Format version of ``report.json``."""
ALL_SCENES = "all scenes"
"""Scene name in rows with results pooled over all scenes."""
CLOUD_METRICS = ("accuracy", "completeness", "f1")
"""Metrics of a point cloud at a distance threshold, in the order of the table columns."""
_COLORS = ("#1b6ca8", "#d1495b", "#2e8b57", "#e08e0b", "#7b4fa3", "#5c5c5c", "#17a2b8", "#a0522d")
_PLOT = (440, 260)
_RANGE_DEG = 20


_DENSE_NOTE = (
    "Dense geometry: AbsRel of the depth maps in the scale of the cameras; accuracy / "
    "completeness / F1 of the cloud at each distance, percent, as ETH3D defines them, with true "
    "depth as the scan; held out: pixels that the cloud covers, and PSNR and SSIM of its "
    "renderings, at images that the dense stage did not use."
)

GroupKey = tuple[str, str, str, str]
"""Key that groups benchmark records by scene, configuration, overlap bucket and method."""


@dataclass(frozen=True)
class BenchmarkRow:
    """Row of the benchmark report with the results of a method on one overlap bucket."""

    scene: str
    """Name of the scene, or :data:`ALL_SCENES`."""
    config: str
    """Name of the configuration."""
    bucket: str
    """Overlap bucket of the test sets, such as ``leq5``."""
    method: str
    """Label of the mapper, with its prior quality."""
    sets: int
    """Number of test sets."""
    pairs: int
    """Number of verified image pairs."""
    auc: Mapping[int, float]
    """Pose AUC in percent of the pooled errors of all test sets, by threshold in degrees."""
    registered: float
    """Ratio of registered images to images of the test sets."""
    seconds: float
    """Mean wall time per test set in seconds."""
    cpu_seconds: float
    """Mean CPU time per test set in seconds."""
    failed: int
    """Number of test sets on which the method failed."""
    dense: Mapping[str, Any] | None = None
    """Mean accuracy of the dense results, or None without dense evaluation. The keys are ``sets``
    (number of test sets), with true depth ``abs_rel`` (depth error) and the :data:`CLOUD_METRICS`
    with a ratio by distance threshold in meters, and with held-out images
    :data:`~mpsfm_core.evaluation.dense_geometry.HELD_OUT_METRICS`."""

    @property
    def group(self) -> GroupKey:
        """Key of the group of records that the row summarizes."""
        return self.scene, self.config, self.bucket, self.method


def pool_errors(records: Iterable[BenchmarkRecord], convention: PoseConvention) -> Float64:
    """Concatenate the relative pose errors in degrees of all image pairs of benchmark records."""
    return np.concatenate([record.errors_deg(convention) for record in records])


def group_records(records: Iterable[BenchmarkRecord]) -> dict[GroupKey, list[BenchmarkRecord]]:
    """Group benchmark records by scene, configuration, overlap bucket and method.

    The records of several scenes are also pooled as the scene :data:`ALL_SCENES`.
    """
    records = list(records)
    groups: dict[GroupKey, list[BenchmarkRecord]] = {}
    several = len({record.scene for record in records}) > 1
    for scene in (None, ALL_SCENES) if several else (None,):
        for r in records:
            groups.setdefault((scene or r.scene, r.config, r.bucket, r.label), []).append(r)
    return groups


def build_rows(
    records: Iterable[BenchmarkRecord], convention: PoseConvention = CONVENTIONS["paper"]
) -> list[BenchmarkRow]:
    """Compute the rows of the report table in the order of the records."""
    rows = []
    for key, group in group_records(records).items():
        areas = pose_auc(pool_errors(group, convention), convention)
        images = sum(len(record.truth) for record in group)
        rows.append(
            BenchmarkRow(
                *key,
                sets=len(group),
                pairs=sum(record.pairs for record in group),
                auc={threshold: 100 * area for threshold, area in areas.items()},
                registered=sum(len(record.estimated) for record in group) / images,
                seconds=float(np.mean([record.seconds for record in group])),
                cpu_seconds=float(np.mean([record.cpu_seconds for record in group])),
                failed=sum(bool(record.error) for record in group),
                dense=_mean_dense([record.dense for record in group if record.dense]),
            )
        )
    return rows


def _mean_dense(sets: Sequence[Mapping[str, Any]]) -> dict[str, Any] | None:
    if not sets:
        return None
    means: dict[str, Any] = {"sets": len(sets)}
    with_truth = [each for each in sets if "depth" in each]
    if with_truth:
        means["abs_rel"] = float(np.mean([each["depth"]["abs_rel"] for each in with_truth]))
        for key in CLOUD_METRICS:
            clouds = [each["cloud"][key] for each in with_truth]
            means[key] = {d: float(np.mean([cloud[d] for cloud in clouds])) for d in clouds[0]}
    for key in HELD_OUT_METRICS:
        values = [each["held_out"][key] for each in sets if "held_out" in each]
        known = [value for value in values if value is not None]
        if known:
            means[key] = float(np.mean(known))
    return means


def format_markdown(
    rows: Sequence[BenchmarkRow], convention: PoseConvention = CONVENTIONS["paper"]
) -> str:
    """Format one Markdown table per scene and configuration below the AUC convention."""
    parts = [f"Pose AUC in percent, convention `{convention.name}`: {convention.description}."]
    if any(row.dense for row in rows):
        parts.append(_DENSE_NOTE)
    for scene, config in dict.fromkeys((row.scene, row.config) for row in rows):
        parts.append(f"### {scene}, configuration `{config}`")
        head, *cells = _lines([row for row in rows if (row.scene, row.config) == (scene, config)])
        lines = [head, ["---"] * 3 + ["---:"] * (len(head) - 3), *cells]
        parts.append("\n".join(f"| {' | '.join(line)} |" for line in lines))
    return "\n\n".join(parts) + "\n"


def list_failures(records: Iterable[BenchmarkRecord]) -> list[str]:
    """Return a text line with the error message of each failed benchmark run."""
    return [f"{' / '.join(record.name)}: {record.error}" for record in records if record.error]


def write_report(output: Path, records: Sequence[BenchmarkRecord]) -> None:
    """Write ``report.md``, ``report.json`` (with all AUC conventions) and ``report.html``."""
    convention = CONVENTIONS["paper"]
    rows, failed = build_rows(records), list_failures(records)
    text = format_markdown(rows, convention)
    if failed:
        text += "\n### Failed\n\n" + "".join(f"- {line}\n" for line in failed)
    write_file(output / "report.md", text)
    content = {
        name: {
            "description": other.description,
            "auc_unit": "percent",
            "rows": [asdict(row) for row in build_rows(records, other)],
        }
        for name, other in CONVENTIONS.items()
    }
    errors = [[*record.name, record.error] for record in records if record.error]
    text = json.dumps({VERSION: FORMAT, "conventions": content, "errors": errors}, indent=1)
    write_file(output / "report.json", text + "\n")
    write_file(output / "report.html", _page(rows, records, convention))


def _lines(rows: Sequence[BenchmarkRow]) -> list[list[str]]:
    """Return header and cells of the report table, with columns for dense evaluation if present."""
    head = ["bucket", "sets", "method", *(f"AUC@{t}°" for t in THRESHOLDS_DEG)]
    head += ["registered", "CPU s / set", "failed"]
    dense = [row.dense for row in rows if row.dense]
    distances = list(dict.fromkeys(d for each in dense for d in each.get("f1", ())))
    if distances:
        head += ["AbsRel", *(f"{d} m" for d in distances)]
    held_out = any("covered" in each for each in dense)
    if held_out:
        head += ["held out: covered", "PSNR, dB", "SSIM"]
    lines = [head]
    for row in rows:
        cells = _cells(row)
        cells += _dense_cells(row, distances) if distances else []
        cells += _held_out_cells(row) if held_out else []
        lines.append(cells)
    return lines


def _cells(row: BenchmarkRow) -> list[str]:
    areas = [f"{row.auc[t]:.1f}" for t in THRESHOLDS_DEG]
    rest = [f"{row.registered:.0%}", f"{row.cpu_seconds:.2f}", str(row.failed or "")]
    return [row.bucket, str(row.sets), row.method, *areas, *rest]


def _dense_cells(row: BenchmarkRow, distances: Sequence[str]) -> list[str]:
    if row.dense is None or "abs_rel" not in row.dense:
        return [""] * (1 + len(distances))
    means = row.dense
    shares = [
        " / ".join(f"{100 * means[key].get(d, np.nan):.0f}" for key in CLOUD_METRICS)
        for d in distances
    ]
    return [f"{means['abs_rel']:.3f}", *shares]


def _held_out_cells(row: BenchmarkRow) -> list[str]:
    means = row.dense or {}
    formats = zip(HELD_OUT_METRICS, (".0%", ".1f", ".2f"), strict=True)
    return [format(means[key], spec) if key in means else "" for key, spec in formats]


def _page(
    rows: Sequence[BenchmarkRow], records: Sequence[BenchmarkRecord], convention: PoseConvention
) -> str:
    """Build a self-contained HTML page with a result table and recall curves per bucket."""
    parts = [
        "<!doctype html><meta charset='utf-8'><title>Benchmark</title>",
        "<style>body{font:14px sans-serif;margin:2em}td,th{padding:2px 10px;text-align:right}"
        "td:first-child,th:first-child{text-align:left}</style>",
        f"<p>Pose AUC in percent, convention {html.escape(convention.name)}: "
        f"{html.escape(convention.description)}.</p>",
    ]
    if any(row.dense for row in rows):
        parts.append(f"<p>{html.escape(_DENSE_NOTE)}</p>")
    groups = group_records(records)
    for place in dict.fromkeys((row.scene, row.config, row.bucket) for row in rows):
        here = [row for row in rows if (row.scene, row.config, row.bucket) == place]
        parts.append(f"<h3>{html.escape(', '.join(place))}</h3>")
        parts.append(_table(here))
        curves = {}
        for row in here:
            curves[row.method] = pool_errors(groups[row.group], convention)
        parts.append(_curves(curves))
    if failed := list_failures(records):
        lines = "".join(f"<li>{html.escape(line)}</li>" for line in failed)
        parts.append(f"<h3>Failed</h3><ul>{lines}</ul>")
    return "\n".join(parts) + "\n"


def _table(rows: Sequence[BenchmarkRow]) -> str:
    head, *cells = _lines(rows)
    lines = ["".join(f"<th>{cell}</th>" for cell in head[2:])]
    lines += ["".join(f"<td>{html.escape(c)}</td>" for c in line[2:]) for line in cells]
    return "<table>" + "".join(f"<tr>{line}</tr>" for line in lines) + "</table>"


def _curves(errors: Mapping[str, Float64]) -> str:
    """Draw recall curves of pose errors as SVG."""
    width, height = _PLOT
    shapes = _axes()
    for number, (method, values) in enumerate(errors.items()):
        color = _COLORS[number % len(_COLORS)]
        below = np.sort(values[values <= _RANGE_DEG])
        across = np.concatenate([[0.0], np.repeat(below, 2), [_RANGE_DEG]]) * (width / _RANGE_DEG)
        recall = np.repeat(np.arange(len(below) + 1), 2) / len(values)
        points = " ".join(
            f"{a:.1f},{height * (1 - b):.1f}"
            for a, b in zip(across.tolist(), recall.tolist(), strict=True)
        )
        shapes.append(f"<polyline points='{points}' fill='none' stroke='{color}'/>")
        y = 16 + 16 * number
        shapes.append(f"<text x='{width + 12}' y='{y}' fill='{color}'>{html.escape(method)}</text>")
    return (
        f"<svg viewBox='-60 -10 {width + 300} {height + 60}' width='{width + 300}' "
        f"height='{height + 60}' font-size='12'>{''.join(shapes)}</svg>"
    )


def _axes() -> list[str]:
    """Draw frame, grid and labels of a recall plot as SVG elements."""
    width, height = _PLOT
    shapes = [f"<rect width='{width}' height='{height}' fill='none' stroke='#999'/>"]
    for degrees in range(0, _RANGE_DEG + 1, 5):
        x = degrees / _RANGE_DEG * width
        shapes.append(f"<path d='M{x:g} 0V{height}' stroke='#ddd'/>")
        shapes.append(f"<text x='{x:g}' y='{height + 16}' text-anchor='middle'>{degrees}°</text>")
    for percent in range(0, 101, 25):
        y = height * (1 - percent / 100)
        shapes.append(f"<path d='M0 {y:g}H{width}' stroke='#ddd'/>")
        shapes.append(f"<text x='-6' y='{y + 4:g}' text-anchor='end'>{percent}%</text>")
    middle = f"x='{width / 2:g}' y='{height + 36}' text-anchor='middle'"
    rotated = f"transform='translate(-46 {height / 2:g}) rotate(-90)' text-anchor='middle'"
    shapes.append(f"<text {middle}>error of a pair up to</text>")
    shapes.append(f"<text {rotated}>ratio of pairs</text>")
    return shapes
