"""Commands ``mpsfm extract``, ``mpsfm match`` and ``mpsfm map`` to reconstruct in steps."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from mpsfm_core.cli.arguments import (
    ConfigName,
    ImageList,
    Offline,
    Overrides,
    PhotosOrVideo,
    Quiet,
    config_overrides,
)
from mpsfm_core.cli.errors import handle_sigterm

if TYPE_CHECKING:
    from mpsfm_core.data import Int64

Work = Annotated[Path, typer.Argument(metavar="WORK", help="Folder of mpsfm extract.")]


def extract(
    images: PhotosOrVideo,
    work: Annotated[
        Path, typer.Option("--output", "-o", metavar="WORK", help="Write the work folder here.")
    ],
    config: ConfigName = "default",
    intrinsics: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Read cameras from intrinsics.yaml, a COLMAP model or transforms.json.",
        ),
    ] = None,
    image_list: ImageList = None,
    overrides: Overrides = None,
    offline: Offline = False,
    quiet: Quiet = False,
) -> None:
    """Compute features, depth and normals of photos, and write them to a work folder.

    The command writes WORK/features.h5 in the format of hloc, WORK/priors/depth and
    WORK/priors/normals. Other programs may replace the written files before mpsfm match and mpsfm
    map read them. Repeat an interrupted mpsfm extract to continue where it stopped.
    """
    from mpsfm_core.api import extract_features, load_images, predict_priors
    from mpsfm_core.cli.progress import show_progress
    from mpsfm_core.config import load_config
    from mpsfm_core.pipeline import work_folder as files
    from mpsfm_core.providers.registry import Registry
    from mpsfm_core.results.match_files import write_hloc_features

    handle_sigterm()
    registry, settings = Registry.discover(), config_overrides(overrides, offline)
    loaded = load_config(config, settings, registry)
    work.mkdir(parents=True, exist_ok=True)
    with show_progress(registry, quiet):
        photos = load_images(
            images,
            intrinsics=intrinsics,
            image_list=image_list,
            output=work,
            config=loaded,
            registry=registry,
        )
        if loaded.features is not None:
            features = extract_features(photos, config=loaded, registry=registry)
            write_hloc_features(work / files.FEATURES, photos, features)
        priors = predict_priors(photos, config=loaded, registry=registry)
        files.write_priors(work, priors)
    assert photos.folder is not None
    is_file = Path(config).suffix in (".yaml", ".yml")
    written = files.WorkSettings(
        images=photos.folder.resolve(),
        intrinsics=None if intrinsics is None else intrinsics.resolve(),
        image_list=None if image_list is None else image_list.resolve(),
        config=str(Path(config).resolve()) if is_file else config,
        overrides=tuple(settings),
        metric_depth=all(depth.metric for depth in priors.depth.values()),
    )
    files.write_settings(work, written)
    if not quiet:
        typer.echo(f"{len(photos)} photos; written to {work}")


def match(
    work: Work, overrides: Overrides = None, offline: Offline = False, quiet: Quiet = False
) -> None:
    """Match the features of a work folder, and verify the matches.

    The command reads WORK/features.h5, which hloc or another program may have written. The command
    writes matches before verification to WORK/matches.h5 in the format of hloc, and verified
    matches to the COLMAP database WORK/database.db.
    """
    from mpsfm_core.api import load_images, match_images
    from mpsfm_core.cli.progress import show_progress
    from mpsfm_core.config import load_config
    from mpsfm_core.inputs.matches import features_from_hloc
    from mpsfm_core.pipeline import work_folder as files
    from mpsfm_core.providers.registry import Registry
    from mpsfm_core.results.match_files import write_hloc_matches, write_match_database

    handle_sigterm()
    settings, registry = files.read_settings(work), Registry.discover()
    changes = [*settings.overrides, *config_overrides(overrides, offline)]
    config = load_config(settings.config, changes, registry).model_copy(update={"fast_pass": None})
    with show_progress(registry, quiet):
        photos = load_images(
            settings.images,
            intrinsics=settings.intrinsics,
            image_list=settings.image_list,
            config=config,
            registry=registry,
        )
        features, matcher = None, None
        rows: dict[str, Int64] = {}
        if (work / files.FEATURES).is_file():
            features, rows = features_from_hloc(work / files.FEATURES, photos)
            matcher = config.matcher or config.dense_matcher
        graph = match_images(photos, features, matcher, config=config, registry=registry)
        if features is not None:
            write_hloc_matches(work / files.MATCHES, graph, rows)
        write_match_database(work / files.DATABASE, photos, graph)
    if not quiet:
        typer.echo(
            f"{len(graph.verified)} of {len(graph.matches)} pairs verified; written to "
            f"{work / files.DATABASE}"
        )


def map_images(
    work: Work,
    poses: Annotated[
        Path | None,
        typer.Option(metavar="MODEL", help="Start from the poses of a COLMAP model."),
    ] = None,
    hloc: Annotated[
        bool,
        typer.Option("--hloc", help="Read features.h5 and matches.h5 instead of database.db."),
    ] = False,
    overrides: Overrides = None,
    offline: Offline = False,
    quiet: Quiet = False,
) -> None:
    """Reconstruct the photos of a work folder from its matches and priors.

    The command reads WORK/database.db, WORK/priors/depth and WORK/priors/normals, which other
    programs may have written. If a folder of priors is missing, networks predict the depth or
    normals. The command writes the reconstruction to WORK/result.
    """
    from mpsfm_core.cli.reconstruct import run
    from mpsfm_core.data.errors import InputError
    from mpsfm_core.pipeline import work_folder as files

    settings = files.read_settings(work)
    names = (files.FEATURES, files.MATCHES) if hloc else (files.DATABASE,)
    matches = [work / name for name in names]
    for path in matches:
        if not path.is_file():
            raise InputError(f"{path} does not exist: run 'mpsfm match {work}' first")
    depth, normals = work / files.DEPTH, work / files.NORMALS
    use_depth = {"directory": str(depth), "metric": settings.metric_depth}
    run(
        settings.images,
        work / files.RESULT,
        settings.config,
        quiet,
        intrinsics=settings.intrinsics,
        image_list=settings.image_list,
        poses=poses,
        database=None if hloc else matches[0],
        hloc=(matches[0], matches[1]) if hloc else None,
        depth={"use": "files", "options": use_depth} if depth.is_dir() else None,
        normals=(
            {"use": "files", "options": {"directory": str(normals)}} if normals.is_dir() else None
        ),
        overrides=[*settings.overrides, *config_overrides(overrides, offline)],
    )
