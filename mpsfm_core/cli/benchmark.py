"""``mpsfm benchmark``: configurations and peers on scenes with known poses."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from mpsfm_core.cli.arguments import Distances, Overrides, Quiet, tolerances

if TYPE_CHECKING:
    from mpsfm_core.evaluation.records import Record


def benchmark(
    scenes: Annotated[
        list[Path] | None, typer.Argument(metavar="SCENE...", help="Scene folders.")
    ] = None,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", metavar="DIR", help="Is written.")
    ] = None,
    configs: Annotated[
        list[str] | None,
        typer.Option("--config", metavar="NAME_OR_FILE", help="May be repeated."),
    ] = None,
    sets: Annotated[
        str | None, typer.Option(metavar="A,B", help="Buckets of test sets; all by default.")
    ] = None,
    prior: Annotated[
        str,
        typer.Option(
            metavar="A,B",
            help="Depth: sensor (gt_depth), degraded (gt_depth with errors of a network, "
            "degraded-1, ... with others) or config (the configuration's provider).",
        ),
    ] = "config",
    peers: Annotated[
        str | None,
        typer.Option(
            metavar="A,B", help="Other methods on the same matches (default: all), or none."
        ),
    ] = None,
    results: Annotated[
        list[str] | None,
        typer.Option(
            "--result",
            metavar="NAME=FOLDER",
            help="Models that another program made, FOLDER/SCENE/SET each: COLMAP's or "
            "transforms.json. May be repeated.",
        ),
    ] = None,
    distance: Distances = None,
    workers: Annotated[int, typer.Option(min=1, help="Sets mapped at the same time.")] = 1,
    overrides: Overrides = None,
    compare: Annotated[
        tuple[str, str] | None,
        typer.Option(
            metavar="A B",
            help="Compare two finished benchmarks instead; DIR, or DIR:METHOD for one method.",
        ),
    ] = None,
    quiet: Quiet = False,
) -> None:
    """Compare our mapper with COLMAP's on scenes with true poses; pose AUC, images, time.

    A SCENE is a folder with images/, gt/, and maybe intrinsics.yaml, gt_depth/ and testsets.yaml.
    Writes DIR/report.md, .json and .html. What DIR has already is not computed again.
    With gt_depth/ and --set dense.enabled=true also what depth maps and clouds are worth.
    """
    from mpsfm_core.data.errors import InputError

    if compare is not None:
        _compare(*compare)
        return
    if not scenes or output is None:
        raise InputError("benchmark needs scene folders and --output DIR, or --compare A B")
    from mpsfm_core.cli.progress import showing_progress
    from mpsfm_core.evaluation.benchmark import Plan, run_benchmark
    from mpsfm_core.evaluation.methods import OTHERS
    from mpsfm_core.evaluation.report import make_rows, markdown, write_report
    from mpsfm_core.providers.registry import Registry

    plan = Plan(
        tuple(scenes),
        tuple(configs or ("benchmark",)),
        None if sets is None else _listed(sets),
        _listed(prior),
        OTHERS if peers is None else () if peers == "none" else _listed(peers),
        tuple(overrides or ()),
        workers,
        dict(_named(text) for text in results or ()),
        tolerances(distance),
    )
    registry = Registry.discover()
    with showing_progress(registry, quiet):
        records = run_benchmark(plan, output, registry, None if quiet else _tell)
    write_report(output, records)
    typer.echo(markdown(make_rows(records)), nl=False)


def _tell(record: Record, known: bool) -> None:
    """One line on stderr for a finished run."""
    images = f"{len(record.estimated)}/{len(record.truth)} images"
    end = "known" if known else record.error or f"{record.cpu_seconds:.1f} s"
    typer.echo(f"{record.scene} {record.set_name} {record.label}: {images}, {end}", err=True)


def _named(text: str) -> tuple[str, Path]:
    """Name and folder of ``--result``."""
    import re

    from mpsfm_core.data.errors import InputError
    from mpsfm_core.evaluation.methods import OTHERS, OURS

    name, _, folder = text.partition("=")
    if not (folder and re.fullmatch(r"[\w.-]+", name) and Path(folder).is_dir()):
        raise InputError(f"--result {text}: must look like NAME=FOLDER, of a folder that is there")
    if name.split("-")[0] == OURS or name in OTHERS:
        raise InputError(f"--result {text}: {name!r} is the name of a method of the benchmark")
    return name, Path(folder)


def _listed(text: str) -> tuple[str, ...]:
    return tuple(part.strip() for part in text.split(",") if part.strip())


def _compare(first: str, second: str) -> None:
    from mpsfm_core.evaluation.comparison import compare, describe, read_side

    typer.echo(describe(compare(read_side(first), read_side(second))), nl=False)
