"""``mpsfm demo``: reconstruct the sample scene and compare its poses with the true poses."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from mpsfm_core.cli.arguments import Offline, Overrides, Quiet, config_overrides

if TYPE_CHECKING:
    from mpsfm_core.evaluation import Pose


def demo(
    output: Annotated[
        Path, typer.Option("--output", "-o", metavar="DIR", help="Write the results here.")
    ] = Path("demo-output"),
    scene: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Use another scene with images/ and gt/.")
    ] = None,
    overrides: Overrides = None,
    offline: Offline = False,
    quiet: Quiet = False,
) -> None:
    """Reconstruct the sample photos and print the errors of the poses.

    gt/ is a COLMAP model with true cameras and poses. The run uses the cameras in gt/, but not the
    poses.
    """
    from mpsfm_core.cli.reconstruct import run
    from mpsfm_core.evaluation import read_poses, reconstruction_poses

    folder = _sample_scene() if scene is None else scene
    result = run(
        folder / "images",
        output,
        "demo",
        quiet,
        intrinsics=folder / "gt",
        overrides=config_overrides(overrides, offline),
    )
    metric = result.summary["reconstructions"][0]["metric_scale"] is not None
    _compare(reconstruction_poses(result.model), read_poses(folder / "gt"), metric)
    typer.echo("open next:")
    typer.echo(f"  {output}/report.html   in a browser: cameras, points, photos, depth, matches")
    typer.echo(f"  {output}/dense.ply     in MeshLab, CloudCompare or Blender")
    typer.echo(f"  {output}/sparse        in COLMAP (File > Import model) or pycolmap")
    typer.echo(f"  {output}/summary.json  settings and results")


def _sample_scene() -> Path:
    """Find the folder of the sample scene in the installed package or in a source tree."""
    import mpsfm_core

    package = Path(mpsfm_core.__file__).parent
    folders = (package / "sample_scene", package.parent / "examples" / "sample_scene")
    return next(folder for folder in folders if folder.is_dir())


def _compare(estimated: dict[str, Pose], truth: dict[str, Pose], metric: bool) -> None:
    """Print pose AUC and trajectory errors of estimated poses."""
    from mpsfm_core.evaluation import evaluate

    report = evaluate(estimated, truth)
    auc, trajectory = report["auc"], report["trajectory"]
    typer.echo("compared with the truth:")
    typer.echo(
        f"  registered {report['registered']} of {report['images']}, pose AUC @1/5/20 deg "
        f"{auc['1']:.1f} / {auc['5']:.1f} / {auc['20']:.1f} % ({report['convention']} convention)"
    )
    if trajectory is not None:
        typer.echo(
            f"  median error {trajectory['rotation_median_deg']:.2f} deg and "
            f"{100 * trajectory['ate_median']:.1f} cm (largest "
            f"{trajectory['rotation_max_deg']:.2f} deg, {100 * trajectory['ate_max']:.1f} cm)"
        )
    if trajectory is not None and metric:
        typer.echo(f"  metric scale off by {100 * abs(1 / trajectory['scale'] - 1):.1f} %")
