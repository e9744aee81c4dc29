"""``mpsfm evaluate``: compare a model with true poses, depth or a scan."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from mpsfm_core.cli.arguments import Distances, distance_thresholds


def evaluate(
    model: Annotated[
        Path, typer.Argument(help="COLMAP model, transforms.json or mpsfm result folder.")
    ],
    truth: Annotated[
        Path | None,
        typer.Argument(
            metavar="GT",
            help="Model with true poses, in the same formats, or the true trajectory of a video "
            "(TUM .txt or EuRoC .csv), which is compared with MODEL/trajectory.txt.",
        ),
    ] = None,
    images: Annotated[
        str | None,
        typer.Option(
            metavar="A,B,C", help="Evaluate only these photos; extensions may be omitted."
        ),
    ] = None,
    image_list: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Evaluate only these photos, one name per line."),
    ] = None,
    convention: Annotated[
        str,
        typer.Option(
            metavar="NAME", help="Compute the pose AUC like paper, models, colmap or vggt."
        ),
    ] = "paper",
    gt_depth: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="Evaluate MODEL/depth with true depth, 16-bit PNG in mm."),
    ] = None,
    scan: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE.ply", help="Evaluate MODEL/dense.ply with a scan in the frame of GT."
        ),
    ] = None,
    distance: Distances = None,
    held_out: Annotated[
        bool,
        typer.Option(
            "--held-out",
            help="Render the dense cloud and mesh of MODEL at the poses of photos that did not "
            "contribute (dense.hold_out_every), and compare with the photos; needs no GT.",
        ),
    ] = False,
    geometry: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE.ply", help="Render this cloud or mesh in the frame of MODEL instead."
        ),
    ] = None,
    photos: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR",
            help="Folder of the photos, for EXIF rotation and for --held-out; default: the folder "
            "that the run recorded.",
        ),
    ] = None,
) -> None:
    """Print pose AUC at 1, 5 and 20 degrees, trajectory errors and registered images as JSON.

    Photos of MODEL and GT are matched by name. Photos of GT without pose in MODEL count as
    unregistered. With true depth or a scan, the errors of the depth maps and the dense cloud of a
    result folder are printed too. Without a scan, the dense cloud is compared with the points of
    the true depth maps. With --held-out and without GT, the quality of renderings is printed.
    """
    import json

    from mpsfm_core.data.errors import InputError, did_you_mean
    from mpsfm_core.data.result_layout import TRAJECTORIES
    from mpsfm_core.evaluation import CONVENTIONS, evaluate, read_poses
    from mpsfm_core.evaluation.result_folder import find_photos
    from mpsfm_core.evaluation.trajectories import (
        count_frames_outside_largest,
        evaluate_trajectory,
        find_trajectory,
        read_trajectory,
    )

    if convention not in CONVENTIONS:
        raise InputError(f"no convention {convention!r}{did_you_mean(convention, CONVENTIONS)}")
    names = _select_names(images, image_list)
    report: dict[str, Any] = {}
    if held_out:
        from mpsfm_core.results.held_out import evaluate_held_out

        report["held_out"] = evaluate_held_out(model, photos, names, geometry)
    elif geometry is not None:
        raise InputError("--geometry is only used with --held-out")
    if truth is None:
        if not held_out or gt_depth is not None or scan is not None:
            raise InputError("GT is missing: the model with true poses, or --held-out")
        typer.echo(json.dumps(report, indent=2))
        return
    if truth.is_file() and (trajectory := find_trajectory(truth)) is not None:
        found = find_trajectory(model)
        if found is None:
            raise InputError(
                f"{model}: the folder has no trajectory.txt to compare with {truth}; for a result "
                f"of several videos, give one file of {model / TRAJECTORIES}"
            )
        compared = read_trajectory(found), read_trajectory(trajectory)
        report |= evaluate_trajectory(*compared, count_frames_outside_largest(found))
        typer.echo(json.dumps(report, indent=2))
        return
    photos = photos or find_photos(model)
    poses, true_poses = read_poses(model, photos), read_poses(truth, photos)
    report |= evaluate(poses, true_poses, names, CONVENTIONS[convention])
    if gt_depth is not None or scan is not None:
        from mpsfm_core.evaluation.result_folder import (
            evaluate_cloud,
            evaluate_depth,
            read_points,
            read_true_surface,
        )

        within, cloud = distance_thresholds(distance), model / "dense.ply"
        if gt_depth is not None:
            report["depth"] = evaluate_depth(model, gt_depth, photos)
        if scan is not None:
            surface = read_points(scan)
        elif gt_depth is not None and cloud.is_file():
            surface = read_true_surface(truth, gt_depth, sorted(poses), within, photos)
        else:
            surface = None
        if surface is not None:
            report["cloud"] = evaluate_cloud(cloud, surface, poses, true_poses, within)
    typer.echo(json.dumps(report, indent=2))


def _select_names(images: str | None, image_list: Path | None) -> list[str] | None:
    """Return the image names selected by ``--images`` or ``--image-list``, or None for all."""
    from mpsfm_core.data.errors import InputError

    if images is not None and image_list is not None:
        raise InputError("--images and --image-list exclude each other; use one of them")
    if images is not None:
        return [name.strip() for name in images.split(",") if name.strip()]
    if image_list is None:
        return None
    from mpsfm_core.inputs.image_search import read_image_list

    return read_image_list(image_list)
