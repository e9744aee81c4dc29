"""Effect of a calibrated depth std on coverage and poses, compared with wrong std.

    python -m benchmarks.calibration [--buckets minimal leq5 leq10] [--output DIR] [--workers 1]

The scene hololens_room has two depth priors: FastDepth, and sensor depth with smooth errors
(`mpsfm_core.testing.synthetic.degraded_depth`). Each depth prior is calibrated on the images
outside the test sets. The std of each depth prior is declared in four ways: calibrated, 5 times too
small, 5 times too large, and uncalibrated (the defaults for another network). Coverage is the share
of depth errors within the std, on the images of the test sets. Poses are computed with and without
the estimation of depth noise. An interrupted benchmark resumes from the folder --output. Writes
benchmarks/results/calibration.md; scenes are in $MPSFM_SHARED or ../shared.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from benchmarks._scenes import RESULTS, print_progress, shared_folder
from mpsfm_core.calibration.calibrate import CalibrationImages, calibrate, compare_prior
from mpsfm_core.calibration.cross_validation import evaluate_calibrations
from mpsfm_core.config import load_config
from mpsfm_core.evaluation.benchmark import BenchmarkPlan, run_benchmark
from mpsfm_core.evaluation.pose_auc import CONVENTIONS
from mpsfm_core.evaluation.prior_quality import prior_overrides
from mpsfm_core.evaluation.report import BenchmarkRow, build_rows
from mpsfm_core.evaluation.scene_folder import SceneFolder, read_scene
from mpsfm_core.providers.registry import Registry
from mpsfm_core.providers.uncertainty.calibration import DepthCalibration
from mpsfm_core.providers.uncertainty.calibration_file import load_calibration
from mpsfm_core.support.yaml_text import write_yaml

FACTOR = 5.0
MEASURED = {"measured": True, "trusted": False}
"""Values of the mapper option ``measure_depth_noise``, by the label in the table."""


@dataclass(frozen=True)
class Prior:
    """Depth prior with its YAML block ``depth``."""

    name: str
    block: Mapping[str, Any]


def main() -> None:
    """Calibrate each depth prior, map with each declared std, and write the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--buckets", nargs="+", default=["minimal", "leq5", "leq10"])
    parser.add_argument("--output", type=Path, default=Path("build/calibration"))
    parser.add_argument("--workers", type=int, default=1)
    arguments = parser.parse_args()
    shared = shared_folder()
    scene = read_scene(shared / "data" / "hololens_room")
    output: Path = arguments.output
    output.mkdir(parents=True, exist_ok=True)
    in_sets = {name for item in scene.select_sets(arguments.buckets) for name in item.images}
    lists = {True: output / "in_sets.txt", False: output / "others.txt"}
    for inside, path in lists.items():
        path.write_text("\n".join(n for n in sorted(scene.truth) if (n in in_sets) is inside))
    tables = []
    for prior in _priors(scene, shared / "models" / "fastdepth_224.onnx", output):
        calibrated = _calibrated(prior, scene, lists[False], output)
        coverage = _coverage(prior, scene, lists[True], _declarations(calibrated))
        rows = _poses(prior, scene, _declarations(calibrated), output, arguments)
        tables += list(_table(prior, calibrated, coverage, rows))
        text = "\n".join(["# Effect of calibration, hololens_room", "", *tables])
        RESULTS.mkdir(exist_ok=True)
        (RESULTS / "calibration.md").write_text(text.rstrip() + "\n", encoding="utf-8")
    print(text)


def _priors(scene: SceneFolder, fastdepth: Path, output: Path) -> Iterator[Prior]:
    yield Prior("FastDepth", {"use": "onnx", "options": {"model": str(fastdepth)}})
    degraded = (output / "degraded").resolve()
    prior_overrides("degraded", scene, scene.truth, degraded)
    # The std in the depth files is negligible, so only the calibration determines the variance.
    options = {"directory": str(degraded), "scale": 0.001, "relative_std": 1e-6}
    yield Prior("degraded sensor depth", {"use": "files", "options": options})


def _declarations(calibrated: DepthCalibration) -> dict[str, DepthCalibration]:
    """Return the calibrated, two wrong, and the default uncertainty models of a depth prior."""
    return {
        "calibrated": calibrated,
        "std 5 x too small": _scaled(calibrated, 1 / FACTOR),
        "std 5 x too large": _scaled(calibrated, FACTOR),
        "uncalibrated": DepthCalibration(),
    }


def _scaled(calibration: DepthCalibration, factor: float) -> DepthCalibration:
    names = ("std_scale", "relative_std", "std_floor")
    return calibration.model_copy(update={n: getattr(calibration, n) * factor for n in names})


