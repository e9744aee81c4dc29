"""Verdicts of runs beside the true pose errors of their images.

    python -m benchmarks.verdicts [SET ...] [--config default] [--cache FOLDER] [--output FILE]

The sets are the real photo sets, fountain, low-overlap sets of rendered_kitchen and hololens_room,
and adversarial inputs: identical photos, a pure rotation, an object that turns before a static
background, wrong EXIF, and photos with other zooms, crops and edited copies. No run gets
intrinsics. The error of an image is the median over the other images of the pose error of the pair,
the maximum of rotation and translation direction in degrees. A verdict "good" should mean that at
most 2 % of the images have an error of more than 2 degrees, and no image one of more than 5.
Finished runs in the cache folder are not repeated.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from itertools import islice
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pycolmap
from PIL import Image

from benchmarks._scenes import shared_folder
from mpsfm_core import reconstruct
from mpsfm_core.data import Float64, Pose, UInt8
from mpsfm_core.data.errors import MpsfmError
from mpsfm_core.evaluation.scene_folder import read_scene
from mpsfm_core.geometry import angle_between_deg, camera_center, rotation_angle_deg
from mpsfm_core.inputs.models import reconstruction_poses
from mpsfm_core.report.verdict import judge

MAX_ERRORS_DEG = (2.0, 5.0)
"""Errors above which an image counts as wrong."""
LONGER_SIDE = 640
"""Longer side in pixels of the photos of generated sets."""
NUM_LOW_OVERLAP_SETS = 2
"""Number of sets of each low-overlap bucket."""

Photo = tuple[UInt8, dict[int, float]]
"""BGR pixels and numeric tags of the EXIF directory."""
Edit = Callable[[UInt8, int], Photo]
"""Function that edits a photo, given its pixels and its number in the set."""


def main() -> None:
    """Parse the command line, run or read all sets, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("sets", nargs="*", metavar="SET")
    parser.add_argument("--config", default="default")
    parser.add_argument("--cache", type=Path, default=Path("verdicts"))
    parser.add_argument("--output", type=Path, help="also write the table to this file")
    arguments = parser.parse_args()
    arguments.cache.mkdir(parents=True, exist_ok=True)
    rows = []
    for name, write in list_sets(shared_folder()).items():
        file = arguments.cache / f"{name}.json"
        if arguments.sets and name not in arguments.sets:
            continue
        if not file.is_file():
            file.write_text(json.dumps(run_set(name, write, arguments.config)), encoding="utf-8")
        rows.append(describe(json.loads(file.read_text(encoding="utf-8"))))
        print(rows[-1], file=sys.stderr, flush=True)
    text = format_table(rows)
    print(text)
    if arguments.output:
        arguments.output.write_text(text + "\n", encoding="utf-8")


Writer = Callable[[Path], dict[str, Pose]]
"""Function that writes the photos of a set into a folder and returns their true poses by name."""


def list_sets(shared: Path) -> dict[str, Writer]:
    """Return the functions that write each set of photos, by name of the set."""
    fountain = shared / "data" / "fountain"
    sets: dict[str, Writer] = {
        name: link_photos(shared / "photos" / name)
        for name in ("lund_door", "mobilebrick", "sacre_coeur", "seneca")
    }
    sets["fountain"] = edit_photos(fountain, lambda image, _: (image, {}))
    for scene, bucket in (("rendered_kitchen", "minimal"), ("hololens_room", "leq10")):
        folder = shared / "data" / scene
        for chosen in islice(read_scene(folder).select_sets([bucket]), NUM_LOW_OVERLAP_SETS):
            sets[f"{scene}-{chosen.name}".replace("/", "-")] = link_photos(folder, chosen.images)
    five = [f"000{number}" for number in range(2, 7)]
    edits: dict[str, Edit] = {
        "base5": lambda image, _: (image, {}),
        "identical": lambda image, _: (image, {}),
        "exif-80mm": lambda image, _: (image, {0xA405: 80}),
        "exif-65535mm": lambda image, _: (image, {0xA405: 65535}),
        "zoom": lambda image, number: (crop(image, (1, 1.5, 1, 0.9)[number % 4]), {}),
        "crop": lambda image, number: (crop(image, 1.3, shift=0.1 * (number % 3 - 1)), {}),
        "turntable": lambda image, _: (on_background(image), {}),
        "rotation": rotate_view,
    }
    sets["copies"] = edit_photos(fountain, lambda image, _: (image, {}), five, with_copies=True)
    same = {"identical", "rotation"}
    for name, edit in edits.items():
        sets[name] = edit_photos(fountain, edit, five, same_photo=name in same)
    return sets


