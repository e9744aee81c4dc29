"""Time and accuracy of depth integration and of its marginal variances.

    python -m benchmarks.depth_integration [SECTION ...] [--repeats 5] [--ablation] [--json]

The reference is the published iteratively reweighted least squares, in scipy
(`tests/optimize/integration_reference.py`): conjugate gradients with a Jacobi preconditioner, to
1e-3 before each reweighting. The reference iterates until its energy is at most 1e-4 above that of
our integration. Runs are interleaved. Ratios are those of median wall times, or of CPU times where
stated. The scene hololens_room is used if $MPSFM_SHARED or ../shared has it. ``--json`` prints one
JSON object as the last line.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy.ndimage import gaussian_filter

from mpsfm_core import geometry
from mpsfm_core.data import Bool, DepthPrior, Float64, NormalPrior, PinholeCamera
from mpsfm_core.optimize.depth_integration import (
    Anchors,
    DepthIntegrator,
)
from mpsfm_core.optimize.integration_energy import majorize
from mpsfm_core.optimize.multigrid import Multigrid
from mpsfm_core.optimize.options import IntegrationOptions
from mpsfm_core.testing.synthetic.scenes import arc_poses, room_scene
from tests.optimize.integration_reference import ReferenceIntegration

SIZES = ((387, 258), (768, 512))
SCALING_SIZES = ((193, 129), (387, 258), (768, 512), (1536, 1024))
POINTS = 200
SCENES = 6


@dataclass(frozen=True)
class Problem:
    """Noisy depth and normal priors and points of one image, and true log depth if known."""

    depth: DepthPrior
    normals: NormalPrior
    camera: PinholeCamera
    anchors: Anchors
    truth: Float64
    known: Bool

    def integrator(self, options: IntegrationOptions | None = None) -> DepthIntegrator:
        return DepthIntegrator(self.depth, self.normals, self.camera, options)

    def errors(self, log_depth: Float64) -> tuple[float, float]:
        """Compute the root mean square and the median of log depth errors."""
        error = np.abs(log_depth - self.truth)[self.known]
        return float(np.sqrt(np.mean(error**2))), float(np.median(error))

    def prior_errors(self) -> tuple[float, float]:
        return self.errors(np.log(self.depth.depth.astype(np.float64)))


def smooth_noise(
    rng: np.random.Generator, shape: tuple[int, int], parts: dict[float, float]
) -> Float64:
    """Create unit-variance noise; ``parts`` gives the weight of each correlation length in px."""
    total = np.zeros(shape)
    for length, share in parts.items():
        step = max(1.0, length / 4)
        coarse = rng.normal(size=(int(shape[0] / step) + 2, int(shape[1] / step) + 2))
        smooth = gaussian_filter(coarse, length / step, mode="reflect")
        field = cv2.resize(smooth, shape[::-1], interpolation=cv2.INTER_CUBIC)
        total += share * field / field.std()
    return total / total.std()


def analytic_problem(size: tuple[int, int], seed: int) -> Problem:
    """Create priors of a furnished synthetic room, with errors like those of networks.

    Depth has edges blurred by 2 px, and errors of 6 % with correlation lengths of 50, 15 and 5 px
    at a map width of 387 px. Normals have edges blurred by 1 px, and errors of 6 deg with
    correlation lengths of 8 and 1.5 px. Triangulated points have depth errors of 1 %; 5 % of the
    points are wrong by up to 50 %.
    """
    width, height = size
    rng, pixel = np.random.default_rng(seed), width / 387
    camera = PinholeCamera(width, height, width / 1.1, width / 1.1, width / 2, height / 2)
    rendering = room_scene(seed).render(camera, arc_poses(7, 15)[seed % 7])
    truth = np.log(rendering.depth.astype(np.float64))
    noise = smooth_noise(rng, truth.shape, {50 * pixel: 0.75, 15 * pixel: 0.55, 5 * pixel: 0.35})
    depth = np.exp(gaussian_filter(truth, 2 * pixel) + 0.06 * noise)
    normals = gaussian_filter(rendering.normals.astype(np.float64), (pixel, pixel, 0))
    for axis in range(3):
        lengths = {8 * pixel: 0.8, 1.5 * pixel: 0.6}
        normals[..., axis] += np.deg2rad(6) * smooth_noise(rng, truth.shape, lengths)
    everywhere = np.ones(truth.shape, np.bool_)
    return Problem(
        DepthPrior.from_arrays(depth, (0.06 * depth) ** 2),
        NormalPrior.from_arrays(normals, np.full(truth.shape, np.deg2rad(6) ** 2)),
        camera,
        sample_anchors(rng, truth, everywhere, wrong=0.05),
        truth,
        everywhere,
    )


def sample_anchors(
    rng: np.random.Generator, truth: Float64, known: Bool, *, wrong: float = 0.0
) -> Anchors:
    """Sample points at random pixels, with depth errors of 1 % and a share of outliers."""
    pixels = rng.choice(np.flatnonzero(known), POINTS, replace=False)
    rows, columns = np.divmod(pixels, truth.shape[1])
    error = rng.normal(0, 0.01, POINTS)
    error += (rng.random(POINTS) < wrong) * rng.uniform(-0.4, 0.4, POINTS)
    depth = np.exp(truth[rows, columns] + error)
    return Anchors(np.column_stack([columns, rows]) + 0.5, depth, (0.01 * depth) ** 2)


def room_problems(shared: Path, every: int = 10) -> Iterator[Problem]:
    """Create depth integration problems from frames of hololens_room.

    Priors are the depth of FastDepth, and normals of the smoothed depth. Points are random pixels
    with sensor depth. The relative std of 25 % is that of FastDepth on these frames.
    """
    import onnxruntime

    camera = PinholeCamera(540, 360, 495.5678, 495.482, 270.0029, 169.6941).resized(387, 258)
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    model = shared / "models" / "fastdepth_224.onnx"
    network = onnxruntime.InferenceSession(str(model), options)
    scene = shared / "data" / "hololens_room"
    for number, path in enumerate(sorted((scene / "gt_depth").glob("*.png"))[::every]):
        image = cv2.imread(str(next((scene / "images").glob(f"{path.stem}.*"))))
        small = cv2.resize(image, (224, 224), interpolation=cv2.INTER_AREA)[..., ::-1]
        batch = (small.astype(np.float32) / 255).transpose(2, 0, 1)[None]
        depth = network.run(None, {"image": batch})[0].squeeze().astype(np.float64)
        depth = np.maximum(cv2.resize(depth, camera.size, interpolation=cv2.INTER_LINEAR), 0.1)
        sensor = cv2.imread(str(path), cv2.IMREAD_UNCHANGED).astype(np.float64) / 1000
        sensor = cv2.resize(sensor, camera.size, interpolation=cv2.INTER_NEAREST)
        known = sensor > 0
        truth = np.log(np.where(known, sensor, 1.0))
        anchors = sample_anchors(np.random.default_rng(number), truth, known)
        columns, rows = np.floor(anchors.xy).astype(int).T
        depth *= np.median(anchors.depth / depth[rows, columns])
        yield Problem(
            DepthPrior.from_arrays(depth, (0.25 * depth) ** 2),
            NormalPrior.from_arrays(
                normals_of(np.exp(gaussian_filter(np.log(depth), 3)), camera),
                np.full(depth.shape, np.deg2rad(10) ** 2),
            ),
            camera,
            anchors,
            truth,
            known,
        )


def normals_of(depth: Float64, camera: PinholeCamera) -> Float64:
    """Compute normals (h, w, 3) of a depth map by finite differences of its 3D points."""
    points = geometry.unproject(camera, geometry.pixel_centers(*camera.size), depth)
    normals = np.cross(np.gradient(points, axis=0), np.gradient(points, axis=1))
    return normals / np.linalg.norm(normals, axis=-1, keepdims=True)


def timed(
    function: Callable[[], Any], clock: Callable[[], float] = time.perf_counter
) -> tuple[float, Any]:
    """Call a function; return the time in seconds and the function's result."""
    start = clock()
    result = function()
    return clock() - start, result


