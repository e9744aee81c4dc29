"""Format 3D points and tracks as text for the Bundler and NVM exports."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import pycolmap

from mpsfm_core.data.errors import InputError


def check_names_without_spaces(names: Iterable[str], format_name: str) -> None:
    """Raise an :class:`InputError` if an image name has a space, the field separator."""
    for name in names:
        if len(name.split()) != 1:
            raise InputError(
                f"{format_name} does not allow spaces in names such as {name!r}; rename the photo, "
                f"or export to a format that allows them, such as colmap-db or nerfstudio"
            )


def sort_images_by_name(model: pycolmap.Reconstruction) -> list[pycolmap.Image]:
    """Return the images of a model sorted by name, the image order of the text formats."""
    return sorted(model.images.values(), key=lambda image: str(image.name))


def describe_points(model: pycolmap.Reconstruction, y_sign: int) -> list[tuple[str, str, str]]:
    """Format position, color and track of each 3D point as text.

    A track is written as its length, then image index, keypoint index, x and y of each observation,
    where x and y are pixels relative to the principal point.

    Args:
        model: COLMAP model with pinhole cameras.
        y_sign: sign of the image y axis, 1 for y down and -1 for y up.
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
