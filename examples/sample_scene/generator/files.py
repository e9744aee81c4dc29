"""Scene folder on disk: intrinsics, poses, exact maps, priors."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pycolmap
from numpy.typing import NDArray

from .cameras import Camera, Pose, Truth
from .priors import Prior

JPEG_SCAN = 0xDA
"""JPEG marker of the segment with the pixels."""
JPEG_NOTES = (0xE1, 0xFE)
"""JPEG markers of segments with application data and comments."""


def write_intrinsics(folder: Path, camera: Camera) -> None:
    """Write ``intrinsics.yaml``."""
    lines = [
        "# fx, fy, cx, cy in pixels; centre of the first pixel is (0.5, 0.5)",
        "1:",
        f"  params: {camera.params}",
        "  images: all",
    ]
    (folder / "intrinsics.yaml").write_text("\n".join(lines) + "\n")


def write_poses(folder: Path, camera: Camera, poses: dict[str, Pose]) -> None:
    """Write camera and poses (by image name) as COLMAP text model ``gt/`` without points."""
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(
        pycolmap.Camera(
            camera_id=1,
            model="PINHOLE",
            width=camera.width,
            height=camera.height,
            params=camera.params,
        )
    )
    for image_id, (name, pose) in enumerate(poses.items(), start=1):
        cam_from_world = pycolmap.Rigid3d(
            pycolmap.Rotation3d(pose.rotation), -pose.rotation @ pose.centre
        )
        image = pycolmap.Image(name=name, camera_id=1, image_id=image_id)
        model.add_image_with_trivial_frame(image, cam_from_world)
    (folder / "gt").mkdir(exist_ok=True)
    model.write_text(folder / "gt")


def write_truth(folder: Path, stem: str, truth: Truth) -> None:
    """Write exact depth (16-bit PNG in mm, 0 invalid) and exact normals (RGB PNG) of a view."""
    _write_png(folder / "gt_depth" / f"{stem}.png", np.round(truth.depth * 1000).astype(np.uint16))
    colour = np.round((truth.normals / 2 + 0.5) * 255).astype(np.uint8)
    colour[truth.depth == 0] = 127
    _write_png(folder / "gt_normals" / f"{stem}.png", colour[..., ::-1])


def write_prior(path: Path, kind: str, prior: Prior) -> None:
    """Write a prior as ``.npz``: arrays ``kind``, ``variance`` (float16), ``valid`` (bool).

    Values are rounded to a few significant digits, which compresses better.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    hole = ~prior.valid
    values = np.where(hole.reshape(hole.shape + (1,) * (prior.values.ndim - 2)), 0, prior.values)
    exponent = np.floor(np.log2(prior.variance.clip(1e-12)))
    step = 2.0 ** (exponent - 5)
    variance = np.where(hole, 0, np.round(prior.variance / step) * step)
    maps = {kind: np.round(values * 1024) / 1024, "variance": variance}
    np.savez_compressed(path, **{k: v.astype(np.float16) for k, v in maps.items()}, valid=~hole)


def drop_jpeg_notes(path: Path) -> None:
    """Remove date and render time from a JPEG file of Blender, without changing the pixels."""
    data = path.read_bytes()
    kept, start = data[:2], 2
    while data[start + 1] != JPEG_SCAN:
        end = start + 2 + int.from_bytes(data[start + 2 : start + 4], "big")
        if data[start + 1] not in JPEG_NOTES:
            kept += data[start:end]
        start = end
    path.write_bytes(kept + data[start:])


def _write_png(path: Path, pixels: NDArray[np.uint8] | NDArray[np.uint16]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), pixels, [cv2.IMWRITE_PNG_COMPRESSION, 9])
