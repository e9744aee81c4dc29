"""Accuracy of depth and normal networks with their shipped weights and calibrations.

    python -m benchmarks.priors [--scenes NAME ...] [--set KEY=VALUE ...] [--json FILE]

Scenes are hololens_room (sensor depth), rendered_kitchen (exact depth and normals) and fountain
(points triangulated with true poses, up to scale). Depth metrics are AbsRel and the share with
delta < 1.25, after scaling each depth map by the ratio of the medians, and the median of these
ratios. Uncertainty metrics of log depth are the share of errors within one std, and AUSE. AUSE is
the area between the sparsification curve and the ideal curve, compared with the AUSE of a constant
std. The metric of normals is the median angular error. Every image has equal weight. Times are CPU
and wall time per photo in one thread. Writes benchmarks/results/priors.md; scenes and FastDepth are
in $MPSFM_SHARED or ../shared.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap

from benchmarks._scenes import RESULTS, shared_folder
from benchmarks._sift import extract, match
from mpsfm_core.calibration.calibrate import CalibrationImages, compare_prior
from mpsfm_core.calibration.cross_validation import evaluate_calibrations
from mpsfm_core.calibration.metrics import sensitivity_curve
from mpsfm_core.calibration.model_selection import DepthData, std_of
from mpsfm_core.calibration.samples import Residuals
from mpsfm_core.config import load_config
from mpsfm_core.data import Float64
from mpsfm_core.evaluation.scene_folder import read_scene
from mpsfm_core.inputs.images import load_images
from mpsfm_core.providers import ProviderContext
from mpsfm_core.providers.registry import Registry
from mpsfm_core.providers.weights import WeightStore
from mpsfm_core.support.yaml_text import write_yaml

SCENES = ("hololens_room", "rendered_kitchen", "fountain")
_MILLIMETRE = {"scale": 0.001}
_TIMED = 8
"""Number of photos over which inference time is measured, after one warm-up photo."""


@dataclass(frozen=True)
class DepthRow:
    """Metrics of a depth network on a scene.

    ``scale`` is the median over images of true over predicted depth, None if true depth is only
    known up to scale. ``ause_constant`` is the AUSE of a constant relative std.
    """

    prior: str
    scene: str
    images: int
    absrel: float
    delta: float
    scale: float | None
    coverage: float
    ause: float
    ause_constant: float


@dataclass(frozen=True)
class NormalsRow:
    """Metrics of predicted normals on a scene: angular errors in degrees, and shares of pixels."""

    prior: str
    scene: str
    images: int
    median_deg: float
    within_30: float
    coverage: float


def main() -> None:
    """Evaluate depth and normal networks, and write the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", nargs="+", default=SCENES, choices=SCENES)
    parser.add_argument("--set", nargs="*", default=[], help="options of compact, KEY=VALUE")
    parser.add_argument("--work", type=Path, default=Path("build/priors"))
    parser.add_argument("--json", type=Path, help="also write the rows here")
    arguments = parser.parse_args()
    shared, registry = shared_folder(), Registry.discover()
    arguments.work.mkdir(parents=True, exist_ok=True)
    options = dict(item.split("=", 1) for item in arguments.set)
    priors = {
        "compact": {"use": "compact", "options": options},
        "FastDepth": {
            "use": "onnx",
            "options": {"model": str(shared / "models" / "fastdepth_224.onnx")},
        },
    }
    depth: list[DepthRow] = []
    normals: list[NormalsRow] = []
    for name, block in priors.items():
        has_normals = name == "compact"
        config = _config(
            block, block if has_normals else {"use": "from-depth"}, arguments.work / name
        )
        for scene in arguments.scenes:
            folder = shared / "data" / scene
            depth.append(_depth_row(name, folder, config, registry, arguments.work))
            print(depth[-1])
            if (folder / "gt_normals").is_dir():
                normals.append(_normals_row(name, folder, config, registry))
                print(normals[-1])
    times = {n: _time(b, shared / "data" / SCENES[0], registry) for n, b in priors.items()}
    if arguments.json:
        rows = {"depth": [asdict(r) for r in depth], "normals": [asdict(r) for r in normals]}
        arguments.json.write_text(json.dumps({**rows, "seconds": times}, indent=2))
    text = "\n".join(_tables(depth, normals, times)) + "\n"
    if tuple(arguments.scenes) == SCENES:
        (RESULTS / "priors.md").write_text(text, encoding="utf-8")
    print(text)


def _depth_row(name: str, folder: Path, config: str, registry: Registry, work: Path) -> DepthRow:
    scene = read_scene(folder)
    photos = CalibrationImages(scene.images, scene.intrinsics)
    loaded = load_config(config, registry=registry)
    if scene.depth is not None:
        truth: dict[str, Any] = {"directory": str(scene.depth), "suffix": ".png", **_MILLIMETRE}
        data = compare_prior(photos, loaded, truth, registry=registry)
    else:
        model = _triangulated(folder, work / folder.name)
        data = compare_prior(photos, loaded, model=model, registry=registry)
    declared = registry.calibration("depth", loaded.depth)
    residuals = data.residuals(declared)
    assert isinstance(data, DepthData)
    ratios = [s.prior / s.truth * np.median(s.truth) / np.median(s.prior) for s in data.samples]
    errors = np.abs(residuals.error)
    return DepthRow(
        name,
        folder.name,
        residuals.images,
        float(np.mean([np.abs(r - 1).mean() for r in ratios])),
        float(np.mean([(np.maximum(r, 1 / r) < 1.25).mean() for r in ratios])),
        float(np.exp(np.median(residuals.scales))) if scene.depth is not None else None,
        evaluate_calibrations([data], [declared])["coverage"][0],
        _ause(errors, std_of(declared, residuals)),
        _ause(errors, np.ones_like(errors)),
    )


