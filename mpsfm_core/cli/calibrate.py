"""``mpsfm calibrate``: fit the predicted uncertainty of a depth or normals provider."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_args

import typer

from mpsfm_core.cli.arguments import ImageList, Quiet

if TYPE_CHECKING:
    from mpsfm_core.calibration.calibrate import CalibrationResult
    from mpsfm_core.calibration.model_selection import Alignment
    from mpsfm_core.providers.uncertainty.calibration_file import CalibratedKind

_PROVIDER_KEYS = ("options.", "wrap.", "calibration")
"""Prefixes of ``--set`` keys that are settings of the calibrated provider."""
_GROUND_TRUTH_KEY = "ground_truth."
"""Prefix of ``--set`` keys that are settings of the provider ``files``, which reads the true
maps."""


def calibrate(
    provider: Annotated[
        str, typer.Option(metavar="NAME", help="Calibrate this depth or normals provider.")
    ],
    images: Annotated[Path, typer.Option(metavar="DIR", help="Folder of photos.")],
    output: Annotated[
        Path,
        typer.Option(
            "--output", "-o", metavar="FILE", help="Write the calibration here: .yaml or .json."
        ),
    ],
    kind: Annotated[
        str, typer.Option(metavar="KIND", help="Kind of the provider: depth or normals.")
    ] = "depth",
    ground_truth: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="Compare with true maps, named like the photos."),
    ] = None,
    model: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="Compare with the points of a COLMAP model."),
    ] = None,
    intrinsics: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Read cameras from intrinsics.yaml or a COLMAP model; default: --model, EXIF.",
        ),
    ] = None,
    image_list: ImageList = None,
    alignment: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME", help="Try only these alignments: scale, scale-shift, disparity."
        ),
    ] = None,
    config: Annotated[
        str | None,
        typer.Option(
            "--config",
            metavar="NAME_OR_FILE",
            help="Take all other settings from here.",
        ),
    ] = None,
    overrides: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            metavar="KEY=VALUE",
            help="Change a setting: options.K=V of the provider, ground_truth.K=V of the true maps "
            "(scale=0.001 for 16-bit millimeters), or any of the configuration.",
        ),
    ] = None,
    folds: Annotated[
        int, typer.Option(min=2, help="Number of folds of the cross-validation over photos.")
    ] = 4,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the random sampling.")] = 0,
    quiet: Quiet = False,
) -> None:
    """Fit the uncertainty of a depth or normals provider and report its quality.

    The predicted maps are compared with true maps or with the points of a COLMAP model. Without
    true maps and model, the photos are reconstructed and give the points. The calibration is
    written to FILE, for the setting depth.calibration, with a report next to FILE.
    """
    from mpsfm_core.calibration.calibrate import CalibrationImages, calibrate
    from mpsfm_core.calibration.cross_validation import StudyOptions
    from mpsfm_core.calibration.report import write_report
    from mpsfm_core.cli.progress import show_progress
    from mpsfm_core.config import load_config
    from mpsfm_core.data.errors import InputError
    from mpsfm_core.inputs.models import find_model_folder
    from mpsfm_core.providers.registry import Registry

    calibrated_kind, alignments = _check_names(kind, alignment or [])
    if output.suffix not in (".yaml", ".yml", ".json"):
        raise InputError(f"{output}: a calibration file must end in .yaml or .json")
    registry = Registry.discover()
    config_settings, truth_settings = _split_overrides(kind, overrides or [])
    needs_reconstruction = ground_truth is None and model is None
    loaded = load_config(
        config or ("default" if needs_reconstruction else "demo"),
        [f"{kind}.use={provider}", *config_settings],
        registry,
        complete=needs_reconstruction,
    )
    output.parent.mkdir(parents=True, exist_ok=True)
    if intrinsics is None and model is not None:
        intrinsics = find_model_folder(model)
    with show_progress(registry, quiet):
        result = calibrate(
            CalibrationImages(images, intrinsics, image_list),
            loaded,
            calibrated_kind,
            ground_truth=None
            if ground_truth is None
            else {"directory": ground_truth, **truth_settings},
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


def _check_names(
    kind: str, alignments: list[str]
) -> tuple[CalibratedKind, tuple[Alignment, ...] | None]:
    """Check the values of ``--kind`` and ``--alignments``.

    Raises:
        InputError: The provider kind or a depth alignment is unknown.
    """
    from mpsfm_core.calibration.model_selection import Alignment
    from mpsfm_core.data.errors import InputError, did_you_mean
    from mpsfm_core.providers.uncertainty.calibration_file import CalibratedKind

    kinds: dict[str, CalibratedKind] = {name: name for name in get_args(CalibratedKind)}
    known: dict[str, Alignment] = {name: name for name in get_args(Alignment)}
    for given, valid in ((kind, [*kinds]), *((name, [*known]) for name in alignments)):
        if given not in valid:
            raise InputError(f"unknown {given!r}{did_you_mean(given, valid)}")
    return kinds[kind], tuple(known[name] for name in alignments) or None


def _split_overrides(kind: str, overrides: list[str]) -> tuple[list[str], dict[str, Any]]:
    """Split ``--set`` options into configuration overrides and settings of the true maps."""
    from mpsfm_core.support.yaml_text import parse_yaml

    config_settings, truth_settings = [], {}
    for text in overrides:
        key, _, value = text.partition("=")
        if key.startswith(_GROUND_TRUTH_KEY):
            name = key.removeprefix(_GROUND_TRUTH_KEY)
            truth_settings[name] = parse_yaml(value, f"--set {text}")
        else:
            is_provider = key.startswith(_PROVIDER_KEYS)
            config_settings.append(f"{kind}.{text}" if is_provider else text)
    return config_settings, truth_settings


def _print_outcome(result: CalibrationResult) -> None:
    """Print the fitted calibration with intervals, and the cross-validated coverage."""
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
