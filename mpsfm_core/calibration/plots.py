"""Plots of a calibration report; requires matplotlib (``mpsfm-core[report]``)."""

from __future__ import annotations

import io
from collections.abc import Callable, Mapping
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from mpsfm_core.calibration.metrics import NORMAL_COVERAGE

BEFORE, AFTER, IDEAL = "#b3561d", "#1f6f8b", "#888888"
Metrics = Mapping[str, Any]


def draw_plots(metrics: Mapping[str, Metrics], place: str, error: str) -> tuple[str, bytes]:
    """Draw plots of the metrics before and after calibration as SVG element and PNG file.

    Args:
        metrics: Metrics of the declared calibration (``before``) and of the fitted calibration
            (``after``).
        place: Axis label of the quantity that groups errors, depth or slant.
        error: Axis label of the errors with their unit.
    """
    panels: tuple[Callable[[Axes, Mapping[str, Metrics]], None], ...] = (
        _sensitivity,
        _calibration,
        _coverage,
        _ranges,
    )
    # A fixed hash salt and no date make the SVG and PNG files reproducible.
    with mpl.rc_context({"svg.hashsalt": "mpsfm", "font.size": 9, "svg.fonttype": "none"}):
        figure = Figure(figsize=(10, 7.5), layout="constrained")
        for axes, panel in zip(figure.subplots(2, 2).flat, panels, strict=True):
            panel(axes, metrics)
            axes.grid(alpha=0.3)
            axes.legend(frameon=False)
        labels = figure.axes
        labels[1].set(xlabel=f"declared std ({error})", ylabel=f"actual spread ({error})")
        labels[3].set_xlabel(place)
        svg, png = io.StringIO(), io.BytesIO()
        figure.savefig(svg, format="svg", metadata={"Date": None})
        figure.savefig(png, format="png", dpi=150)
    text = svg.getvalue()
    return text[text.index("<svg") :], png.getvalue()


def _sensitivity(axes: Axes, metrics: Mapping[str, Metrics]) -> None:
    for when, color in (("before", BEFORE), ("after", AFTER)):
        curve, area = metrics[when]["sensitivity"], metrics[when]["ause"]
        axes.plot(curve["recall"], curve["predicted"], color, label=f"{when} (AUSE {area:.3f})")
    curve = metrics["after"]["sensitivity"]
    axes.plot(curve["recall"], curve["ideal"], IDEAL, ls="--", label="by true error")
    axes.set(xlabel="ratio of pixels, most certain first", ylabel="RMSE / RMSE of all")
    axes.set_title("Sensitivity")


def _calibration(axes: Axes, metrics: Mapping[str, Metrics]) -> None:
    largest = 0.0
    for when, color in (("before", BEFORE), ("after", AFTER)):
        bins = metrics[when]["calibration_curve"]
        std = [b["std"] for b in bins]
        axes.plot(std, [b["robust_std"] for b in bins], color, marker="o", ms=4, label=when)
        axes.plot(std, [b["rmse"] for b in bins], color, marker="x", ms=4, lw=0.7, ls=":")
        largest = max(largest, *std, *(b["robust_std"] for b in bins))
    axes.plot([0, largest], [0, largest], IDEAL, ls="--", label="ideal")
    axes.set_title("Calibration (line: 1.4826 MAD, dotted: RMSE)")


def _coverage(axes: Axes, metrics: Mapping[str, Metrics]) -> None:
    for when, color, offset in (("before", BEFORE, -0.18), ("after", AFTER, 0.18)):
        shares = metrics[when]["coverage"]
        axes.bar([k + offset for k in (1, 2, 3)], shares, 0.34, color=color, label=when)
    sigmas = np.arange(1, 4)
    axes.hlines(NORMAL_COVERAGE, sigmas - 0.4, sigmas + 0.4, IDEAL, ls="--", label="normal")
    axes.set(xlabel="standard deviations", ylabel="ratio of errors within", xticks=(1, 2, 3))
    axes.set_title("Coverage on held-out images")


def _ranges(axes: Axes, metrics: Mapping[str, Metrics]) -> None:
    for when, color in (("before", BEFORE), ("after", AFTER)):
        bins = metrics[when]["by_range"]
        middle = [(b["from"] + b["to"]) / 2 for b in bins]
        axes.plot(middle, [b["coverage"][0] for b in bins], color, marker="o", ms=4, label=when)
    axes.axhline(NORMAL_COVERAGE[0], color=IDEAL, ls="--", label="ideal")
    axes.set(ylim=(0, 1), ylabel="ratio within 1 std")
    axes.set_title("Coverage by range")