def _ause(errors: Float64, std: Float64) -> float:
    curves = sensitivity_curve(errors, std)
    return float(np.mean(curves["predicted"]) - np.mean(curves["ideal"]))


def _normals_row(name: str, folder: Path, config: str, registry: Registry) -> NormalsRow:
    scene = read_scene(folder)
    loaded = load_config(config, registry=registry)
    truth = {"directory": str(folder / "gt_normals"), "suffix": ".png"}
    photos = CalibrationImages(scene.images, scene.intrinsics)
    data = compare_prior(photos, loaded, truth, "normals", registry=registry)
    declared = registry.calibration("normals", loaded.normals)
    residuals: Residuals = data.residuals(declared)
    angle = np.degrees(residuals.magnitude)
    return NormalsRow(
        name if name == "compact" else f"from-depth of {name}",
        folder.name,
        residuals.images,
        float(np.median(angle)),
        float(np.mean(angle < 30)),
        evaluate_calibrations([data], [declared])["coverage"][0],
    )


def _triangulated(folder: Path, work: Path) -> Path:
    """Triangulate SIFT matches with COLMAP, using the true cameras and poses."""
    model = work / "triangulated"
    if not (model / "points3D.bin").exists():
        model.mkdir(parents=True, exist_ok=True)
        database = work / "database.db"
        database.unlink(missing_ok=True)
        pycolmap.set_random_seed(0)
        truth = pycolmap.Reconstruction(folder / "gt")
        camera = next(iter(truth.cameras.values()))
        extract(database, folder / "images", camera.model.name, camera.params)
        match(database)
        known = _as_in_database(truth, database)
        pycolmap.triangulate_points(known, database, folder / "images", model)
    return model


def _as_in_database(truth: pycolmap.Reconstruction, path: Path) -> pycolmap.Reconstruction:
    """Return the true poses as a COLMAP model with the image ids of the database."""
    known = pycolmap.Reconstruction()
    poses = {image.name: image.cam_from_world() for image in truth.images.values()}
    with pycolmap.Database.open(path) as database:
        for camera in database.read_all_cameras():
            known.add_camera_with_trivial_rig(camera)
        for image in database.read_all_images():
            renumbered = pycolmap.Image(
                name=image.name, camera_id=image.camera_id, image_id=image.image_id
            )
            known.add_image_with_trivial_frame(renumbered, poses[image.name])
    return known


def _time(block: Mapping[str, Any], folder: Path, registry: Registry) -> tuple[float, float]:
    """Measure median CPU and wall seconds of inference per photo, in one thread."""
    scene = read_scene(folder)
    images = load_images(scene.images, scene.intrinsics)
    context = ProviderContext(resolve_weights=WeightStore().resolve)
    provider = registry.create("depth", str(block["use"]), dict(block["options"]), context)
    spent = []
    for index in range(_TIMED + 1):
        view = images.view(index)
        wall, cpu = time.perf_counter(), time.process_time()
        provider.predict(view)
        spent.append((time.process_time() - cpu, time.perf_counter() - wall))
    cpu_seconds, wall_seconds = np.median(spent[1:], axis=0)
    return float(cpu_seconds), float(wall_seconds)


def _config(depth: Mapping[str, Any], normals: Mapping[str, Any], stem: Path) -> str:
    path = stem.with_suffix(".yaml")
    runtime = {"workers": 1, "cache_dir": str(stem.parent.resolve() / "cache")}
    values = {"extends": "benchmark", "depth": depth, "normals": normals, "runtime": runtime}
    path.write_text(write_yaml(values), encoding="utf-8")
    return str(path)


def _tables(
    depth: list[DepthRow], normals: list[NormalsRow], times: Mapping[str, tuple[float, float]]
) -> Iterator[str]:
    yield "# Accuracy of depth and normal priors"
    yield ""
    yield (
        "`python -m benchmarks.priors`. AbsRel and delta < 1.25 are computed after scaling each "
        "depth map by the ratio of the medians (truth / prediction). AUSE is the area between the "
        "sparsification curve and the ideal curve; a lower AUSE is better."
    )
    yield ""
    columns = (
        "AbsRel | delta < 1.25 | truth / prediction | within 1 std | AUSE | AUSE of a constant std"
    )
    yield f"| scene | depth | {columns} |"
    yield "| --- | --- | ---: | ---: | ---: | ---: | ---: | ---: |"
    for row in sorted(depth, key=lambda r: SCENES.index(r.scene)):
        scale = "" if row.scale is None else f"{row.scale:.2f}"
        yield (
            f"| {row.scene} ({row.images}) | {row.prior} | {row.absrel:.3f} | {row.delta:.2f} | "
            f"{scale} | {row.coverage:.1%} | {row.ause:.3f} | {row.ause_constant:.3f} |"
        )
    yield ""
    yield "| scene | normals | median angle | within 30 deg | within 1 std |"
    yield "| --- | --- | ---: | ---: | ---: |"
    for row in normals:
        yield (
            f"| {row.scene} ({row.images}) | {row.prior} | {row.median_deg:.1f} deg | "
            f"{row.within_30:.1%} | {row.coverage:.1%} |"
        )
    yield ""
    shown = ", ".join(f"{name} {1e3 * c:.0f} / {1e3 * w:.0f} ms" for name, (c, w) in times.items())
    yield f"CPU / wall time per photo of 640 x 480: {shown}."


if __name__ == "__main__":
    main()