def _calibrated(prior: Prior, scene: SceneFolder, images: Path, output: Path) -> DepthCalibration:
    """Fit the calibration of a depth prior on listed images, or read it from an earlier run."""
    file = output / f"{_slug(prior.name)}.calibration.yaml"
    if not file.is_file():
        config = _config(prior, DepthCalibration(), True, output / "fit.yaml")
        photos = CalibrationImages(scene.images, scene.intrinsics, images)
        result = calibrate(photos, load_config(config), ground_truth=_truth(scene))
        result.file.write(file)
    calibration = load_calibration(file)
    assert isinstance(calibration, DepthCalibration)
    return calibration


def _coverage(
    prior: Prior, scene: SceneFolder, images: Path, declared: Mapping[str, DepthCalibration]
) -> dict[str, dict[str, Any]]:
    """Compute coverage and likelihood of each declared uncertainty on listed images."""
    config = _config(
        prior, DepthCalibration(), True, images.with_name("evaluate_calibrations.yaml")
    )
    photos = CalibrationImages(scene.images, scene.intrinsics, images)
    data = compare_prior(photos, load_config(config), _truth(scene))
    return {
        name: evaluate_calibrations([data], [calibration]) for name, calibration in declared.items()
    }


def _poses(
    prior: Prior,
    scene: SceneFolder,
    declared: Mapping[str, DepthCalibration],
    output: Path,
    arguments: argparse.Namespace,
) -> dict[tuple[str, str], BenchmarkRow]:
    """Compute pose AUC over all test sets, by declared std and by depth noise estimation."""
    configs = {
        (name, weighing): _config(
            prior,
            calibration,
            measure,
            output / f"{_slug(prior.name)}-{_slug(name)}-{weighing}.yaml",
        )
        for name, calibration in declared.items()
        for weighing, measure in MEASURED.items()
    }
    plan = BenchmarkPlan(
        (scene.path,),
        tuple(str(path) for path in configs.values()),
        tuple(arguments.buckets),
        peers=(),
        workers=arguments.workers,
    )
    records = run_benchmark(plan, output, Registry.discover(), print_progress)
    rows = {}
    for key, path in configs.items():
        own_records = [replace(r, bucket="all") for r in records if r.config == Path(path).stem]
        rows[key] = build_rows(own_records)[0]
    return rows


def _config(prior: Prior, calibration: DepthCalibration, measure: bool, path: Path) -> str:
    """Write a YAML configuration of the benchmark, and return its path."""
    depth = {**prior.block, "calibration": calibration.model_dump(mode="json")}
    values = {
        "extends": "benchmark",
        "depth": depth,
        "mapping": {"refinement": {"measure_depth_noise": measure}},
        "runtime": {"workers": 1},
    }
    path.write_text(write_yaml(values), encoding="utf-8")
    return str(path)


def _truth(scene: SceneFolder) -> dict[str, Any]:
    return {"directory": scene.depth, "scale": 0.001}


def _table(
    prior: Prior,
    calibrated: DepthCalibration,
    coverage: Mapping[str, Mapping[str, Any]],
    rows: Mapping[tuple[str, str], BenchmarkRow],
) -> Iterator[str]:
    values = {n: v for n, v in calibrated.model_dump().items() if isinstance(v, float) and v}
    yield f"## {prior.name}"
    yield ""
    yield "Calibrated: " + ", ".join(f"{name} {value:g}" for name, value in values.items())
    yield ""
    sets = next(iter(rows.values())).sets
    convention = CONVENTIONS["paper"]
    yield (
        f"Pose AUC at 1 / 5 / 20 degrees in percent, sets: {sets}; convention "
        f"`{convention.name}`: {convention.description}. Registered images in percent."
    )
    yield ""
    yield (
        "| declared | within 1 std | within 2 std | 1.4826 MAD of z | nll (heavy) | AUC, noise "
        "estimated | registered | AUC, declared std | registered |"
    )
    yield "| --- | ---: | ---: | ---: | ---: | ---: | ---: | ---: | ---: |"
    for name, metrics in coverage.items():
        cells = [f"{metrics['coverage'][0]:.1%}", f"{metrics['coverage'][1]:.1%}"]
        cells += [f"{metrics['z_mad']:.2f}", f"{metrics['nll_heavy']:.2f}"]
        for weighing in MEASURED:
            row = rows[name, weighing]
            cells += [" / ".join(f"{v:.1f}" for v in row.auc.values()), f"{row.registered:.0%}"]
        yield f"| {name} | " + " | ".join(cells) + " |"
    yield ""


def _slug(name: str) -> str:
    return name.lower().replace(" ", "-")


if __name__ == "__main__":
    main()
