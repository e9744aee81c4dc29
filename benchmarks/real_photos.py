"""Accuracy of our configurations and COLMAP's defaults on photos of unknown cameras.

    python -m benchmarks.real_photos [SET ...] [--photos FOLDER] [--config default] [--seeds 1]
        [--known-cameras] [--without-colmap] [--set KEY=VALUE ...] [--folder FOLDER]
        [--output FILE] [--json]

Each photo set is a folder with ``images/`` and, if true poses are known, a COLMAP model ``gt/``.
Neither program gets intrinsics; additional rows of ``--known-cameras`` have the cameras of ``gt/``.
COLMAP uses SIFT, all pairs, the incremental mapper and one SIMPLE_RADIAL camera per image. Pose AUC
counts all image pairs; a pair with an unregistered image has an error of 180 degrees. Rotation
errors are measured after alignment to the image with the smallest median rotation error. Camera
centers are compared with GPS after a similarity transform, horizontally. Table rows are stored in
``--folder``, so that an interrupted benchmark continues; features, matches and depth are cached as
in every run. ``--json`` prints one JSON object as the last line.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence, Set
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap

from mpsfm_core import reconstruct
from mpsfm_core.data import Float64, Pose
from mpsfm_core.data.camera_models import CameraModel
from mpsfm_core.data.errors import MpsfmError
from mpsfm_core.evaluation.pose_auc import CONVENTIONS, pose_auc, pose_errors_deg
from mpsfm_core.geometry import camera_center, rotation_angle_deg
from mpsfm_core.geometry.similarity import umeyama
from mpsfm_core.inputs.gps import convert_to_enu, read_gps
from mpsfm_core.inputs.models import reconstruction_poses
from mpsfm_core.report.verdict import judge

SETS = ("sacre_coeur", "mobilebrick", "lund_door", "seneca")
KNOWN_CAMERAS = ", known cameras"
CONVENTION = CONVENTIONS["paper"]
MAX_ROTATION_DEG = 2.0
"""Maximum rotation error in degrees of an image whose pose counts as correct. [ours]"""
MAX_FOCAL_ERROR = 0.15
"""Relative error above which the table counts a focal length as wrong, and as silent if no doubt of
the verdict names the image. [ours]"""
MIN_GPS_POSITIONS = 4
"""Minimum number of GPS positions for an evaluation, because a similarity transform fits any three
positions well. [ours]"""
NUM_GPS_ITERATIONS = 20
"""Number of iterations of the trimmed alignment of camera centers to GPS. [ours]"""


def main() -> None:
    """Parse the command line, reconstruct all sets of photos, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("sets", nargs="*", default=list(SETS), metavar="SET")
    parser.add_argument("--photos", type=Path, default=Path("../shared/photos"))
    add_method_arguments(parser)
    parser.add_argument("--output", type=Path, help="also write the table to this file")
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    rows = []
    for name in arguments.sets:
        photos = arguments.photos / name
        stored = arguments.folder and arguments.folder / name
        rows += [
            reconstruct_or_read(photos, method, arguments, stored)
            for method in list_methods(arguments)
            if KNOWN_CAMERAS not in method or (photos / "gt").is_dir()
        ]
    text = format_table(rows)
    print(text)
    if arguments.output:
        arguments.output.write_text(text + "\n", encoding="utf-8")
    if arguments.json:
        print(json.dumps({"rows": rows}))


