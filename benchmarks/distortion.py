"""Accuracy of our defaults and COLMAP's defaults on photos with added radial distortion.

    python -m benchmarks.distortion [SCENE ...] [--radial -0.25 -0.1 0 0.05] [--width 640]
        [--max-images N] [--seeds 1] [--without-colmap] [--set KEY=VALUE ...] [--folder FOLDER]

The images of a scene are resampled to a SIMPLE_RADIAL camera with the principal point at the image
center. The focal length of the SIMPLE_RADIAL camera is the shortest one for which no pixel is
blank. Neither program gets intrinsics. The result table has the columns of
:mod:`benchmarks.real_photos`. Table rows are stored in ``--folder``, so that an interrupted
benchmark continues.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from contextlib import nullcontext
from pathlib import Path

import cv2
import numpy as np
import pycolmap

from benchmarks._scenes import shared_folder
from benchmarks.real_photos import format_table, reconstruct_and_measure
from mpsfm_core.data import Float64
from mpsfm_core.geometry import inside, pixel_centers
from mpsfm_core.inputs.undistortion import resize_camera
from mpsfm_core.results.colmap_model import write_model

NUM_BISECTIONS = 40
"""Number of bisection steps in the search for the shortest focal length with which a resampled
image has no blank pixels."""


def main() -> None:
    """Parse the command line, resample the scenes, reconstruct them, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("scenes", nargs="*", default=["fountain", "rendered_kitchen"])
    parser.add_argument("--radial", nargs="+", type=float, default=[-0.25, -0.1, 0.0, 0.05])
    parser.add_argument("--width", type=int, default=640)
    parser.add_argument("--max-images", type=int, default=12)
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--without-colmap", action="store_true")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", dest="overrides")
    parser.add_argument("--folder", type=Path, help="folder of the resampled images and rows")
    arguments = parser.parse_args()
    methods = [f"seed {seed}" for seed in range(arguments.seeds)]
    methods += [] if arguments.without_colmap else ["COLMAP"]
    kept = arguments.folder and nullcontext(str(arguments.folder))
    rows = []
    with kept or tempfile.TemporaryDirectory(prefix="mpsfm-distortion-") as folder:
        for scene in arguments.scenes:
            for radial in arguments.radial:
                target = Path(folder) / f"{scene} {radial:+g}"
                if not (target / "gt").is_dir():
                    source = shared_folder() / "data" / scene
                    distort_scene(source, target, radial, arguments.width, arguments.max_images)
                for method in methods:
                    stored = target / f"{method}.json"
                    if not stored.exists():
                        row = reconstruct_and_measure(target, method, arguments.overrides)
                        stored.write_text(json.dumps(row), encoding="utf-8")
                    rows.append(json.loads(stored.read_text(encoding="utf-8")))
    print(format_table(rows))


def distort_scene(source: Path, target: Path, radial: float, width: int, max_images: int) -> None:
    """Write a scene with images resampled to a camera with radial distortion.

    Args:
        source: Scene folder with ``images/`` and the COLMAP model ``gt/`` of pinhole cameras.
        target: Folder to which the resampled scene is written.
        radial: Radial distortion coefficient of the new camera.
        width: Width of the new images in pixels.
        max_images: Maximum number of images; the selected images are evenly spaced in the order of
            their names.
    """
    truth = pycolmap.Reconstruction(source / "gt")
    images = sorted(truth.images.values(), key=lambda image: str(image.name))
    images = images[:: -(-len(images) // max_images)]
    model = pycolmap.Reconstruction()
    (target / "images").mkdir(parents=True, exist_ok=True)
    for number, image in enumerate(images, start=1):
        height = round(image.camera.height * width / image.camera.width)
        pinhole = resize_camera(image.camera, (width, height))
        camera = find_camera(pinhole, radial)
        camera.camera_id = number
        rgb = cv2.imread(str(source / "images" / image.name))
        reduced = cv2.resize(rgb, (width, height), interpolation=cv2.INTER_AREA)
        centers = pixel_centers(width, height).reshape(-1, 2)
        pixels = (map_pixels(camera, pinhole, centers) - 0.5).astype(np.float32)
        distorted = cv2.remap(
            reduced, pixels.reshape(height, width, 2), None, cv2.INTER_CUBIC, None,
            cv2.BORDER_REPLICATE,
        )  # fmt: skip
        name = f"{Path(str(image.name)).stem}.png"
        cv2.imwrite(str(target / "images" / name), distorted)
        model.add_camera_with_trivial_rig(camera)
        model.add_image_with_trivial_frame(
            pycolmap.Image(name=name, camera_id=number, image_id=number), image.cam_from_world()
        )
    write_model(target / "gt", model, text=True)


def find_camera(pinhole: pycolmap.Camera, radial: float) -> pycolmap.Camera:
    """Return the SIMPLE_RADIAL camera of shortest focal length without pixels outside the image."""
    width, height = pinhole.width, pinhole.height
    corners = np.array([[x, y] for x in (0.5, width - 0.5) for y in (0.5, height - 0.5)])
    low_px, high_px = 0.2 * pinhole.mean_focal_length(), 5 * pinhole.mean_focal_length()
    for _ in range(NUM_BISECTIONS):
        focal_px = (low_px * high_px) ** 0.5
        camera = pycolmap.Camera(
            model="SIMPLE_RADIAL",
            width=width,
            height=height,
            params=[focal_px, width / 2, height / 2, radial],
        )
        xy = map_pixels(camera, pinhole, corners)
        fits = bool(np.isfinite(xy).all() and inside(xy, (width, height)).all())
        low_px, high_px = (low_px, focal_px) if fits else (focal_px, high_px)
    camera.params = np.array([high_px, width / 2, height / 2, radial])
    return camera


def map_pixels(camera: pycolmap.Camera, pinhole: pycolmap.Camera, xy: Float64) -> Float64:
    """Map pixels (n, 2) of the distorted image to pixels of the pinhole image."""
    rays = camera.cam_from_img(xy)
    mapped: Float64 = pinhole.img_from_cam(np.column_stack([rays, np.ones(len(rays))]))
    return mapped


if __name__ == "__main__":
    main()
