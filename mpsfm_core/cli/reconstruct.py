"""``mpsfm reconstruct``: reconstruct a folder of photos or a video."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from mpsfm_core.cli.arguments import (
    ConfigName,
    ImageList,
    Offline,
    Overrides,
    PhotosOrVideo,
    Quiet,
    ViewerName,
    config_overrides,
)
from mpsfm_core.cli.errors import handle_sigterm

if TYPE_CHECKING:
    from mpsfm_core.pipeline.run import ReconstructionResult


def reconstruct(
    images: PhotosOrVideo,
    output: Annotated[
        Path, typer.Option("--output", "-o", metavar="DIR", help="Write the results here.")
    ],
    config: ConfigName = "default",
    intrinsics: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Read cameras from intrinsics.yaml, a COLMAP model or transforms.json; "
            "default: --poses, then EXIF.",
        ),
    ] = None,
    camera_per: Annotated[
        str | None,
        typer.Option(
            metavar="image|folder|set",
            help="Photos of a folder or the set share a camera, or none; default: by EXIF.",
        ),
    ] = None,
    camera_model: Annotated[
        str | None,
        typer.Option(
            metavar="MODEL",
            help="Estimate SIMPLE_PINHOLE, PINHOLE, SIMPLE_RADIAL (default), RADIAL, OPENCV or "
            "OPENCV_FISHEYE cameras.",
        ),
    ] = None,
    projection: Annotated[
        str | None,
        typer.Option(
            metavar="auto|perspective|equirectangular",
            help="Cut 360-degree panoramas (equirectangular) into perspective photos of a rig.",
        ),
    ] = None,
    image_list: ImageList = None,
    poses: Annotated[
        Path | None,
        typer.Option(
            metavar="MODEL",
            help="Start from known poses and cameras of a COLMAP model or transforms.json; "
            "--set mapping.known_poses=fixed keeps the poses.",
        ),
    ] = None,
    rigs: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Cameras that move as one: COLMAP's rig_config.json, model or database, or "
            "'folders' for one folder of photos per camera.",
        ),
    ] = None,
    overrides: Overrides = None,
    database: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Use the keypoints and matches of a COLMAP database."),
    ] = None,
    hloc: Annotated[
        tuple[Path, Path] | None,
        typer.Option(
            metavar="FEATURES MATCHES",
            help="Use keypoints and matches of hloc (.h5 files).",
        ),
    ] = None,
    fresh: Annotated[
        bool, typer.Option("--fresh", help="Start over; ignore checkpoints of interrupted runs.")
    ] = False,
    offline: Offline = False,
    viewer: ViewerName = None,
    quiet: Quiet = False,
) -> None:
    """Reconstruct a folder of photos, or a video.

    Without --config, the best installed features, depth and normals are used and listed.

    Writes a COLMAP model (DIR/sparse), point clouds (DIR/points.ply, DIR/dense.ply), refined
    depth (DIR/depth) and DIR/summary.json. Exit codes: 0 success, 2 wrong input, 3 no
    reconstruction (the summary has the reasons). Repeat the command to resume an interrupted run.
    """
    if database is not None and hloc is not None:
        raise typer.BadParameter("use --database or --hloc for matches, not both")
    settings = config_overrides(overrides, offline)
    if camera_per is not None:
        settings.append(f"inputs.camera_per={camera_per}")
    if camera_model is not None:
        settings.append(f"inputs.camera_model={camera_model}")
    if projection is not None:
        settings.append(f"inputs.projection={projection}")
    run(
        images,
        output,
        config,
        quiet,
        intrinsics=intrinsics,
        image_list=image_list,
        poses=poses,
        rigs=rigs,
        database=database,
        hloc=hloc,
        overrides=settings,
        fresh=fresh,
        viewer=viewer,
    )


def run(
    images: Path,
    output: Path,
    config: str,
    quiet: bool,
    viewer: str | None = None,
    **arguments: Any,
) -> ReconstructionResult:
    """Run a reconstruction with progress bars, and print a summary.

    Args:
        images: Folder of images, or a video.
        output: Output folder.
        config: Name or file path of the configuration.
        quiet: If true, print neither progress nor summary.
        viewer: Name of a viewer that shows the run.
        arguments: Further arguments that are passed to :func:`mpsfm_core.pipeline.run.reconstruct`.
    """
    from mpsfm_core.cli.progress import show_progress
    from mpsfm_core.cli.view import show_run
    from mpsfm_core.data.errors import ReconstructionError
    from mpsfm_core.pipeline.run import reconstruct
    from mpsfm_core.providers.registry import Registry

    handle_sigterm()
    registry = Registry.discover()
    with show_run(registry, viewer, images, output):
        try:
            with show_progress(registry, quiet):
                result = reconstruct(images, output, config, registry=registry, **arguments)
        except ReconstructionError as error:
            if error.summary and not quiet:
                _print_failure(error.summary, output)
            raise
        if not quiet:
            _print_outcome(result, output)
    return result


def _print_failure(summary: Mapping[str, Any], output: Path) -> None:
    """Print the problems of a failed run and their remedies on stderr."""
    from mpsfm_core.report.findings import findings

    for finding in findings(summary):
        typer.echo(f"{finding.title}. {finding.text}", err=True)
        if finding.remedy:
            typer.echo(f"  what to do: {finding.remedy}", err=True)
    if (output / "report.html").is_file():
        typer.echo(f"open {output}/report.html to see photos, depth and matches", err=True)


def _print_outcome(result: ReconstructionResult, output: Path) -> None:
    """Print quality, weakly registered and missing photos, and files of a successful run."""
    from mpsfm_core.report.findings import describe_scale, findings, weakest
    from mpsfm_core.report.reasons import explain_image
    from mpsfm_core.report.verdict import judge

    images, best = result.summary["images"], result.summary["reconstructions"][0]
    _row(
        judge(result.summary).level,
        f"{len(images['registered'])} of {images['total']} images, {best['points']} points, mean "
        f"reprojection error {best['mean_reprojection_error_px'] or 0:.2f} px",
    )
    _row("scale", ", ".join(describe_scale(result.summary)))
    if place := result.summary["georeference"]:
        _row("place", _place(place))
    if refined := _refined_cameras(images["details"].values()):
        _row("cameras", refined)
    weak = [f"{name} ({count})" for name, count in weakest(result.summary)]
    if weak:
        _row("weakest", f"{', '.join(weak)}; verified matches with registered photos")
    for finding in findings(result.summary):
        if finding.level == "warning" and not finding.title.endswith("missing"):
            _row("warning", f"{finding.title}: {finding.text}")
    for name, reason in images["unconfirmed"].items():
        _row("guessed", f"not confirmed: {name}: {explain_image(reason).text}")
    for name, fault in images["left_out"].items():
        _row("missing", f"left out: {name}: {fault}")
    for name, fault in images["failed"].items():
        _row("missing", f"a provider failed: {name}: {fault}")
    for name, reason in images["unregistered"].items():
        _row("missing", f"not registered: {name}: {explain_image(reason).text}")
    videos = result.summary["videos"]
    for video in videos:
        _row("video", _describe_video(video, is_single=len(videos) == 1))
    if (output / "report.html").is_file():
        _row("open", f"{output}/report.html")
    seconds = sum(stage["seconds"] for stage in result.summary["stages"].values())
    _row("time", f"written to {output} in {seconds:.0f} s")


def _describe_video(video: Mapping[str, Any], *, is_single: bool) -> str:
    """Describe keyframes, cuts and localized frames of a video."""
    texts = [f"{video['keyframes']} keyframes of {video['frames']} frames"]
    if not is_single:
        texts[0] = f"{Path(video['file']).name}: {texts[0]}"
    if video["cuts_s"]:
        times = ", ".join(f"{time:.1f}" for time in video["cuts_s"])
        texts.append(f"cuts at {times} s")
    if trajectory := video["trajectory"]:
        sources = trajectory["sources"]
        names = {"none": "without pose"}
        counts = ", ".join(f"{n} {names.get(source, source)}" for source, n in sources.items())
        texts.append(f"poses in {trajectory['file']}: {counts}")
    return "; ".join(texts)


_YELLOW = ("partial", "doubtful", "warning", "missing")


def _row(label: str, text: str) -> None:
    """Print a line of the summary with a colored label."""
    colors = {"good": "green", **dict.fromkeys(_YELLOW, "yellow")}
    typer.echo(typer.style(f"{label:<9}", fg=colors.get(label), bold=True) + text)


def _place(georeference: Mapping[str, Any]) -> str:
    """Describe the GPS alignment in the summary, or why the model is not aligned."""
    from mpsfm_core.report.reasons import explain_gps

    if "why_not" in georeference:
        return f"not georeferenced: {explain_gps(georeference['why_not']).text}"
    origin = georeference["origin"]
    return (
        f"east, north, up of {origin['latitude']:.6f}, {origin['longitude']:.6f}; "
        f"{georeference['inliers']} of {georeference['images']} GPS positions fit, "
        f"{georeference['rms_m']:.1f} m off; up by {georeference['up']}"
    )


def _refined_cameras(details: Collection[Mapping[str, Any]]) -> str:
    """Describe refined focal lengths and radial distortions as text, empty if none is refined."""
    radials = [
        image["radial_distortion"]
        for image in details
        if "radial_distortion" in image and "radial_distortion_reason" not in image
    ]
    texts = [_refined_focal_lengths(details)]
    if radials:
        span = " to ".join(dict.fromkeys(f"{value:+.3f}" for value in (min(radials), max(radials))))
        texts.append(f"radial distortion estimated as {span}")
    return ", ".join(text for text in texts if text)


def _refined_focal_lengths(details: Collection[Mapping[str, Any]]) -> str:
    """Describe the refined focal lengths in the summary; empty if none is refined."""
    changes = {
        (image["focal_length_px"], image["refined_focal_length_px"], image["focal_length_from"])
        for image in details
        if "refined_focal_length_px" in image
    }
    if len(changes) == 1:
        guess, refined, source = changes.pop()
        return f"focal length refined from {guess:.0f} ({source}) to {refined:.0f} px"
    factors = [refined / guess - 1 for guess, refined, _ in changes]
    if not factors:
        return ""
    return f"{len(factors)} focal lengths refined, by {min(factors):+.0%} to {max(factors):+.0%}"