def median_time(
    function: Callable[[], Any], repeats: int, clock: Callable[[], float] = time.perf_counter
) -> float:
    return statistics.median(timed(function, clock)[0] for _ in range(repeats))


def bench_speed(size: tuple[int, int], repeats: int) -> dict[str, float]:
    """Measure depth integration with our defaults, and the reference up to the same energy."""
    problem = analytic_problem(size, seed=0)
    integrator = problem.integrator()
    reference = ReferenceIntegration(
        problem.depth, problem.normals, problem.camera, problem.anchors
    )
    run = partial(integrator.refine, problem.anchors)
    ours = run()

    def run_reference() -> list[float]:
        target = ours.energy * (1 + 1e-4)
        return reference.solve(tolerance=0.0, max_iterations=40, target=target)[1]

    wall: dict[str, list[float]] = {"ours": [], "reference": [], "cpu": []}
    for _ in range(repeats):
        seconds, energies = timed(run_reference)
        wall["reference"].append(seconds)
        wall["ours"].append(timed(run)[0])
        wall["cpu"].append(timed(run, time.thread_time)[0])
    median = {name: statistics.median(values) for name, values in wall.items()}
    return {
        "ours_ms": 1e3 * median["ours"],
        "ours_cpu_ms": 1e3 * median["cpu"],
        "ours_reweightings": ours.iterations,
        "reference_ms": 1e3 * median["reference"],
        "reference_reweightings": len(energies) - 1,
        "reference_energy_over_ours": energies[-1] / ours.energy,
        "speedup": median["reference"] / median["ours"],
        "warm_ms": 1e3 * bench_warm(problem, repeats),
    }


