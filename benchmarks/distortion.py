"""Accuracy of our configurations and COLMAP's on photos with added radial distortion.

    python -m benchmarks.distortion [SCENE ...] [--lenses MODEL:K1,K2,... ...] [--width 640]
        [--max-images N | --buckets BUCKET ...] [--max-sets N] [--config default] [--seeds 1]
        [--known-cameras] [--without-colmap] [--set KEY=VALUE ...] [--folder FOLDER]

The images of a scene are resampled to a camera with lens distortion and the principal point at the
image center. A lens is a COLMAP camera model with its distortion coefficients, such as
``RADIAL:-0.2,0.05``. The focal length of the camera is the shortest one for which no pixel is
blank. Both programs estimate the camera model of the lens, and get no intrinsics; additional rows
of ``--known-cameras`` have the true cameras. COLMAP estimates one camera per photo by default, and
one camera for all photos in an additional row of models other than SIMPLE_RADIAL. The result table
has the columns of :mod:`benchmarks.real_photos`. With ``--buckets``, the photos are those of the
test sets of each bucket, such as ``minimal`` or ``leq30``, and a table row is the mean of the first
``--max-sets`` test sets. Table rows are stored in ``--folder``, so that an
interrupted benchmark continues.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from itertools import groupby
from operator import attrgetter
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pycolmap

from benchmarks._scenes import shared_folder
from benchmarks.real_photos import (
    add_method_arguments,
    format_table,
    list_methods,
    open_folder,
    pool_rows,
    reconstruct_or_read,
)
from mpsfm_core.data import Float64
from mpsfm_core.data.camera_models import NUM_DISTORTION, CameraModel
from mpsfm_core.evaluation.scene_folder import read_scene
from mpsfm_core.geometry import inside, pixel_centers
from mpsfm_core.inputs.undistortion import resize_camera
from mpsfm_core.results.colmap_model import write_model

DEFAULT_MODEL = CameraModel.SIMPLE_RADIAL
LENSES = [
    *(f"SIMPLE_RADIAL:{radial:+g}" for radial in (-0.25, -0.1, 0.0, 0.05)),
    "RADIAL:-0.2,0.05",
    "OPENCV_FISHEYE:0.05,-0.02",
]
"""Camera models and distortion coefficients with which the photos are resampled."""
ONE_CAMERA = "COLMAP, one camera"
NUM_BISECTIONS = 40
"""Number of bisection steps in the search for the shortest focal length with which a resampled
image has no blank pixels."""


def main() -> None:
    """Parse the command line, resample the scenes, reconstruct them, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("scenes", nargs="*", default=["fountain", "rendered_kitchen"])
    parser.add_argument("--lenses", nargs="+", default=LENSES, metavar="MODEL:K1,K2,...")
    parser.add_argument("--width", type=int, default=640)
    parser.add_argument("--max-images", type=int, default=12, help="evenly spaced images")
    parser.add_argument("--buckets", nargs="+", help="use the test sets of these buckets")
    parser.add_argument("--max-sets", type=int, help="number of test sets of a bucket")
    add_method_arguments(parser)
    arguments = parser.parse_args()
    rows = []
    with open_folder(arguments) as folder:
        for scene in arguments.scenes:
            source = shared_folder() / "data" / scene
            for label, sets in list_photo_sets(source, arguments).items():
                for lens in arguments.lenses:
                    rows += measure_lens(source, label, sets, lens, arguments, Path(folder))
    print(format_table(rows))


