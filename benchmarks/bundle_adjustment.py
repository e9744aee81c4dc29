"""Time and accuracy of bundle adjustment with depth, compared with pycolmap without depth.

    python -m benchmarks.bundle_adjustment [--sizes S M L] [--repeats 5] [--json]

Our adjuster and pycolmap start from the same perturbed cameras and points, and stop at a relative
cost change of 1e-6. Times are medians of interleaved runs, and include building the problem.
``--json`` prints one JSON object as the last line. Targets: time at most 0.35 of pycolmap's; cost
within 1e-6 and poses within 1e-5 of Ceres from 20 starts; covariances within 1 % of a dense
inverse.
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pycolmap

from mpsfm_core.optimize.bundle_adjustment import adjust_bundle
from mpsfm_core.optimize.covariance import DAMPING, compute_point_covariances
from mpsfm_core.optimize.options import SOFT_L1_OPTIONS
from tests.optimize.bundle_reference import (
    ceres_adjuster,
    dense_point_information,
    make_problem,
    perturb,
    solve_with_ceres,
    to_pycolmap,
    without_depth,
)

SIZES = {"S": (30, 19_300, 4.35), "M": (60, 48_000, 4.9), "L": (100, 99_900, 5.45)}
"""Number of images, number of points and mean track length of each problem size."""
LOCAL = (5, 3_000, 3.6)
STARTS = 20


def timed(function: Callable[[], Any]) -> tuple[float, Any]:
    """Call a function; return the wall time in seconds and the function's result."""
    start = time.perf_counter()
    result = function()
    return time.perf_counter() - start, result


def side_by_side(sides: dict[str, Callable[[], Any]], repeats: int) -> tuple[dict[str, float], Any]:
    """Call functions alternately; return their median wall times in seconds and last results."""
    seconds: dict[str, list[float]] = {name: [] for name in sides}
    results: dict[str, Any] = {}
    for _ in range(repeats):
        for name, function in sides.items():
            elapsed, results[name] = timed(function)
            seconds[name].append(elapsed)
    return {name: statistics.median(values) for name, values in seconds.items()}, results


def bench_speed(size: tuple[int, int, float], repeats: int) -> dict[str, float]:
    """Measure bundle adjustment time of one problem size, and its ratio to pycolmap's time."""
    problem = perturb(make_problem(*size), seed=1)
    plain = without_depth(problem)
    reconstructions = [to_pycolmap(problem) for _ in range(repeats)]
    fresh = iter(reconstructions)  # keeps the models alive, unlike the adjuster
    threads = SOFT_L1_OPTIONS.model_copy(update={"threads": 1})
    median, results = side_by_side(
        {
            "pycolmap_plain": lambda: ceres_adjuster(next(fresh)).solve(),
            "depth": lambda: adjust_bundle(problem, SOFT_L1_OPTIONS),
            "plain": lambda: adjust_bundle(plain, SOFT_L1_OPTIONS),
            "depth_one_thread": lambda: adjust_bundle(problem, threads),
        },
        repeats,
    )
    ceres = results["pycolmap_plain"].ceres_summary
    return {
        "images": size[0],
        "points": size[1],
        "observations": len(problem.obs_image),
        **{f"{name}_seconds": value for name, value in median.items()},
        "ratio_depth": median["depth"] / median["pycolmap_plain"],
        "ratio_plain": median["plain"] / median["pycolmap_plain"],
        "depth_iterations": results["depth"].iterations,
        "plain_iterations": results["plain"].iterations,
        "pycolmap_iterations": ceres.num_successful_steps + ceres.num_unsuccessful_steps,
        "plain_cost_over_pycolmap": results["plain"].final_cost / ceres.final_cost,
        "threads_agree": float(
            all(
                np.array_equal(getattr(results["depth"], name), getattr(other, name))
                for other in [results["depth_one_thread"]]
                for name in ("rotations", "translations", "points")
            )
        ),
    }


