"""``mpsfm benchmark``: compare configurations and other mappers with true poses."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from mpsfm_core.cli.arguments import Distances, Overrides, Quiet, distance_thresholds

if TYPE_CHECKING:
    from mpsfm_core.evaluation.records import BenchmarkRecord


def benchmark(
    scenes: Annotated[
        list[Path] | None, typer.Argument(metavar="SCENE...", help="Scene folders.")
    ] = None,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", metavar="DIR", help="Write the results here.")
    ] = None,
    configs: Annotated[
        list[str] | None,
        typer.Option(
            "--config", metavar="NAME_OR_FILE", help="Run a configuration; may be repeated."
        ),
    ] = None,
    sets: Annotated[
        str | None, typer.Option(metavar="A,B", help="Use only these buckets of test sets.")
    ] = None,
    prior: Annotated[
        str,
        typer.Option(
            metavar="A,B",
            help="Choose the depth: sensor (gt_depth), degraded (gt_depth with the errors of a "
            "network; degraded-1, ... use other seeds) or config (the configuration's provider).",
        ),
    ] = "config",
    peers: Annotated[
        str | None,
        typer.Option(
            metavar="A,B", help="Run other mappers on the same matches (default: all), or none."
        ),
    ] = None,
    results: Annotated[
        list[str] | None,
        typer.Option(
            "--result",
            metavar="NAME=FOLDER",
            help="Add models of another program in FOLDER/SCENE/SET: COLMAP or transforms.json. "
            "May be repeated.",
        ),
    ] = None,
    distance: Distances = None,
    workers: Annotated[int, typer.Option(min=1, help="Map so many sets in parallel.")] = 1,
    overrides: Overrides = None,
    compare: Annotated[
        tuple[str, str] | None,
        typer.Option(
            metavar="A B",
            help="Compare two finished benchmarks instead: DIR, DIR:CONFIG or DIR:METHOD.",
        ),
    ] = None,
    quiet: Quiet = False,
) -> None:
    """Compare mpsfm with COLMAP and others on scenes with true poses: AUC, images, time.

    A SCENE is a folder with images/, gt/, and optionally intrinsics.yaml, gt_depth/ and
    testsets.yaml. The report is written to DIR/report.md, .json and .html. Finished runs in DIR are
    not repeated. With gt_depth/ and --set dense.enabled=true, the depth maps and dense clouds are
    evaluated too. With --set dense.hold_out_every=N, the clouds are rendered at every N-th image.
    """
    from mpsfm_core.data.errors import InputError

    if compare is not None:
        _compare(*compare)
        return
    if not scenes or output is None:
        raise InputError("benchmark needs scene folders and --output DIR, or else --compare A B")
    from mpsfm_core.cli.progress import show_progress
    from mpsfm_core.evaluation.benchmark import BenchmarkPlan, run_benchmark
    from mpsfm_core.evaluation.methods import PEER_METHODS
    from mpsfm_core.evaluation.report import build_rows, format_markdown, write_report
    from mpsfm_core.providers.registry import Registry

    plan = BenchmarkPlan(
        tuple(scenes),
        tuple(configs or ("benchmark",)),
        None if sets is None else _split_list(sets),
        _split_list(prior),
        PEER_METHODS if peers is None else () if peers == "none" else _split_list(peers),
        tuple(overrides or ()),
        workers,
        dict(_parse_result(text) for text in results or ()),
        distance_thresholds(distance),
    )
    registry = Registry.discover()
    with show_progress(registry, quiet):
        records = run_benchmark(plan, output, registry, None if quiet else _print_record)
    write_report(output, records)
    typer.echo(format_markdown(build_rows(records)), nl=False)


def _print_record(record: BenchmarkRecord, cached: bool) -> None:
    """Print registered images and time of a finished benchmark run on stderr."""
    images = f"{len(record.estimated)}/{len(record.truth)} images"
    end = "cached" if cached else record.error or f"{record.cpu_seconds:.1f} s"
    typer.echo(f"{record.scene} {record.set_name} {record.label}: {images}, {end}", err=True)


def _parse_result(text: str) -> tuple[str, Path]:
    """Parse the option ``--result NAME=FOLDER``."""
    import re

    from mpsfm_core.data.errors import InputError
    from mpsfm_core.evaluation.methods import OURS, PEER_METHODS

    name, _, folder = text.partition("=")
    if not (folder and re.fullmatch(r"[\w.-]+", name) and Path(folder).is_dir()):
        raise InputError(f"--result {text}: the value must be NAME=FOLDER with an existing folder")
    if name.split("-")[0] == OURS or name in PEER_METHODS:
        raise InputError(
            f"--result {text}: {name!r} is a method of the benchmark; choose another name"
        )
    return name, Path(folder)


def _split_list(text: str) -> tuple[str, ...]:
    """Split the comma-separated value of a command-line option."""
    return tuple(part.strip() for part in text.split(",") if part.strip())


def _compare(first: str, second: str) -> None:
    """Print the pose AUC differences of two finished benchmark runs."""
    from mpsfm_core.evaluation.comparison import (
        compare_benchmarks,
        format_differences,
        read_benchmark,
    )

    differences = compare_benchmarks(read_benchmark(first), read_benchmark(second))
    typer.echo(format_differences(differences), nl=False)
