"""Export to Bundler's ``bundle.out`` (version 0.3) and ``list.txt`` with undistorted images.

Bundler's cameras look along -z with y up. Bundler's keypoints are relative to the principal point,
y up.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from mpsfm_core.results.exports.source import ExportSource
from mpsfm_core.results.exports.tracks import (
    check_names_without_spaces,
    describe_points,
    format_numbers,
    sort_images_by_name,
)

ENTRIES = ("bundle.out", "list.txt", "images")
_FLIP = np.diag([1.0, -1.0, -1.0])


def write(source: ExportSource, folder: Path) -> None:
    """Write a folder in Bundler's format; the focal length is the mean of fx and fy.

    Raises:
        InputError: the image files are missing, or an image name has a space.
    """
    model = source.undistorted()
    images = sort_images_by_name(model)
    check_names_without_spaces((str(image.name) for image in images), "Bundler")
    source.write_photos(folder / "images")
    lines = ["# Bundle file v0.3", f"{len(images)} {model.num_points3D()}"]
    for image in images:
        pose = image.cam_from_world()
        focal = model.cameras[image.camera_id].mean_focal_length()
        lines += [f"{focal:.12g} 0 0", *map(format_numbers, _FLIP @ pose.rotation.matrix())]
        lines.append(format_numbers(_FLIP @ pose.translation))
    for point in describe_points(model, y_sign=-1):
        lines += point
    (folder / "bundle.out").write_text("\n".join([*lines, ""]), encoding="utf-8")
    names = [f"images/{image.name}" for image in images]
    (folder / "list.txt").write_text("\n".join([*names, ""]), encoding="utf-8")
