"""``mpsfm evaluate``: how far a model is from the truth."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from mpsfm_core.cli.arguments import Distances, distance_thresholds


def evaluate(
    model: Annotated[Path, typer.Argument(help="COLMAP model, transforms.json or our output.")],
    truth: Annotated[Path, typer.Argument(metavar="GT", help="The same with true poses.")],
    images: Annotated[
        str | None,
        typer.Option(metavar="A,B,C", help="Only these images; extensions may be left out."),
    ] = None,
    image_list: Annotated[
        Path | None, typer.Option(metavar="FILE", help="The same, one name a line.")
    ] = None,
    convention: Annotated[
        str, typer.Option(metavar="NAME", help="Of the pose AUC: paper, models, colmap or vggt.")
    ] = "paper",
    gt_depth: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="True depth, 16-bit PNG in mm; for MODEL/depth."),
    ] = None,
    scan: Annotated[
        Path | None,
        typer.Option(metavar="FILE.ply", help="Scan in the frame of GT; for MODEL/dense.ply."),
    ] = None,
    distance: Distances = None,
) -> None:
    """Print pose AUC at 1, 5 and 20 degrees, trajectory errors and registered share as JSON.

    Images are matched by name. Images of GT that MODEL lacks count as unregistered. With true
    depth or a scan, also how far the depth maps and the dense cloud of an output folder are off;
    without a scan, the true depth of its images is the scan.
    """
    import json

    from mpsfm_core.evaluation import CONVENTIONS, evaluate, read_poses

    if convention not in CONVENTIONS:
        from mpsfm_core.data.errors import InputError, did_you_mean

        raise InputError(f"no convention {convention!r}{did_you_mean(convention, CONVENTIONS)}")
    names = _names(images, image_list)
    poses, true_poses = read_poses(model), read_poses(truth)
    report = evaluate(poses, true_poses, names, CONVENTIONS[convention])
    if gt_depth is not None or scan is not None:
        from mpsfm_core.evaluation.output_folder import (
            evaluate_cloud,
            evaluate_depth,
            read_points,
            true_surface,
        )

        within, cloud = distance_thresholds(distance), model / "dense.ply"
        if gt_depth is not None:
            report["depth"] = evaluate_depth(model, gt_depth)
        if scan is not None:
            surface = read_points(scan)
        elif gt_depth is not None and cloud.is_file():
            surface = true_surface(truth, gt_depth, sorted(poses), within)
        else:
            surface = None
        if surface is not None:
            report["cloud"] = evaluate_cloud(cloud, surface, poses, true_poses, within)
    typer.echo(json.dumps(report, indent=2))


def _names(images: str | None, image_list: Path | None) -> list[str] | None:
    from mpsfm_core.data.errors import InputError

    if images is not None and image_list is not None:
        raise InputError("--images and --image-list exclude each other")
    if images is not None:
        return [name.strip() for name in images.split(",") if name.strip()]
    if image_list is None:
        return None
    from mpsfm_core.inputs.image_search import read_image_list

    return read_image_list(image_list)