def bench_warm(problem: Problem, repeats: int) -> float:
    """Measure a second depth integration after all points moved by their std."""
    integrator = problem.integrator(IntegrationOptions(max_point_growth=0.0))
    before = integrator.refine(problem.anchors)
    moved = problem.anchors._replace(depth=1.01 * problem.anchors.depth)
    return median_time(partial(integrator.refine, moved, start=before), repeats)


def bench_scaling(repeats: int) -> dict[str, Any]:
    """Fit the exponent of CPU time as a power of the number of pixels, in one thread.

    Depth errors at each map size show that the solutions are equally accurate.
    """
    pixels, seconds, errors = [], [], []
    for size in SCALING_SIZES:
        pixels.append(size[0] * size[1])
        problems = [analytic_problem(size, seed) for seed in range(SCENES)]
        runs = [partial(problem.integrator().refine, problem.anchors) for problem in problems]
        refined = [run() for run in runs]
        errors.append([p.errors(r.log_depth)[1] for p, r in zip(problems, refined, strict=True)])
        times = [median_time(run, repeats, time.thread_time) for run in runs]
        seconds.append(statistics.mean(times))
    return {
        "exponent": float(np.polyfit(np.log(pixels), np.log(seconds), 1)[0]),
        "ms": [1e3 * of_size for of_size in seconds],
        "median_errors": [float(np.mean(of_size)) for of_size in errors],
    }


def bench_accuracy(
    problems: list[Problem], options: IntegrationOptions | None = None
) -> dict[str, float] | None:
    """Compute mean depth errors before and after depth integration, or None without problems."""
    if not problems:
        return None
    rows = []
    for problem in problems:
        refined = problem.integrator(options).refine(problem.anchors)
        rows.append((*problem.prior_errors(), *problem.errors(refined.log_depth)))
    prior_rms, prior_median, rms, median = np.mean(rows, axis=0)
    return {
        "images": len(problems),
        "prior_rms": float(prior_rms),
        "refined_rms": float(rms),
        "rms_ratio": float(rms / prior_rms),
        "prior_median": float(prior_median),
        "refined_median": float(median),
        "median_ratio": float(median / prior_median),
    }


def bench_variance(repeats: int) -> dict[str, float]:
    """Compare marginal variances of selected inversion with the dense inverse, and their times."""
    small = analytic_problem((48, 32), seed=0)
    reference = ReferenceIntegration(small.depth, small.normals, small.camera, small.anchors)
    refined = small.integrator().refine(small.anchors)
    dense = np.linalg.inv(reference.linearise(refined.log_depth.ravel()).matrix.toarray())
    ours = small.integrator().variance(refined, small.anchors)
    report = {
        "largest_relative_error": float(np.abs(ours.ravel() / np.diag(dense) - 1).max()),
    }
    for size in SIZES:
        problem = analytic_problem(size, seed=0)
        integrator = problem.integrator()
        refined = integrator.refine(problem.anchors)
        run = partial(integrator.variance, refined, problem.anchors)
        whole = median_time(run, repeats)
        report[f"whole_map_s_at_{size[0]}"] = whole
        report[f"us_per_pixel_at_{size[0]}"] = 1e6 * whole / refined.log_depth.size
        report[f"pays_off_from_pixels_at_{size[0]}"] = whole / single_solve(integrator, problem)
    error = np.abs(refined.log_depth - problem.truth) / np.sqrt(run())
    report["median_error_in_deviations"] = float(np.median(error))  # 0.67 when calibrated
    return report