def add_method_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command-line options that select reconstruction methods and settings."""
    parser.add_argument("--config", default="default", help="our configuration")
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--known-cameras", action="store_true", help="add rows with true cameras")
    parser.add_argument("--without-colmap", action="store_true")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", dest="overrides")
    parser.add_argument("--folder", type=Path, help="folder of table rows and resampled images")


def open_folder(arguments: argparse.Namespace) -> AbstractContextManager[str | Path]:
    """Return the folder ``--folder`` for table rows and images, or a temporary folder."""
    if arguments.folder:
        return nullcontext(arguments.folder)
    return tempfile.TemporaryDirectory(prefix="mpsfm-photos-")


def list_methods(arguments: argparse.Namespace) -> list[str]:
    """List the reconstruction methods that the command line selects, in the order of the table."""
    seeds = [f"seed {seed}" for seed in range(arguments.seeds)]
    known = [seed + KNOWN_CAMERAS for seed in seeds] if arguments.known_cameras else []
    return [*seeds, *known, *([] if arguments.without_colmap else ["COLMAP"])]


def reconstruct_or_read(
    photos: Path,
    method: str,
    arguments: argparse.Namespace,
    stored: Path | None,
    camera_model: CameraModel = CameraModel.SIMPLE_RADIAL,
) -> dict[str, Any]:
    """Read the row of a reconstruction from a folder, or reconstruct the photos and store the row.

    Args:
        photos: Folder of the photo set.
        method: Reconstruction method, see :func:`reconstruct_and_measure`.
        arguments: Arguments with the configuration and the settings of our program.
        stored: Folder of the rows of the photo set, None to store no row.
        camera_model: Camera model that both programs estimate.
    """
    label = method if method.startswith("COLMAP") else f"{arguments.config} {method}"
    file = stored and stored / f"{label}.json"
    if file and file.is_file():
        row: dict[str, Any] = json.loads(file.read_text(encoding="utf-8"))
        return row
    settings = (arguments.config, arguments.overrides)
    row = reconstruct_and_measure(photos, method, *settings, camera_model)
    if file:
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(json.dumps(row), encoding="utf-8")
    return row


def reconstruct_and_measure(
    folder: Path,
    method: str,
    config: str,
    overrides: Sequence[str],
    camera_model: CameraModel = CameraModel.SIMPLE_RADIAL,
) -> dict[str, Any]:
    """Reconstruct a photo set, then print and return its row of the result table.

    Args:
        folder: Folder of the photo set.
        method: Reconstruction method, either ``COLMAP``, ``COLMAP, one camera`` for all images, or
            ``seed`` and the random seed of our mapper, with the suffix ``, known cameras`` if the
            cameras are those of ``gt/``.
        config: Our configuration.
        overrides: Settings ``KEY=VALUE`` that override our configuration.
        camera_model: Camera model that both programs estimate.
    """
    start, verdict, doubted = time.perf_counter(), "", frozenset[str]()
    if method.startswith("COLMAP"):
        is_shared = method.endswith("one camera")
        models = reconstruct_with_colmap(folder / "images", camera_model, is_shared=is_shared)
    else:
        seed, _, known = method.removeprefix("seed ").partition(",")
        settings = [f"runtime.seed={seed}", f"inputs.camera_model={camera_model.value}"]
        models, verdict, doubted = reconstruct_with_mpsfm(
            folder / "images", config, [*settings, *overrides], folder / "gt" if known else None
        )
        method = f"`{config}` {method}"
    measured = measure(models, folder, doubted)
    row = {"set": folder.name, "method": method, **measured, "verdict": verdict}
    row["seconds"] = time.perf_counter() - start
    print(json.dumps(row), file=sys.stderr, flush=True)
    return row


def reconstruct_with_mpsfm(
    images: Path, config: str, overrides: Sequence[str], cameras: Path | None = None
) -> tuple[list[pycolmap.Reconstruction], str, frozenset[str]]:
    """Return the models of ``mpsfm reconstruct IMAGES``, largest first, with the verdict.

    Args:
        images: Folder of the photos.
        config: Our configuration.
        overrides: Settings ``KEY=VALUE`` that override our configuration.
        cameras: Folder of a COLMAP model with the known cameras, or None.

    Returns:
        The models, none if the reconstruction fails; the verdict with the names of the reasons for
        doubt; and the names of the images that the doubts concern.
    """
    offline = ["runtime.offline=true", "dense.enabled=false"]
    try:
        result = reconstruct(
            images, config=config, intrinsics=cameras, overrides=[*offline, *overrides]
        )
    except MpsfmError as error:
        print(f"{images}: {error}", file=sys.stderr)
        return [], "failed", frozenset()
    verdict = judge(result.summary)
    doubts = ", ".join(doubt.reason.code.value for doubt in verdict.doubts)
    text = f"{verdict.level}: {doubts}" if doubts else verdict.level
    doubted = frozenset(name for doubt in verdict.doubts for name in doubt.images)
    return [result.model, *result.further_models], text, doubted


def reconstruct_with_colmap(
    images: Path, camera_model: CameraModel, *, is_shared: bool
) -> list[pycolmap.Reconstruction]:
    """Return the models of COLMAP's incremental mapper with SIFT and all pairs, largest first.

    Args:
        images: Folder of the photos.
        camera_model: Camera model that COLMAP estimates.
        is_shared: All images share a camera, instead of COLMAP's default.
    """
    mode = pycolmap.CameraMode.SINGLE if is_shared else pycolmap.CameraMode.AUTO
    with tempfile.TemporaryDirectory(prefix="mpsfm-colmap-") as folder:
        database = Path(folder) / "database.db"
        pycolmap.set_random_seed(0)
        pycolmap.extract_features(
            database,
            images,
            camera_mode=mode,
            reader_options=pycolmap.ImageReaderOptions(camera_model=camera_model.value),
            extraction_options=pycolmap.FeatureExtractionOptions(use_gpu=False),
        )
        pycolmap.match_exhaustive(
            database, matching_options=pycolmap.FeatureMatchingOptions(use_gpu=False)
        )
        options = pycolmap.IncrementalPipelineOptions()
        options.random_seed = 0
        models = pycolmap.incremental_mapping(database, images, folder, options)
        return sorted(models.values(), key=lambda model: -model.num_reg_images())


def measure(
    models: Sequence[pycolmap.Reconstruction], folder: Path, doubted: Set[str]
) -> dict[str, Any]:
    """Measure registered images, pose AUC, rotation, focal and distortion errors, GPS residual.

    Args:
        models: Models of one photo set, largest first; only the largest model is evaluated.
        folder: Folder of the photo set.
        doubted: Names of the images that the doubts of the verdict concern.
    """
    names = sorted(path.name for path in (folder / "images").iterdir())
    row: dict[str, Any] = {
        "images": len(names),
        "registered": [model.num_reg_images() for model in models],
    }
    if not models:
        return row
    poses = reconstruction_poses(models[0])
    cameras = {image.name: image.camera for image in models[0].images.values() if image.has_pose}
    row["distortion"] = float(np.median([get_distortion(camera) for camera in cameras.values()]))
    row["gps_median_m"] = measure_gps_residual(poses, folder / "images")
    if not (folder / "gt").is_dir():
        return row
    reference = pycolmap.Reconstruction(folder / "gt")
    true_poses = reconstruction_poses(reference)
    true_cameras = {image.name: image.camera for image in reference.images.values()}
    area = pose_auc(pose_errors_deg(poses, true_poses, CONVENTION), CONVENTION)
    rotation_errors = measure_rotation_errors_deg(poses, true_poses)
    errors_by_name = {
        name: abs(cameras[name].mean_focal_length() / true.mean_focal_length() - 1)
        for name, true in true_cameras.items()
        if name in cameras
    }
    wrong = {name for name, error in errors_by_name.items() if error > MAX_FOCAL_ERROR}
    focal_errors = list(errors_by_name.values())
    true_distortion = np.median([get_distortion(camera) for camera in true_cameras.values()])
    return row | {
        "auc_percent": [100 * value for value in area.values()],
        "num_correct": int((rotation_errors < MAX_ROTATION_DEG).sum()),
        "max_rotation_deg": float(rotation_errors.max(initial=0.0)),
        "focal_median_error": float(np.median(focal_errors)),
        "focal_max_error": max(focal_errors),
        "num_wrong_focals": len(wrong),
        "num_silent_focals": len(wrong - doubted),
        "true_distortion": float(true_distortion),
    }


def pool_rows(name: str, rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return one table row for several photo sets with true poses and the same method.

    Counts of images and seconds are sums, pose AUC is the mean, focal length errors and distortion
    are medians, and maximum errors are maxima. The verdict is the number of sets called "good".

    Args:
        name: Name of the photo sets together.
        rows: Rows of the photo sets; a photo set without a model has a pose AUC of zero.
    """
    measured = [row for row in rows if "auc_percent" in row]
    areas = [row["auc_percent"] for row in measured]
    areas += [[0.0, 0.0, 0.0]] * (len(rows) - len(measured))
    num_good = sum(row["verdict"] == "good" for row in rows)
    pooled: dict[str, Any] = {
        "set": name,
        "method": rows[0]["method"],
        "images": sum(row["images"] for row in rows),
        "registered": [sum(row["registered"][0] for row in rows if row["registered"])],
        "auc_percent": np.mean(areas, axis=0).tolist(),
        "num_correct": sum(row["num_correct"] for row in measured),
        "verdict": f"{num_good} of {len(rows)} good" if rows[0]["verdict"] else "",
        "seconds": sum(row["seconds"] for row in rows),
    }
    for key in ("focal_median_error", "distortion", "true_distortion"):
        pooled[key] = float(np.median([row[key] for row in measured] or [np.nan]))
    for key in ("focal_max_error", "max_rotation_deg"):
        pooled[key] = max((row[key] for row in measured), default=np.nan)
    return pooled


