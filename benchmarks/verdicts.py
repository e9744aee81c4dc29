"""Comparison of the verdicts of ``summary.json`` with the true pose errors of the images.

    python -m benchmarks.verdicts [SET ...] [--config default] [--cache FOLDER] [--output FILE]

The photo sets are the real photo sets, the scene fountain, low-overlap sets of the scenes
rendered_kitchen and hololens_room, and adversarial photo sets with identical photos, a pure
rotation, an object that turns before a static background, wrong EXIF, different zooms, crops, or
edited copies. The photo sets are reconstructed without known intrinsics. The error of an image is
its median relative pose error with the other images. A relative pose error is the maximum of the
rotation error and the translation direction error in degrees. If the verdict is "good", at most 2 %
of the images should have an error above 2 degrees, and no image an error above 5 degrees. Photo
sets with a result in the folder ``--cache`` are not reconstructed again.
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
"""Pose errors in degrees above which the pose of an image counts as wrong."""
LONGER_SIDE = 640
"""Longer side in pixels of the photos of generated photo sets."""
NUM_LOW_OVERLAP_SETS = 5
"""Number of low-overlap test sets per bucket (group of test sets of similar overlap)."""

Photo = tuple[UInt8, dict[int, float]]
"""Photo as BGR pixels, with numeric tags of its EXIF directory."""
Edit = Callable[[UInt8, int], Photo]
"""Function that edits a photo, given its pixels and its number in the photo set."""


def main() -> None:
    """Reconstruct all photo sets without a stored result, and print the table of verdicts."""
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
"""Function that writes a photo set to a folder, and returns the true poses by name of the photo."""


def list_sets(shared: Path) -> dict[str, Writer]:
    """Return the functions that write the photo sets, by name of the photo set."""
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
    """Return a function that links the named photos of a scene, or all photos."""

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
    """Return a function that writes edited photos of a scene to a folder.

    Args:
        scene: Scene folder with the original photos.
        edit: Function that edits each photo.
        stems: Names of the edited photos without suffix, or None for all photos.
        same_photo: Replace each photo by the first photo of the scene before editing.
        with_copies: Add a brightened copy of each photo to the photo set.
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
    """Crop and enlarge an image about a point off its center by ``shift`` times half the size."""
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
    """Return the photo of a camera that is rotated about its vertical axis without translation."""
    height, width = image.shape[:2]
    matrix = np.array([[0.9 * width, 0, width / 2], [0, 0.9 * width, height / 2], [0, 0, 1]])
    rotation = cv2.Rodrigues(np.array([0.0, np.radians(4.0 * (number - 2)), 0.0]))[0]
    homography = matrix @ rotation @ np.linalg.inv(matrix)
    turned = cv2.warpPerspective(image, homography, (width, height), flags=cv2.INTER_CUBIC)
    margin_y, margin_x = height // 6, width // 6
    return turned[margin_y:-margin_y, margin_x:-margin_x].copy(), {}


def read_poses(scene: Path, folder: Path) -> dict[str, Pose]:
    """Return the true poses of the photos in a folder by name, or no poses without a true model."""
    if not (scene / "gt").is_dir():
        return {}
    poses = reconstruction_poses(pycolmap.Reconstruction(scene / "gt"))
    by_stem = {Path(name).stem: pose for name, pose in poses.items()}
    return {path.name: by_stem[path.stem] for path in folder.iterdir() if path.stem in by_stem}


def run_set(name: str, write: Writer, config: str) -> dict[str, Any]:
    """Reconstruct a photo set without intrinsics, and return its summary and image errors."""
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
    """Compute the median relative pose error in degrees of each image with the other images."""
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
    """Return the rotation and the translation direction from the first to the second camera."""
    baseline = a[0] @ (camera_center(*b) - camera_center(*a))
    return b[0] @ a[0].T, baseline / max(float(np.linalg.norm(baseline)), 1e-12)


def describe(run: Mapping[str, Any]) -> dict[str, Any]:
    """Compute the verdict of a stored reconstruction, and count the images with wrong poses."""
    if "error" in run:
        return {"set": run["set"], "verdict": "failed", "doubts": run["error"][:60]}
    verdict = judge(run["summary"])
    errors = list(run["errors_deg"].values())
    wrong = [sum(error > limit for error in errors) for limit in MAX_ERRORS_DEG]
    evidence = run["summary"]["reconstructions"][0]["evidence"]["images"]
    predicted = [image["pose_error_deg"] for image in evidence.values()]
    return {
        "set": run["set"],
        "registered": f"{len(run['summary']['images']['registered'])} of "
        f"{run['summary']['images']['total']}",
        "wrong": [f"{count} of {len(errors)}" for count in wrong] if errors else ["-", "-"],
        "max_error_deg": f"{max(errors):.1f}" if errors else "-",
        "predicted_deg": "-" if None in predicted else f"{max(predicted):.1f}",
        "verdict": verdict.level,
        "doubts": ", ".join(doubt.reason.code.value for doubt in verdict.doubts),
    }


def format_table(rows: Sequence[Mapping[str, Any]]) -> str:
    """Format a Markdown table with the verdict and the number of wrong images of each photo set."""
    limits = " | ".join(f"> {limit:g} deg" for limit in MAX_ERRORS_DEG)
    lines = [
        f"| set | registered | {limits} | max. error, deg | predicted | verdict | doubts |",
        "|---" * 8 + "|",
    ]
    for row in rows:
        cells = [row["set"], row.get("registered", "0"), *row.get("wrong", ["-", "-"])]
        cells += [row.get("max_error_deg", "-"), row.get("predicted_deg", "-")]
        lines.append("| " + " | ".join([*cells, row["verdict"], row["doubts"] or "-"]) + " |")
    return "\n".join(lines)


if __name__ == "__main__":
    main()
