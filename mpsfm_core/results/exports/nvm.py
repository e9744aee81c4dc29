"""Export to VisualSFM's N-View Match (NVM) file with undistorted images.

Keypoints in an NVM file are relative to the principal point, x right and y down.
"""

from __future__ import annotations

from pathlib import Path

from mpsfm_core.results.exports.source import ExportSource
from mpsfm_core.results.exports.tracks import (
    check_names_without_spaces,
    describe_points,
    format_numbers,
    sort_images_by_name,
)

ENTRIES = ("reconstruction.nvm", "images")


def write(source: ExportSource, folder: Path) -> None:
    """Write a folder with an NVM file; the focal length is the mean of fx and fy.

    Raises:
        InputError: the image files are missing, or an image name has a space.
    """
    model = source.undistorted()
    images = sort_images_by_name(model)
    check_names_without_spaces((str(image.name) for image in images), "NVM")
    source.write_photos(folder / "images")
    lines = [
        "NVM_V3 ",
        " ",
        str(len(images)),
    ]  # VisualSFM writes spaces at line ends, and MeshLab requires them
    for image in images:
        x, y, z, w = image.cam_from_world().rotation.quat
        focal = model.cameras[image.camera_id].mean_focal_length()
        place = format_numbers([w, x, y, z, *image.projection_center()])
        lines.append(f"images/{image.name}\t{focal:.12g} {place} 0 0")
    lines += ["", str(model.num_points3D())]
    lines += [" ".join(point) for point in describe_points(model, y_sign=1)]
    text = "\n".join([*lines, "", "0", ""])
    (folder / "reconstruction.nvm").write_text(text, encoding="utf-8")
