"""``mpsfm localize``: estimate the poses of photos in an existing model."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from mpsfm_core.cli.arguments import ConfigName, Offline, Overrides, Quiet, config_overrides
from mpsfm_core.cli.errors import handle_sigterm


def localize(
    model: Annotated[Path, typer.Argument(help="COLMAP model, or mpsfm result folder.")],
    photos: Annotated[
        Path, typer.Argument(help="Folder of the photos to localize, one photo, or a video.")
    ],
    output: Annotated[
        Path, typer.Option("--output", "-o", metavar="DIR", help="Write the poses here.")
    ],
    images: Annotated[
        Path | None,
        typer.Option(
            metavar="FOLDER",
            help="Folder of the model's images; default: as the run recorded, or images/ next to "
            "the model.",
        ),
    ] = None,
    intrinsics: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Read the photos' cameras from intrinsics.yaml, a COLMAP model or "
            "transforms.json; default: EXIF, else estimated.",
        ),
    ] = None,
    rigs: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Cameras of the photos that move as one, with known relative poses in units of "
            "the model: COLMAP's rig_config.json, model or database.",
        ),
    ] = None,
    config: ConfigName = "default",
    database: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Keep the model's points and depth here; default: MODEL/localization.npz.",
        ),
    ] = None,
    sequence: Annotated[
        bool,
        typer.Option(
            "--sequence", help="Match consecutive photos, too, and register them together."
        ),
    ] = False,
    extend: Annotated[
        bool,
        typer.Option("--extend", help="Write DIR/extended, the model with the localized photos."),
    ] = False,
    overrides: Overrides = None,
    offline: Offline = False,
    quiet: Quiet = False,
) -> None:
    """Estimate the poses of photos in an existing model, which stays unchanged.

    Writes DIR/poses.txt in the format of hloc (NAME qw qx qy qz tx ty tz), DIR/localization.json
    with covariances, inliers and the reason for each photo without pose, and the COLMAP model
    DIR/sparse. The poses of all frames of a video are in DIR/trajectory.txt. The first call writes
    the model's points and depth to MODEL/localization.npz.
    """
    from mpsfm_core.cli.progress import show_progress
    from mpsfm_core.pipeline.localize import localize as run
    from mpsfm_core.providers.registry import Registry
    from mpsfm_core.report.reasons import explain

    handle_sigterm()
    registry = Registry.discover()
    with show_progress(registry, quiet):
        result = run(
            model,
            photos,
            output,
            config,
            images=images,
            intrinsics=intrinsics,
            rigs=rigs,
            database=database,
            sequence=sequence,
            extend=extend,
            overrides=config_overrides(overrides, offline),
            registry=registry,
        )
    if quiet:
        return
    for name, reason in result.reasons.items():
        typer.echo(f"not localized: {name}: {explain(reason).text}")
    for name, photo in result.photos.items():
        for doubt in photo.doubts:
            typer.echo(f"doubtful: {name}: {explain(doubt).text} {explain(doubt).remedy}")
    if result.frames:
        located = sum(frame.pose is not None for frame in result.frames)
        typer.echo(f"{located} of {len(result.frames)} frames of the video localized")
    total = len(result.photos) + len(result.reasons)
    typer.echo(f"{len(result.photos)} of {total} photos localized; written to {output}")
