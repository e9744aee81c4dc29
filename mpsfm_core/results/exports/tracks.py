"""Points and tracks as text, shared by the exports to text formats."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import pycolmap

from mpsfm_core.data.errors import InputError


def check_names_without_spaces(names: Iterable[str], format_name: str) -> None:
    """Raise :class:`InputError` for a name with a space, which separates fields in the format."""
    for name in names:
        if len(name.split()) != 1:
            raise InputError(
                f"{format_name} does not allow spaces in names such as {name!r}; rename the photo, "
                f"or export to a format that allows them, such as colmap-db or nerfstudio"
            )


def sort_images_by_name(model: pycolmap.Reconstruction) -> list[pycolmap.Image]:
    """Return the images sorted by name; the formats refer to images by this index."""
    return sorted(model.images.values(), key=lambda image: str(image.name))


def describe_points(model: pycolmap.Reconstruction, y_sign: int) -> list[tuple[str, str, str]]:
    """Format position, color and track of each point.

    A track is its length, then image index, keypoint index, x and y of each observation. x and y
    are in pixels relative to the principal point.

    Args:
        model: model of pinhole cameras.
        y_sign: 1 for y down, -1 for y up.
    """
    rows = {image.image_id: row for row, image in enumerate(sort_images_by_name(model))}
    described = []
    for _, point in sorted(model.points3D.items()):
        views = []
        for element in point.track.elements:
            image = model.images[element.image_id]
            camera = model.cameras[image.camera_id]
            x, y = image.points2D[element.point2D_idx].xy
            x, y = x - camera.principal_point_x, y_sign * (y - camera.principal_point_y)
            views.append(f"{rows[element.image_id]} {element.point2D_idx} {x:.8g} {y:.8g}")
        color = " ".join(str(int(value)) for value in point.color)
        described.append((format_numbers(point.xyz), color, " ".join([str(len(views)), *views])))
    return described


def format_numbers(values: Iterable[float]) -> str:
    """Format numbers with twelve digits, separated by spaces."""
    return " ".join(f"{value:.12g}" for value in np.asarray(values))
