"""Accuracy of MP-SfM and COLMAP on photo collections in which each photo has another camera.

    python -m benchmarks.mixed_cameras [SCENE ...] [--draws 3] [--max-images 12]
        [--config default] [--seeds 1] [--known-cameras] [--without-colmap]
        [--set KEY=VALUE ...] [--folder FOLDER]

A draw resamples each photo of a scene to a random camera of its own. The focal length is up to 2.5
times the longer image side, and as short as 0.6 times if the original photo is wide enough. Radial
distortion moves the image corners by -5 to 2 % of their radius. Image sizes and formats differ. The
focal length in EXIF is right for two fifths of the photos, missing for two fifths, and wrong by a
factor of 1.5 to 3 for the rest. The result table has the columns of :mod:`benchmarks.real_photos`.
Draws and table rows are stored in ``--folder``, so that an interrupted benchmark continues.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2
import numpy as np
import pycolmap
from PIL import Image

from benchmarks._scenes import shared_folder
from benchmarks.distortion import map_pixels
from benchmarks.real_photos import (
    add_method_arguments,
    format_table,
    list_methods,
    open_folder,
    reconstruct_or_read,
)
from mpsfm_core.data import Float64, UInt8
from mpsfm_core.geometry import inside, pixel_centers
from mpsfm_core.geometry.focal_length import compute_equivalent_mm
from mpsfm_core.results.colmap_model import write_model

SCENES = ("data/fountain", "data/rendered_kitchen", "photos/lund_door", "photos/mobilebrick")
FOCAL_RATIOS = (0.6, 2.5)
"""Smallest and largest focal length in longer image sides."""
CORNER_SHIFTS = (-0.05, 0.02)
"""Smallest and largest displacement of an image corner by the simulated radial distortion, divided
by the distance from the corner to the image center. Negative displacements are towards the
center."""
ASPECTS = (4 / 3, 3 / 2, 3 / 4, 1.0)
MAX_MAGNIFICATION = 1.5
"""Largest enlargement of a photo, because an enlarged photo has no fine details."""
LONGER_SIDES = (600, 900)
EXIF_KINDS = ("right", "missing", "wrong", "right", "missing")
"""Focal length in EXIF of five photos, repeated for all photos and shuffled."""
WRONG_FACTORS = (1.5, 3.0)
EXIF_IFD, EQUIVALENT_TAG = 0x8769, 0xA405
FOCAL_STEP = 1.02
"""Ratio of consecutive focal lengths in the search for a camera without blank pixels."""


def main() -> None:
    """Parse the command line, resample the scenes, reconstruct them, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("scenes", nargs="*", default=SCENES, help="scene folders in ../shared")
    parser.add_argument("--draws", type=int, default=3)
    parser.add_argument("--max-images", type=int, default=12, help="evenly spaced images")
    add_method_arguments(parser)
    arguments = parser.parse_args()
    rows = []
    with open_folder(arguments) as folder:
        for source in [shared_folder() / scene for scene in arguments.scenes]:
            for draw in range(arguments.draws):
                target = Path(folder) / f"{source.name} draw {draw}"
                if not (target / "gt").is_dir():
                    write_mixed_cameras(source, target, draw, arguments.max_images)
                for method in list_methods(arguments):
                    rows.append(reconstruct_or_read(target, method, arguments, target))
    print(format_table(rows))


def write_mixed_cameras(source: Path, target: Path, draw: int, max_images: int) -> None:
    """Write a scene with images resampled to random cameras, with right, missing or wrong EXIF.

    Args:
        source: Scene folder with ``images/`` and a COLMAP model ``gt/``.
        target: Folder to which the resampled scene is written.
        draw: Seed of the random cameras.
        max_images: Maximum number of images.
    """
    random = np.random.default_rng(draw)
    truth, resampled = pycolmap.Reconstruction(source / "gt"), pycolmap.Reconstruction()
    chosen = sorted(truth.images.values(), key=lambda image: str(image.name))
    chosen = chosen[:: -(-len(chosen) // max_images)]
    kinds = random.permutation(np.resize(EXIF_KINDS, len(chosen)))
    (target / "images").mkdir(parents=True, exist_ok=True)
    for number, (image, kind) in enumerate(zip(chosen, kinds, strict=True), start=1):
        camera = draw_camera(image.camera, random)
        camera.camera_id = number
        pixels = resample(cv2.imread(str(source / "images" / image.name)), image.camera, camera)
        exif = Image.Exif()
        factor = np.exp(random.uniform(*np.log(WRONG_FACTORS))) ** random.choice([-1, 1])
        if kind != "missing":
            focal_px = camera.focal_length * (factor if kind == "wrong" else 1.0)
            equivalent_mm = compute_equivalent_mm(focal_px, camera.width, camera.height)
            exif.get_ifd(EXIF_IFD)[EQUIVALENT_TAG] = round(equivalent_mm)
        name = f"{Path(str(image.name)).stem}.jpg"
        rgb = Image.fromarray(cv2.cvtColor(pixels, cv2.COLOR_BGR2RGB))
        rgb.save(target / "images" / name, quality=95, exif=exif)
        resampled.add_camera_with_trivial_rig(camera)
        resampled.add_image_with_trivial_frame(
            pycolmap.Image(name=name, camera_id=number, image_id=number), image.cam_from_world()
        )
    write_model(target / "gt", resampled, text=True)


def draw_camera(original: pycolmap.Camera, random: np.random.Generator) -> pycolmap.Camera:
    """Draw a SIMPLE_RADIAL camera whose images need no pixels outside the original image."""
    ratio = float(np.exp(random.uniform(*np.log(FOCAL_RATIOS))))
    aspect, shift = random.choice(ASPECTS), random.uniform(*CORNER_SHIFTS)
    while True:
        largest = MAX_MAGNIFICATION * original.mean_focal_length() / ratio
        longer = min(float(random.uniform(*LONGER_SIDES)), largest)
        width, height = round(longer * min(aspect, 1.0)), round(longer / max(aspect, 1.0))
        focal_px = ratio * max(width, height)
        radial = shift / (0.5 * float(np.hypot(width, height)) / focal_px) ** 2
        params = np.array([focal_px, width / 2, height / 2, radial])
        camera = pycolmap.Camera(model="SIMPLE_RADIAL", width=width, height=height, params=params)
        side = np.linspace(0.0, 1.0, 9)
        border = np.array([(x, y) for x in side for y in side if {x, y} & {0.0, 1.0}])
        xy = map_pixels(camera, original, border * (width, height))
        if np.isfinite(xy).all() and inside(xy, (original.width, original.height)).all():
            return camera
        ratio *= FOCAL_STEP


def resample(image: UInt8, original: pycolmap.Camera, camera: pycolmap.Camera) -> UInt8:
    """Resample a BGR image of the original camera to a new camera without aliasing."""
    factor = min(1.0, camera.mean_focal_length() / original.mean_focal_length())
    size = round(factor * original.width), round(factor * original.height)
    reduced = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    centers = pixel_centers(camera.width, camera.height).reshape(-1, 2)
    scale: Float64 = np.array(size) / (original.width, original.height)
    xy = (map_pixels(camera, original, centers) * scale - 0.5).astype(np.float32)
    shape = camera.height, camera.width, 2
    resampled: UInt8 = cv2.remap(
        reduced, xy.reshape(shape), None, cv2.INTER_CUBIC, None, cv2.BORDER_REPLICATE
    )
    return resampled


if __name__ == "__main__":
    main()