def link_photos(scene: Path, names: Sequence[str] | None = None) -> Writer:
    """Return a function that links the photos of a scene, or some of them."""

    def write(folder: Path) -> dict[str, Pose]:
        for path in (scene / "images").iterdir():
            if names is None or path.name in names or path.stem in names:
                (folder / path.name).symlink_to(path.resolve())
        return read_poses(scene, folder)

    return write


def edit_photos(
    scene: Path,
    edit: Edit,
    stems: Sequence[str] | None = None,
    *,
    same_photo: bool = False,
    with_copies: bool = False,
) -> Writer:
    """Return a function that writes edited photos.

    Args:
        scene: Scene folder.
        edit: Function that edits each photo.
        stems: Names of the photos without suffix, or None for all.
        same_photo: Edit the first photo again and again.
        with_copies: Also write a brightened copy of each photo.
    """

    def write(folder: Path) -> dict[str, Pose]:
        paths = sorted((scene / "images").iterdir())
        paths = [path for path in paths if stems is None or path.stem in stems]
        for number, path in enumerate(paths):
            image = cv2.imread(str(paths[0] if same_photo else path))
            height, width = image.shape[:2]
            factor = LONGER_SIDE / max(height, width)
            size = round(width * factor), round(height * factor)
            pixels, tags = edit(cv2.resize(image, size, interpolation=cv2.INTER_AREA), number)
            exif = Image.Exif()
            exif.get_ifd(0x8769).update(tags)
            rgb = Image.fromarray(cv2.cvtColor(pixels, cv2.COLOR_BGR2RGB))
            rgb.save(folder / path.name, quality=95, exif=exif)
            if with_copies:
                rgb.point(lambda value: 1.2 * value + 10).save(folder / f"{path.stem}.png")
        return {} if same_photo else read_poses(scene, folder)

    return write


def crop(image: UInt8, zoom: float, shift: float = 0.0) -> UInt8:
    """Enlarge an image about a point, which is shifted by a share of its size."""
    height, width = image.shape[:2]
    center = np.array([width / 2, height / 2]) * (1 + shift)
    matrix = np.column_stack([zoom * np.eye(2), np.array([width / 2, height / 2]) - zoom * center])
    return cv2.warpAffine(image, matrix, (width, height), flags=cv2.INTER_CUBIC)


