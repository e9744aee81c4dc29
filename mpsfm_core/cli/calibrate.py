"""``mpsfm calibrate``: make the declared uncertainty of a prior trustworthy."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_args

import typer

from mpsfm_core.cli.arguments import Quiet

if TYPE_CHECKING:
    from mpsfm_core.calibration.calibrate import Calibrated
    from mpsfm_core.calibration.fitting import Alignment
    from mpsfm_core.providers.uncertainty.calibration_file import CalibratedKind

_OWN = ("options.", "wrap.", "calibration")
_TRUTH = "ground_truth."


def calibrate(
    provider: Annotated[str, typer.Option(metavar="NAME", help="Of a depth or normals provider.")],
    images: Annotated[Path, typer.Option(metavar="DIR", help="Folder of photos.")],
    output: Annotated[
        Path, typer.Option("--output", "-o", metavar="FILE", help="Is written: .yaml or .json.")
    ],
    kind: Annotated[str, typer.Option(metavar="KIND", help="depth or normals.")] = "depth",
    ground_truth: Annotated[
        Path | None, typer.Option(metavar="DIR", help="True maps, named like the photos.")
    ] = None,
    model: Annotated[
        Path | None, typer.Option(metavar="DIR", help="COLMAP model with points, as truth.")
    ] = None,
    intrinsics: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="intrinsics.yaml or a COLMAP model; else --model, EXIF."),
    ] = None,
    image_list: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Use these images only, one name a line.")
    ] = None,
    alignment: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME", help="To try: scale, scale-shift, disparity."),
    ] = None,
    config: Annotated[
        str | None, typer.Option("--config", metavar="NAME_OR_FILE", help="Of everything else.")
    ] = None,
    overrides: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            metavar="KEY=VALUE",
            help="options.K=V: of the provider; ground_truth.K=V: of its files (scale=0.001 for "
            "16-bit millimetres); else a setting of the configuration.",
        ),
    ] = None,
    folds: Annotated[int, typer.Option(min=2, help="Groups of images to hold out in turn.")] = 4,
    seed: Annotated[int, typer.Option(min=0)] = 0,
    quiet: Quiet = False,
) -> None:
    """Fit the uncertainty of a depth or normals provider and report how good it is.

    Compares with true maps, or with the points of a COLMAP model, or, given neither, with the
    points of our own reconstruction. Writes FILE for `depth.calibration: FILE`, and a report
    beside it.
    """
    from mpsfm_core.calibration.calibrate import Photos, calibrate
    from mpsfm_core.calibration.report import write_report
    from mpsfm_core.calibration.study import StudyOptions
    from mpsfm_core.cli.progress import showing_progress
    from mpsfm_core.config import load_config
    from mpsfm_core.data.errors import InputError
    from mpsfm_core.inputs.models import find_model_folder
    from mpsfm_core.providers.registry import Registry

    calibrated_kind, alignments = _checked(kind, alignment or [])
    if output.suffix not in (".yaml", ".yml", ".json"):
        raise InputError(f"{output}: a calibration file ends in .yaml or .json")
    registry = Registry.discover()
    own, truth = _sorted(kind, overrides or [])
    alone = ground_truth is None and model is None
    loaded = load_config(
        config or ("default" if alone else "demo"),
        [f"{kind}.use={provider}", *own],
        registry,
        complete=alone,
    )
    output.parent.mkdir(parents=True, exist_ok=True)
    if intrinsics is None and model is not None:
        intrinsics = find_model_folder(model)
    with showing_progress(registry, quiet):
        result = calibrate(
            Photos(images, intrinsics, image_list),
            loaded,
            calibrated_kind,
            ground_truth=None if ground_truth is None else {"directory": ground_truth, **truth},
            model=model,
            alignments=alignments,
            options=StudyOptions(folds=folds, seed=seed),
            registry=registry,
        )
    result.file.write(output)
    page, _ = write_report(output, result.report)
    if not quiet:
        _print_outcome(result)
        typer.echo(f"written to {output}; the report is {page}")


def _checked(
    kind: str, alignments: list[str]
) -> tuple[CalibratedKind, tuple[Alignment, ...] | None]:
    """The kind and the alignments if there are such."""
    from mpsfm_core.calibration.fitting import Alignment
    from mpsfm_core.data.errors import InputError, did_you_mean
    from mpsfm_core.providers.uncertainty.calibration_file import CalibratedKind

    kinds: dict[str, CalibratedKind] = {name: name for name in get_args(CalibratedKind)}
    known: dict[str, Alignment] = {name: name for name in get_args(Alignment)}
    for given, valid in ((kind, [*kinds]), *((name, [*known]) for name in alignments)):
        if given not in valid:
            raise InputError(f"unknown {given!r}{did_you_mean(given, valid)}")
    return kinds[kind], tuple(known[name] for name in alignments) or None


def _sorted(kind: str, overrides: list[str]) -> tuple[list[str], dict[str, Any]]:
    """Settings of the configuration, and those of the true maps, from what ``--set`` says."""
    from mpsfm_core.support.yaml_text import parse_yaml

    own, truth = [], {}
    for text in overrides:
        key, _, value = text.partition("=")
        if key.startswith(_TRUTH):
            truth[key.removeprefix(_TRUTH)] = parse_yaml(value, f"--set {text}")
        else:
            own.append(f"{kind}.{text}" if key.startswith(_OWN) else text)
    return own, truth


def _print_outcome(result: Calibrated) -> None:
    report = result.report
    for name, (low, high) in report["intervals_95"].items():
        value = report["calibration"]["after"][name]
        typer.echo(f"{name} {value:.4g} ({low:.4g} to {high:.4g})")
    before, after = (report["metrics"][when] for when in ("before", "after"))
    typer.echo(
        f"within 1 std on held-out images: {after['coverage'][0]:.1%} (before "
        f"{before['coverage'][0]:.1%}, ideal 68.3%); AUSE {after['ause']:.3f} (before "
        f"{before['ause']:.3f})"
    )
