"""Report of a calibration: self-contained HTML page, plots as PNG, values as JSON."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any

from mpsfm_core.calibration.metrics import NORMAL_COVERAGE
from mpsfm_core.support.files import write_file
from mpsfm_core.support.format_versions import VERSION

_STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; max-width: 62rem; margin: 2rem auto; padding: 0 1rem; }
table { border-collapse: collapse; margin: 0.5rem 0 1.5rem; }
th, td { border-bottom: 1px solid #ddd; padding: 0.2rem 0.9rem 0.2rem 0; text-align: left; }
td { font-variant-numeric: tabular-nums; }
.warning { border-left: 4px solid #b3561d; padding-left: 0.8rem; }
td { overflow-wrap: anywhere; }
svg { max-width: 100%; height: auto; }
"""
_ERRORS = {"depth": "log depth", "normals": "rad"}
_METRICS = {
    "coverage": "within 1 / 2 / 3 std",
    "coverage_of_folds": "within 1 std, of each fold",
    "coverage_without_scaling": "within 1 / 2 / 3 std, without a scale of each image",
    "z_mad": "1.4826 MAD of error / std",
    "nll": "negative log density, normal",
    "nll_heavy": "negative log density, heavy tails",
    "ause": "AUSE",
    "rmse": "RMSE",
}
FORMAT = 1
"""Format version of ``NAME.report.json``."""
_IDEAL = {
    "coverage": NORMAL_COVERAGE,
    "coverage_of_folds": NORMAL_COVERAGE[:1],
    "z_mad": 1.0,
    "ause": 0.0,
}


def write_report(calibration_file: Path, report: Mapping[str, Any]) -> tuple[Path, Path]:
    """Write ``NAME.report.html``, ``.json`` and ``.png`` next to ``NAME.yaml``.

    Without matplotlib, the PNG file is not written and the HTML page explains how to install
    matplotlib.

    Args:
        calibration_file: Calibration file ``NAME.yaml`` or ``NAME.json``.
        report: Report of the calibration study as plain data.

    Returns:
        Paths of the written HTML page and JSON file.
    """
    page = calibration_file.with_suffix(".report.html")
    numbers = calibration_file.with_suffix(".report.json")
    svg, png = _plots(report)
    write_file(page, _page(report, svg))
    write_file(numbers, json.dumps({VERSION: FORMAT, **report}, indent=2) + "\n")
    if png is not None:
        write_file(calibration_file.with_suffix(".report.png"), png)
    return page, numbers


def _page(report: Mapping[str, Any], plots: str) -> str:
    made = report["provenance"]
    title = f"Calibration of {report['kind']} by {made['provider']}"
    parts = [
        f"<h1>{escape(title)}</h1>",
        f"<p>{escape(_abstract(report))}</p>",
        *(f'<p class="warning">{escape(text)}</p>' for text in report["warnings"]),
        "<h2>Values</h2>",
        _table(("", "before", "after", "95 % interval", "largest for"), _values(report)),
        f"<h2>Cross-validation ({report['folds']} folds)</h2>",
        _table(("", "before", "after", "ideal"), _metrics(report["metrics"])),
        plots,
        f"<h2>By {escape(report['place'])}</h2>",
        _table(("from", "to", "pixels", "std", "before", "after", "z after"), _ranges(report)),
        "<h2>Models tried</h2>",
        "<p>A model is selected if it improves the log density over the previous selection by more "
        "than two standard errors over the images.</p>",
        _table(("model", "log density", "gain", "standard error", "chosen"), _candidates(report)),
        *_rounds(report),
        "<h2>Provenance</h2>",
        _table((), [(key, _text(value)) for key, value in made.items() if key != "metrics"]),
    ]
    head = f'<meta charset="utf-8"><title>{escape(title)}</title><style>{_STYLE}</style>'
    return (
        f"<!DOCTYPE html>\n<html><head>{head}</head><body>\n"
        + "\n".join(parts)
        + "\n</body></html>\n"
    )


def _abstract(report: Mapping[str, Any]) -> str:
    made = report["provenance"]
    text = (
        f"Fitted to {report['samples']} pixels of {made['images']} images ({made['data']}); "
        f"compared with {made['truth']}. "
        f"{report['gross_errors']:.1%} of the errors are gross and not part of the std."
    )
    scale = report["scale"]
    if scale is None:
        return text
    return (
        f"{text} The std is that of depth after each image was given its own scale, as the mapper "
        f"does. True over predicted depth is {scale['median']:.3f} in the median image, and its "
        f"log has a std of {scale['log_spread']:.3f} over the images. Without "
        f"scale estimation, add this std."
    )


def _values(report: Mapping[str, Any]) -> Iterable[Sequence[str]]:
    before, after = (report["calibration"][when] for when in ("before", "after"))
    for name in after:
        interval = report["intervals_95"].get(name, [])
        share = report["largest_term"].get(name)
        largest = "" if share is None else f"{share:.0%} of the pixels"
        yield name, _text(before[name]), _text(after[name]), _text(interval), largest


def _metrics(metrics: Mapping[str, Mapping[str, Any]]) -> Iterable[Sequence[str]]:
    for name, label in _METRICS.items():
        if name in metrics["after"]:
            ideal = _text(_IDEAL.get(name, ""))
            yield label, *(_text(metrics[when][name]) for when in ("before", "after")), ideal


def _ranges(report: Mapping[str, Any]) -> Iterable[Sequence[str]]:
    before, after = (report["metrics"][when]["by_range"] for when in ("before", "after"))
    for old, new in zip(before, after, strict=False):
        shares = (_text(old["coverage"]), _text(new["coverage"]))
        columns = (new["from"], new["to"], new["samples"], new["std"])
        yield *map(_text, columns), *shares, _text(new["z_mad"])


def _candidates(report: Mapping[str, Any]) -> Iterable[Sequence[str]]:
    for candidate in report["candidates"]:
        numbers = (candidate[key] for key in ("log_density", "gain", "standard_error"))
        yield candidate["name"], *map(_text, numbers), "yes" if candidate["chosen"] else ""


def _rounds(report: Mapping[str, Any]) -> Iterable[str]:
    """Format the results of each self-calibration round as text."""
    rounds = report.get("rounds", [])
    if rounds:
        rows = [
            (str(number), f"{one['change']:.1%}", _text(one["calibration"]))
            for number, one in enumerate(rounds, start=1)
        ]
        yield "<h2>Reconstructions</h2>"
        yield _table(("round", "change of the median std", "values"), rows)


def _plots(report: Mapping[str, Any]) -> tuple[str, bytes | None]:
    """Return the plots as HTML text and PNG bytes (the PNG is None without matplotlib)."""
    try:
        from mpsfm_core.calibration.plots import draw_plots
    except ImportError:
        return "<p>The plots require matplotlib: pip install 'mpsfm-core[report]'</p>", None
    return draw_plots(report["metrics"], report["place"], _ERRORS[report["kind"]])


def _table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    cells = "".join(f"<th>{escape(text)}</th>" for text in head)
    lines = [f"<tr>{cells}</tr>"] if head else []
    for row in rows:
        lines.append("<tr>" + "".join(f"<td>{escape(text)}</td>" for text in row) + "</tr>")
    return "<table>\n" + "\n".join(lines) + "\n</table>"


def _text(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, Mapping):
        return ", ".join(f"{key}: {_text(content)}" for key, content in value.items())
    if isinstance(value, (list, tuple)):
        return " / ".join(map(_text, value))
    return "" if value is None else str(value)
