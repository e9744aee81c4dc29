"""``mpsfm view``: show results or COLMAP models with a viewer plugin."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from mpsfm_core.providers.registry import Registry
    from mpsfm_core.report.viewing import Pictures


def view(
    folder: Annotated[
        Path, typer.Argument(metavar="DIR", help="A result folder or any COLMAP model.")
    ],
    viewer: Annotated[
        str, typer.Option("--viewer", metavar="NAME", help="Use this viewer: viser or rerun.")
    ] = "viser",
) -> None:
    """Show cameras and points; viser serves a page until Ctrl-C, rerun writes DIR/scene.rrd."""
    from mpsfm_core.providers.registry import Registry
    from mpsfm_core.report.viewing import read_scene

    scene, cloud, pictures = read_scene(folder)
    opened = open_viewer(Registry.discover(), viewer, folder, pictures)
    opened.show(scene, cloud)
    typer.echo(opened.finish())
    opened.wait()


def open_viewer(registry: Registry, name: str, output: Path, pictures: Pictures) -> Any:
    """Open the viewer plugin of the given name.

    Raises:
        InputError: No installed plugin provides the viewer, or the viewer fails to open.
    """
    from pkgutil import resolve_name

    from mpsfm_core.data.errors import InputError, did_you_mean
    from mpsfm_core.providers.first_party import VIEWERS, install_hint

    answers = registry.call_hook("mpsfm_viewers")
    known = {key: value for answer in answers for key, value in dict(answer).items()}
    if name not in known:
        hint = install_hint(VIEWERS, name) or did_you_mean(name, known or VIEWERS)
        raise InputError(f"no viewer {name!r}{hint}")
    try:
        return resolve_name(known[name])(output, pictures)
    except Exception as error:
        raise InputError(
            f"viewer {name!r} cannot be opened: {type(error).__name__}: {error}"
        ) from error


@contextmanager
def show_run(registry: Registry, name: str | None, photos: Path, output: Path) -> Iterator[None]:
    """Show the run inside the ``with`` block in a viewer; do nothing without a viewer name.

    After a successful run, the viewer stays open until Ctrl-C.
    """
    if name is None:
        yield
        return
    from mpsfm_core.report.viewing import pictures_from_photos, read_scene

    viewer = open_viewer(registry, name, output, pictures_from_photos(photos))
    registry.register(viewer, name=f"viewer {name}")
    try:
        yield
        scene, cloud, _ = read_scene(output)
        viewer.show(scene, cloud)
    finally:
        typer.echo(viewer.finish())
    viewer.wait()