def single_solve(integrator: DepthIntegrator, problem: Problem) -> float:
    """Measure the time of multigrid for one column of the inverse, to 1 % of the diagonal."""
    refined = integrator.refine(problem.anchors)
    here = majorize(refined.log_depth, integrator._terms(problem.anchors, 1.0))
    solver = Multigrid(*here.mass.shape)
    solver.update(here.east, here.south, here.mass)
    unit = np.zeros(here.mass.shape)
    unit[unit.shape[0] // 2, unit.shape[1] // 2] = 1
    return median_time(partial(solver.solve, unit, 200, 1e-2), repeats=3)


def ablation(analytic: list[Problem], real: list[Problem]) -> dict[str, Any]:
    """Print log depth errors (rms, median) with each option changed from its default."""
    changes: list[dict[str, float]] = [
        {},
        {"independent_depths": 1e9, "independent_normals": 1e9},  # weights of cvg/mpsfm
        *({"independent_depths": v} for v in (10.0, 30.0, 300.0, 1000.0)),
        *({"independent_normals": v} for v in (100.0, 300.0, 3000.0, 10_000.0)),
        *({"sharpness": v} for v in (0.5, 1.0, 4.0)),
        *({"normal_limit": v} for v in (2.0, 3.0, 12.0, 50.0, 1e3)),
        *({"prior_scale": v} for v in (0.5, 2.0, 1e3)),
        *({"point_scale": v} for v in (1.0, 3.0, 1e3)),
        *({"cg_iterations": v} for v in (1, 3, 5)),
        *({"over_relaxation": v} for v in (1.0, 1.2, 1.6)),
        *({"tolerance": v} for v in (1e-1, 2e-2, 1e-2, 1e-3)),
    ]
    confident = [
        replace(p, depth=replace(p.depth, variance=p.depth.variance / 16)) for p in analytic
    ]
    kinds = {"analytic": analytic, "variance / 16": confident, "hololens_room": real}
    report = {}
    for change in changes:
        options = IntegrationOptions(**change)
        name = ", ".join(f"{key} {value:g}" for key, value in change.items()) or "default"
        row = {}
        for kind, problems in kinds.items():
            if errors := bench_accuracy(problems, options):
                row[kind] = (round(errors["refined_rms"], 4), round(errors["refined_median"], 4))
        report[name] = row
        print(f"{name:48s} {row}", flush=True)
    return report


def analytic_problems(count: int) -> list[Problem]:
    return [analytic_problem(SIZES[0], seed) for seed in range(count)]


def real_problems(shared: Path) -> list[Problem]:
    """Return depth integration problems of hololens_room, or an empty list without this scene."""
    return list(room_problems(shared)) if (shared / "data" / "hololens_room").is_dir() else []


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("sections", nargs="*", metavar="SECTION", help="run these only")
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--ablation", action="store_true", help="only this")
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    shared = Path(os.environ.get("MPSFM_SHARED", Path(__file__).resolve().parents[2] / "shared"))
    analytic = partial(analytic_problems, SCENES)
    real = partial(real_problems, shared)
    sections: dict[str, Callable[[], Any]] = {
        "analytic": lambda: bench_accuracy(analytic()),
        "hololens_room": lambda: bench_accuracy(real()),
        "variance": lambda: bench_variance(arguments.repeats),
        "scaling": lambda: bench_scaling(arguments.repeats),
        **{
            f"{size[0]}x{size[1]}": lambda size=size: bench_speed(size, arguments.repeats)
            for size in SIZES
        },
    }
    if arguments.ablation:
        sections = {"ablation": lambda: ablation(analytic(), real())}
    if unknown := set(arguments.sections) - set(sections):
        parser.error(f"no such section: {', '.join(sorted(unknown))}")
    report = {}
    for name in arguments.sections or sections:
        report[name] = sections[name]()
        print(name, json.dumps(report[name]), flush=True)
    if arguments.json:
        print(json.dumps(report))


if __name__ == "__main__":
    main()