def bench_optimum(starts: int) -> dict[str, float]:
    """Measure the largest differences to Ceres (with Python depth costs) over perturbed starts."""
    truth = make_problem(6, 80, 3.5)
    tight = SOFT_L1_OPTIONS.model_copy(update={"function_tolerance": 1e-13, "max_iterations": 1000})
    cost, turn, shift = [], [], []
    for seed in range(starts):
        start = perturb(truth, seed, amount=2.0)
        _, ceres_cost, rec = solve_with_ceres(start)
        result = adjust_bundle(start, tight)
        poses = [rec.images[i + 1].cam_from_world() for i in range(len(start.rotations))]
        cost.append(abs(result.final_cost / ceres_cost - 1))
        turn += [
            np.abs(p.rotation.matrix() - r).max()
            for p, r in zip(poses, result.rotations, strict=True)
        ]
        shift += [
            np.abs(p.translation - t).max() for p, t in zip(poses, result.translations, strict=True)
        ]
    return {
        "starts": starts,
        "max_relative_cost": max(cost),
        "max_rotation_entry": float(max(turn)),
        "max_translation": float(max(shift)),
    }


def bench_covariance(repeats: int) -> dict[str, float]:
    """Compare point covariances with the dense inverse, and measure the time of both."""
    small = replace(make_problem(6, 80, 3.5), obs_log_depth=None)
    information = dense_point_information(small) + DAMPING * np.eye(3 * len(small.points))
    inverse = np.linalg.inv(information).reshape(len(small.points), 3, -1, 3)
    expected = inverse[np.arange(len(small.points)), :, np.arange(len(small.points))]
    error = np.linalg.norm(
        compute_point_covariances(small, SOFT_L1_OPTIONS) - expected, axis=(1, 2)
    )
    large = replace(make_problem(*SIZES["S"]), obs_log_depth=None)
    rec = to_pycolmap(large)
    options = pycolmap.BACovarianceOptions(params=pycolmap.BACovarianceOptionsParams.POINTS)
    median, results = side_by_side(
        {
            "ours": lambda: compute_point_covariances(large, SOFT_L1_OPTIONS),
            "pycolmap": lambda: pycolmap.estimate_ba_covariance(options, rec, ceres_adjuster(rec)),
        },
        repeats,
    )
    theirs = np.stack([results["pycolmap"].get_point_cov(p + 1) for p in range(len(large.points))])
    difference = np.linalg.norm(results["ours"] - theirs, axis=(1, 2))
    return {
        "max_error_to_dense_inverse": float((error / np.linalg.norm(expected, axis=(1, 2))).max()),
        "max_difference_to_pycolmap": float(
            (difference / np.linalg.norm(theirs, axis=(1, 2))).max()
        ),
        "microseconds_per_point": median["ours"] / len(large.points) * 1e6,
        "pycolmap_microseconds_per_point": median["pycolmap"] / len(large.points) * 1e6,
    }


def main() -> None:
    """Parse the command line and run the bundle adjustment benchmark."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sizes", nargs="*", choices=list(SIZES), default=list(SIZES))
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    elapsed, _ = timed(lambda: adjust_bundle(make_problem(3, 30, 2.5), SOFT_L1_OPTIONS))
    report: dict[str, Any] = {"first_call_seconds": elapsed}
    report["local"] = bench_speed(LOCAL, arguments.repeats)
    for name in arguments.sizes:
        report[name] = bench_speed(SIZES[name], arguments.repeats)
    report["optimum"] = bench_optimum(STARTS)
    report["covariance"] = bench_covariance(arguments.repeats)
    if arguments.json:
        print(json.dumps(report))
        return
    for name, values in report.items():
        for key, value in values.items() if isinstance(values, dict) else [("", values)]:
            print(f"{name:12} {key:32} {value:.6g}")


if __name__ == "__main__":
    main()