def measure_rotation_errors_deg(
    poses: Mapping[str, Pose], true_poses: Mapping[str, Pose]
) -> Float64:
    """Measure rotation errors (n,) after alignment to the image with the smallest median error."""
    world_rotations = np.stack(
        [poses[name][0].T @ true_poses[name][0] for name in true_poses if name in poses]
    )
    differences = world_rotations[:, None].transpose(0, 1, 3, 2) @ world_rotations[None]
    errors = rotation_angle_deg(differences)
    aligned: Float64 = errors[np.median(errors, axis=1).argmin()]
    return aligned


def measure_gps_residual(poses: Mapping[str, Pose], images: Path) -> float | None:
    """Measure the median horizontal distance of camera centers to GPS, in meters.

    The similarity transform is a least-squares fit to the half of the images with the smaller
    residuals. Median distance, or None if fewer than ``MIN_GPS_POSITIONS`` images have a GPS
    position.
    """
    positions = {name: read_gps((images / name).read_bytes()) for name in poses}
    known = {name: position for name, position in positions.items() if position is not None}
    if len(known) < MIN_GPS_POSITIONS:
        return None
    measured = np.nan_to_num(convert_to_enu(list(known.values()), next(iter(known.values()))))
    centers = np.stack([camera_center(*poses[name]) for name in known])
    is_used = np.ones(len(known), dtype=np.bool_)
    residuals = np.zeros(len(known))
    for _ in range(NUM_GPS_ITERATIONS):
        aligned = umeyama(centers[is_used], measured[is_used]).apply(centers)
        residuals = np.linalg.norm((aligned - measured)[:, :2], axis=1)
        is_used = residuals <= np.median(residuals)
    return float(np.median(residuals))


