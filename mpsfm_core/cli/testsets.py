"""``mpsfm testsets``: create scene folders and test sets for the benchmark."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

app = typer.Typer(no_args_is_help=True, help="Create scene folders and test sets for benchmark.")


@app.command("build")
def build(
    scene: Annotated[
        Path, typer.Argument(help="Scene folder with images/, gt/ and optionally gt_depth/.")
    ],
    source: Annotated[
        str,
        typer.Option(metavar="NAME", help="Compute overlap from depth, model (points) or auto."),
    ] = "auto",
    min_two_view: Annotated[
        float, typer.Option(min=0.0, max=1.0, help="Minimum overlap of a photo with another.")
    ] = 0.25,
    sets: Annotated[
        int, typer.Option(min=1, help="Number of sets per bucket; minimal has twice as many.")
    ] = 5,
    min_images: Annotated[int, typer.Option(min=3, help="Minimum photos per set.")] = 5,
    max_images: Annotated[int | None, typer.Option(min=3, help="Maximum photos per set.")] = None,
    seed: Annotated[int, typer.Option(help="Seed; the same seed gives the same sets.")] = 0,
    replace: Annotated[bool, typer.Option(help="Replace an existing testsets.yaml.")] = False,
) -> None:
    """Write SCENE/testsets.yaml: test sets grouped by overlap into minimal, leq5, ..., all.

    The groups are minimal, leq5, leq10, leq30, triplets and all. In a test set of leq5, at most 5 %
    of a photo's pixels are visible in both of any two other photos.
    """
    from mpsfm_core.evaluation.build_sets import build_test_sets
    from mpsfm_core.evaluation.sampling import SamplingOptions

    options = SamplingOptions(
        min_two_view=min_two_view,
        sets=sets,
        min_images=min_images,
        max_images=max_images,
        seed=seed,
    )
    for bucket, count in build_test_sets(scene, source, options, replace=replace).items():
        typer.echo(f"{bucket}: {count} set{'s' if count > 1 else ''}")


@app.command("import")
def import_dataset(
    kind: Annotated[
        str,
        typer.Argument(
            help="Dataset: eth3d, smerf, tanks-and-temples, realestate10k, 7-scenes, scannet, "
            "tum-rgbd, eth3d-slam, euroc or lamar."
        ),
    ],
    source: Annotated[Path, typer.Argument(metavar="SRC", help="One scene as distributed.")],
    target: Annotated[Path, typer.Argument(metavar="DST", help="Scene folder to write.")],
    every: Annotated[int, typer.Option(min=1, help="Take every n-th image.")] = 1,
) -> None:
    """Convert one scene of a public dataset to a scene folder; photos are linked or copied."""
    from mpsfm_core.evaluation.importers import import_scene

    scene = import_scene(kind, source, target, every)
    depth = "with" if scene.depth is not None else "without"
    typer.echo(f"{target}: {len(scene.truth)} images with true poses, {depth} depth")