def list_photo_sets(
    source: Path, arguments: argparse.Namespace
) -> dict[str, list[tuple[str, ...]]]:
    """Select the photo sets of a scene; return the image names of each set by its row label.

    Args:
        source: Scene folder.
        arguments: Arguments with the number of images, or with the buckets and the number of test
            sets of each bucket.
    """
    scene = read_scene(source, with_sets=arguments.buckets is not None)
    if arguments.buckets is None:
        names = sorted(scene.sets[0].images)
        return {source.name: [tuple(names[:: -(-len(names) // arguments.max_images)])]}
    sets = {
        bucket: [item.images for item in items]
        for bucket, items in groupby(scene.select_sets(arguments.buckets), attrgetter("bucket"))
    }
    return {f"{source.name} {bucket}": of[: arguments.max_sets] for bucket, of in sets.items()}


def measure_lens(
    source: Path,
    label: str,
    sets: Sequence[Sequence[str]],
    lens: str,
    arguments: argparse.Namespace,
    folder: Path,
) -> list[dict[str, Any]]:
    """Resample photo sets to a lens, and return a table row of each reconstruction method.

    Args:
        source: Scene folder.
        label: Name of the photo sets in the table.
        sets: Image names of each photo set.
        lens: Camera model with its distortion coefficients.
        arguments: Arguments with the methods and settings of :mod:`benchmarks.real_photos`.
        folder: Folder of the resampled photos and of the rows.
    """
    model, coefficients = parse_lens(lens)
    methods = list_methods(arguments)
    if "COLMAP" in methods and model != DEFAULT_MODEL:
        methods.append(ONE_CAMERA)
    name = f"{label} {lens.replace(':', ' ')}"
    targets = [folder / (f"{name} {i}" if arguments.buckets else name) for i in range(len(sets))]
    for target, images in zip(targets, sets, strict=True):
        if not (target / "gt").is_dir():
            distort_scene(source, target, model, coefficients, arguments.width, images)
    rows = []
    for method in methods:
        of = [reconstruct_or_read(at, method, arguments, at, model) for at in targets]
        rows.append(pool_rows(name, of) if arguments.buckets else of[0])
    return rows


def parse_lens(text: str) -> tuple[CameraModel, Float64]:
    """Parse a lens ``MODEL:K1,K2,...`` to the camera model and (4,) distortion coefficients."""
    name, _, values = text.partition(":")
    coefficients = np.zeros(NUM_DISTORTION)
    given = [float(value) for value in values.split(",")]
    coefficients[: len(given)] = given
    return CameraModel(name), coefficients


def distort_scene(
    source: Path,
    target: Path,
    model: CameraModel,
    coefficients: Float64,
    width: int,
    names: Sequence[str],
) -> None:
    """Write a scene with images resampled to a camera with lens distortion.

    Args:
        source: Scene folder with ``images/`` and the COLMAP model ``gt/`` of pinhole cameras.
        target: Folder to which the resampled scene is written.
        model: Camera model of the new camera.
        coefficients: (4,) distortion coefficients of the new camera.
        width: Width of the new images in pixels.
        names: Names of the images.
    """
    truth = pycolmap.Reconstruction(source / "gt")
    images = [image for image in truth.images.values() if image.name in names]
    images.sort(key=lambda image: str(image.name))
    distorted_truth = pycolmap.Reconstruction()
    (target / "images").mkdir(parents=True, exist_ok=True)
    for number, image in enumerate(images, start=1):
        height = round(image.camera.height * width / image.camera.width)
        pinhole = resize_camera(image.camera, (width, height))
        camera = find_camera(pinhole, model, coefficients)
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
        distorted_truth.add_camera_with_trivial_rig(camera)
        distorted_truth.add_image_with_trivial_frame(
            pycolmap.Image(name=name, camera_id=number, image_id=number), image.cam_from_world()
        )
    write_model(target / "gt", distorted_truth, text=True)


def find_camera(
    pinhole: pycolmap.Camera, model: CameraModel, coefficients: Float64
) -> pycolmap.Camera:
    """Return the camera of shortest focal length without pixels outside the image."""
    width, height = pinhole.width, pinhole.height
    corners = np.array([[x, y] for x in (0.5, width - 0.5) for y in (0.5, height - 0.5)])

    def make_camera(focal_px: float) -> pycolmap.Camera:
        intrinsics = np.array([focal_px, focal_px, width / 2, height / 2])
        params = model.to_params(intrinsics, coefficients)
        return pycolmap.Camera(model=model.value, width=width, height=height, params=params)

    low_px, high_px = 0.2 * pinhole.mean_focal_length(), 5 * pinhole.mean_focal_length()
    for _ in range(NUM_BISECTIONS):
        focal_px = (low_px * high_px) ** 0.5
        camera = make_camera(focal_px)
        xy = map_pixels(camera, pinhole, corners)
        fits = bool(np.isfinite(xy).all() and inside(xy, (width, height)).all())
        low_px, high_px = (low_px, focal_px) if fits else (focal_px, high_px)
    return make_camera(high_px)


def map_pixels(camera: pycolmap.Camera, pinhole: pycolmap.Camera, xy: Float64) -> Float64:
    """Map pixels (n, 2) of the distorted image to pixels of the pinhole image."""
    rays = camera.cam_from_img(xy)
    mapped: Float64 = pinhole.img_from_cam(np.column_stack([rays, np.ones(len(rays))]))
    return mapped


if __name__ == "__main__":
    main()
