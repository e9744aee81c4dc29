"""Commands of ``python -m training`` that make data, train, export and evaluate."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

app = typer.Typer(no_args_is_help=True, add_completion=False)
Data = Annotated[Path, typer.Option(help="folder of shards")]


@app.command("draw")
def draw(
    data: Data,
    shards: int = 50,
    seed: int = 1,
    workers: int = 2,
    photos: Annotated[Path | None, typer.Option(help="pictures for textures")] = None,
) -> None:
    """Render training samples of random rooms, streets and table tops."""
    from training.make_data import make_drawn

    make_drawn(data, shards, seed, workers, photos)


@app.command("convert")
def convert(data: Data, source: Path) -> None:
    """Convert folders of RGB-D frames to training samples."""
    from training.make_data import make_real

    make_real(data, source)


@app.command("label")
def label(data: Data, photos: Path, teacher: Path, names: list[str]) -> None:
    """Label the depth of indoor images with another depth network."""
    from training.make_data import make_labelled

    make_labelled(data, photos, teacher, names)


@app.command("sky")
def sky(data: Data, photos: Path, teacher: Path, names: list[str]) -> None:
    """Label the sky in images with a segmentation network."""
    from training.make_data import make_sky

    make_sky(data, photos, teacher, names)


@app.command("triangulated")
def triangulated(data: Data, images: Path, model: Path, name: str) -> None:
    """Convert images and their COLMAP points to samples for validation."""
    from training.make_data import make_triangulated

    make_triangulated(data, images, model, name)


@app.command("views")
def views(data: Data, panoramas: Path, teacher: Path) -> None:
    """Cut perspective images from panoramas, with depth scaled by the known tripod height."""
    from training.make_data import make_views

    make_views(data, panoramas, teacher)


@app.command("train")
def train(
    data: Data,
    run: Annotated[Path, typer.Option(help="folder of checkpoints, to go on from")],
    steps: int = 20_000,
    cooldown: int = 1000,
    held_out: Annotated[list[str] | None, typer.Option(help="parts of names of shards")] = None,
    start: Annotated[Path | None, typer.Option(help="weights to begin with")] = None,
    minutes: Annotated[float | None, typer.Option(help="stop then, to go on later")] = None,
    seed: int = 0,
    rate: float = 1e-3,
) -> None:
    """Train the network, or resume its training from the last checkpoint."""
    from training.train import Schedule
    from training.train import train as run_training

    schedule = Schedule(steps, cooldown, rate=rate)
    run_training(data, run, schedule, held_out or ["drawn-1-0000"], seed, start, minutes)


@app.command("cameras")
def cameras(
    output: Path, files: int = 40, per_file: int = 100, seed: int = 1, workers: int = 2
) -> None:
    """Render images with a wide range of focal lengths, for ``camera``."""
    from training.make_data import make_cameras

    make_cameras(output, files, per_file, seed, workers)


@app.command("camera")
def camera(
    panoramas: Path,
    start: Path,
    run: Annotated[Path, typer.Option(help="folder of the checkpoint")],
    renders: Annotated[Path | None, typer.Option(help="output of the command cameras")] = None,
    held_out: Annotated[list[str] | None, typer.Option(help="file names of panoramas")] = None,
    steps: int = 20_000,
    batch: int = 256,
    rate: float = 1e-3,
    minutes: Annotated[float | None, typer.Option(help="train this long instead of steps")] = None,
    seed: int = 0,
) -> None:
    """Train the camera branch, and leave depth and normals as they are."""
    from training.train_camera import train_camera

    held = held_out or []
    train_camera(panoramas, renders, run, start, held, steps, batch, rate, minutes, seed)


@app.command("average")
def average(checkpoints: list[Path], output: Path) -> None:
    """Average the weights of checkpoints, and write a checkpoint for ``export``."""
    from training.export import average as run_average

    run_average(checkpoints, output)


@app.command("export")
def export(
    checkpoint: Path,
    output: Path,
    weights: Annotated[Path | None, typer.Option(help="also the weights alone, here")] = None,
) -> None:
    """Export a checkpoint to ONNX, and print how its outputs differ from those of torch."""
    from training.export import export as run_export
    from training.export import keep

    if weights is not None:
        keep(checkpoint, weights)
    for name, gap in run_export(checkpoint, output).items():
        typer.echo(f"{name}: {gap:.1e}")


@app.command("export-camera")
def export_camera(checkpoint: Path, output: Path) -> None:
    """Export the camera branch of a checkpoint to ONNX, and compare its outputs with torch."""
    from training.export import export_camera as run_export

    for name, gap in run_export(checkpoint, output).items():
        typer.echo(f"{name}: {gap:.1e}")


@app.command("unpack")
def unpack(
    data: Data, output: Path, shards: list[str], most: Annotated[int, typer.Option()] = 40
) -> None:
    """Convert training samples of the named shards to a scene folder for ``mpsfm calibrate``."""
    from training.samples import find_shards
    from training.unpack import unpack as run_unpack

    chosen = [path for path in find_shards(data) if any(name in path.name for name in shards)]
    typer.echo(f"{run_unpack(chosen, output, most)} samples")


if __name__ == "__main__":
    app()