def get_distortion(camera: pycolmap.Camera) -> float:
    """Return the first radial distortion coefficient of a camera, 0 for a pinhole camera."""
    extra = list(camera.extra_params_idxs())
    return float(camera.params[extra[0]]) if extra else 0.0


def format_table(rows: Sequence[Mapping[str, Any]]) -> str:
    """Format a Markdown table with one row per reconstruction."""
    lines = [
        "| set | method | registered | AUC@1/5/20 | within 2 deg | max. rotation error, deg "
        "| focal error, median / max. | k1 (reference) | GPS median, m | s | verdict |",
        "|---" * 11 + "|",
    ]
    for row in rows:
        registered = " + ".join(map(str, row["registered"])) or "0"
        cells = [row["set"], row["method"], f"{registered} of {row['images']}"]
        if "auc_percent" in row:
            cells += [" / ".join(f"{value:.1f}" for value in row["auc_percent"])]
            cells += [row["num_correct"], f"{row['max_rotation_deg']:.2f}"]
            focal = f"{row['focal_median_error']:.1%} / {row['focal_max_error']:.1%}"
            if row.get("num_wrong_focals"):
                focal += f" ({row['num_wrong_focals']} wrong, {row['num_silent_focals']} silent)"
            cells += [focal]
        else:
            cells += ["-"] * 4
        k1 = f"{row['distortion']:.3f}" if "distortion" in row else "-"
        cells += [f"{k1} ({row['true_distortion']:.3f})" if "true_distortion" in row else k1]
        gps = row.get("gps_median_m")
        cells += [
            "-" if gps is None else f"{gps:.1f}",
            f"{row['seconds']:.0f}",
            row["verdict"] or "-",
        ]
        lines.append("| " + " | ".join(map(str, cells)) + " |")
    return "\n".join(lines)


if __name__ == "__main__":
    main()