def on_background(image: UInt8) -> UInt8:
    """Replace all except the center of an image by a static, textured background."""
    height, width = image.shape[:2]
    noise = np.random.default_rng(0).integers(0, 255, (height // 4, width // 4, 3), dtype=np.uint8)
    pixels = cv2.resize(noise, (width, height), interpolation=cv2.INTER_CUBIC)
    inside = np.zeros((height, width), np.uint8)
    cv2.circle(inside, (width // 2, height // 2), height // 3, 255, -1)
    pixels[inside > 0] = image[inside > 0]
    return pixels


def rotate_view(image: UInt8, number: int) -> Photo:
    """Return the view of a camera that turns about its vertical axis without moving."""
    height, width = image.shape[:2]
    matrix = np.array([[0.9 * width, 0, width / 2], [0, 0.9 * width, height / 2], [0, 0, 1]])
    rotation = cv2.Rodrigues(np.array([0.0, np.radians(4.0 * (number - 2)), 0.0]))[0]
    homography = matrix @ rotation @ np.linalg.inv(matrix)
    turned = cv2.warpPerspective(image, homography, (width, height), flags=cv2.INTER_CUBIC)
    margin_y, margin_x = height // 6, width // 6
    return turned[margin_y:-margin_y, margin_x:-margin_x].copy(), {}


def read_poses(scene: Path, folder: Path) -> dict[str, Pose]:
    """Return the true poses of the photos in a folder by name, empty without a reference."""
    if not (scene / "gt").is_dir():
        return {}
    poses = reconstruction_poses(pycolmap.Reconstruction(scene / "gt"))
    by_stem = {Path(name).stem: pose for name, pose in poses.items()}
    return {path.name: by_stem[path.stem] for path in folder.iterdir() if path.stem in by_stem}


def run_set(name: str, write: Writer, config: str) -> dict[str, Any]:
    """Reconstruct a set of photos without intrinsics, and return summary and errors by image."""
    start = time.perf_counter()
    with tempfile.TemporaryDirectory(prefix="mpsfm-verdicts-") as folder:
        true_poses = write(Path(folder))
        try:
            result = reconstruct(
                folder, config=config, overrides=["runtime.offline=true", "dense.enabled=false"]
            )
        except MpsfmError as error:
            return {"set": name, "error": str(error), "images": len(true_poses)}
        poses = reconstruction_poses(result.model)
    return {
        "set": name,
        "errors_deg": measure_errors_deg(poses, true_poses),
        "seconds": time.perf_counter() - start,
        "summary": json.loads(json.dumps(result.summary)),
    }


def measure_errors_deg(
    poses: Mapping[str, Pose], true_poses: Mapping[str, Pose]
) -> dict[str, float]:
    """Measure the median pose error in degrees of each image to the other images."""
    names = [name for name in true_poses if name in poses]
    errors = np.full((len(names), len(names)), np.nan)
    for i, a in enumerate(names):
        for j, b in enumerate(names):
            if i != j:
                found, true = (_relative(of[a], of[b]) for of in (poses, true_poses))
                turn = float(rotation_angle_deg(found[0] @ true[0].T))
                errors[i, j] = max(turn, float(angle_between_deg(found[1], true[1])))
    return {name: float(np.nanmedian(errors[i])) for i, name in enumerate(names)}


def _relative(a: Pose, b: Pose) -> tuple[Float64, Float64]:
    """Return rotation and translation direction from one camera to another."""
    baseline = a[0] @ (camera_center(*b) - camera_center(*a))
    return b[0] @ a[0].T, baseline / max(float(np.linalg.norm(baseline)), 1e-12)


def describe(run: Mapping[str, Any]) -> dict[str, Any]:
    """Judge a stored run with the present rules, and count its wrong images."""
    if "error" in run:
        return {"set": run["set"], "verdict": "failed", "doubts": run["error"][:60]}
    verdict = judge(run["summary"])
    errors = list(run["errors_deg"].values())
    wrong = [sum(error > limit for error in errors) for limit in MAX_ERRORS_DEG]
    return {
        "set": run["set"],
        "registered": f"{len(run['summary']['images']['registered'])} of "
        f"{run['summary']['images']['total']}",
        "wrong": [f"{count} of {len(errors)}" for count in wrong] if errors else ["-", "-"],
        "verdict": verdict.level,
        "doubts": ", ".join(doubt.reason.code.value for doubt in verdict.doubts),
    }


def format_table(rows: Sequence[Mapping[str, Any]]) -> str:
    """Format a Markdown table with one row per set."""
    limits = " | ".join(f"> {limit:g} deg" for limit in MAX_ERRORS_DEG)
    lines = [f"| set | registered | {limits} | verdict | doubts |", "|---" * 6 + "|"]
    for row in rows:
        wrong = " | ".join(row.get("wrong", ["-", "-"]))
        registered, doubts = row.get("registered", "0"), row["doubts"] or "-"
        lines.append(f"| {row['set']} | {registered} | {wrong} | {row['verdict']} | {doubts} |")
    return "\n".join(lines)


if __name__ == "__main__":
    main()
