"""Accuracy of depth maps and fused clouds before and after the stage ``dense``.

    python -m benchmarks.dense [--cases fountain-all-config ...] [--true-poses] [--output DIR]

A case is a scene, a bucket of its test sets (grouped by overlap) and a depth prior. Reconstructions
of the test sets are stored in the output folder and reused. With ``--true-poses`` the mapper keeps
the true poses fixed, and estimates depth scales, points and refined depth maps.

Depth errors are computed after scaling by the camera centers, std coverage after scaling to the
true depth. The fused cloud is aligned by camera centers and compared with all true depth maps of
the test set. The scene ``fountain`` has no true depth maps. The metric on ``fountain`` is the share
of points, triangulated with the true poses, whose depth is within 1 %. ``--json`` prints one JSON
object as the last line.
"""

from __future__ import annotations

import argparse
import json
import pickle
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pycolmap

from benchmarks._scenes import shared_folder
from benchmarks.accuracy import FASTDEPTH, PRIORS
from mpsfm_core.data import Bool, DepthPrior, Float32, Float64, MappingProblem, Pose
from mpsfm_core.dense.densify import densify
from mpsfm_core.dense.depth_range import depth_prior_from_points
from mpsfm_core.dense.fusion import fuse_depth_maps
from mpsfm_core.dense.options import DenseOptions
from mpsfm_core.evaluation.alignment import trajectory_errors
from mpsfm_core.evaluation.benchmark import PreparedSets, SetPairFilter, prepare_sets
from mpsfm_core.evaluation.dense_geometry import evaluate_dense_geometry
from mpsfm_core.evaluation.depth_accuracy import sample_depth_at_truth
from mpsfm_core.evaluation.prior_quality import read_depth
from mpsfm_core.evaluation.report import CLOUD_METRICS
from mpsfm_core.evaluation.scene_folder import EvaluationSet, SceneFolder, read_scene
from mpsfm_core.evaluation.true_surface import true_depth_file
from mpsfm_core.geometry import (
    camera_center,
    project,
    rays,
    sample_bilinear,
    sample_nearest,
    scale_pixels,
    transform,
    triangulation_angle_deg,
)
from mpsfm_core.inputs.images import ImageSet, load_images
from mpsfm_core.inputs.options import InputOptions
from mpsfm_core.mapping.mapper import reconstruct
from mpsfm_core.mapping.scene.reconstruction import Reconstruction
from mpsfm_core.providers.registry import Registry

TOLERANCES = (0.02, 0.05)
"""Distance thresholds in meters for accuracy and completeness of point clouds."""
NEAR = 0.1
"""Maximum relative depth error of a pixel that counts as accurate."""
WAYS = ("mapper", "dense", "without prior")
"""Sources of depth maps: mapper, dense stage, and dense stage without depth prior.

The dense stage without depth prior only gets the depth range of the triangulated points.
"""
POINT_NEAR = 0.01
"""Maximum relative depth error of an accurate pixel at a triangulated point of ``fountain``."""
ANGLE, ERROR_PX = 3.0, 1.0
"""Minimum triangulation angle in degrees and maximum reprojection error of reference points."""


@dataclass(frozen=True)
class Case:
    """Test sets of a scene, and the kind of depth prior of their images."""

    scene: str
    bucket: str
    prior: str


CASES: Mapping[str, Case] = {
    f"{short}-{bucket}-{prior}": Case(scene, bucket, prior)
    for short, scene, buckets, priors in (
        (
            "kitchen",
            "rendered_kitchen",
            ("all", "leq30", "minimal"),
            PRIORS,
        ),
        ("hololens", "hololens_room", ("all", "leq30"), ("sensor", "config")),
        ("fountain", "fountain", ("all",), ("config",)),
    )
    for bucket in buckets
    for prior in priors
}
"""Benchmark cases by name; the depth prior ``config`` is the network FastDepth."""


def main() -> None:
    """Parse the command line and run the dense benchmark."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--cases", nargs="+", default=list(CASES), choices=CASES, metavar="CASE")
    parser.add_argument("--true-poses", action="store_true", help="map with the true poses, fixed")
    parser.add_argument("--output", type=Path, default=Path("build/benchmarks/dense"))
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    rows = []
    for name in arguments.cases:
        case = CASES[name]
        scene = read_scene(shared_folder() / "data" / case.scene)
        mapped = mapped_sets(name, arguments.output, arguments.true_poses)
        problem = None if scene.depth else problem_of_case(name, arguments.output)[0].problem
        rows += measured(name, scene, mapped, problem, not arguments.true_poses)
        print(table(rows[-1:]), file=sys.stderr)
    print(table(rows))
    if arguments.json:
        print(json.dumps({"rows": rows}))


def mapped_sets(name: str, output: Path, true_poses: bool = False) -> list[Reconstruction]:
    """Reconstruct the test sets of a case, or read the stored reconstructions."""
    stored = output / f"{name}{'-true-poses' if true_poses else ''}.pickle"
    if stored.is_file():
        return list(pickle.loads(stored.read_bytes()))
    prepared, sets = problem_of_case(name, output)
    options, truth = prepared.config.mapper_options(), {}
    if true_poses:
        truth = read_scene(shared_folder() / "data" / CASES[name].scene).truth
        options = options.model_copy(update={"known_poses": "fixed"})
    mapped = []
    for item in sets:
        problem = prepared.build_problem(item).with_poses(truth)
        mapped.append(reconstruct(problem, options).reconstructions[0])
    stored.write_bytes(pickle.dumps(mapped))
    return mapped


def problem_of_case(name: str, output: Path) -> tuple[PreparedSets, list[EvaluationSet]]:
    """Extract the matches and priors of the test sets of a case, or read them from the cache."""
    case = CASES[name]
    scene = read_scene(shared_folder() / "data" / case.scene)
    sets = scene.select_sets([case.bucket])
    output.mkdir(parents=True, exist_ok=True)
    config = output / "fastdepth.yaml"
    model = shared_folder() / "models" / "fastdepth_224.onnx"
    config.write_text(f"extends: benchmark\n{FASTDEPTH.format(model=model)}", encoding="utf-8")
    registry, only = Registry.discover(), SetPairFilter()
    only.allow(sets)
    registry.register(only, name="pairs of sets")
    prepared = prepare_sets(
        scene, sets, case.prior, str(config), ("runtime.workers=1",), output / name, registry
    )
    return prepared, sets


def measured(
    name: str,
    scene: SceneFolder,
    mapped: Sequence[Reconstruction],
    problem: MappingProblem | None,
    poses_use_depth: bool = True,
) -> list[dict[str, Any]]:
    """Compute mean errors over the test sets of a case, one row per source of depth maps.

    ``poses_use_depth`` is true if the mapper estimated the poses with depth priors.
    """
    photos = load_images(scene.images, scene.intrinsics, None, InputOptions())
    rows = []
    for way in WAYS:
        errors_by_set = []
        for item in mapped:
            model, seconds, seen = item, 0.0, {}
            if way == "without prior":
                model = without_prior(model)
            if way != "mapper":
                started = time.process_time()
                model, report = densify(
                    model,
                    view_of(photos),
                    DenseOptions(),
                    workers=1,
                    poses_use_depth=poses_use_depth and way != "without prior",
                )
                seen = report.measured
                seconds = (time.process_time() - started) / len(model.images)
            cloud, *_ = fuse_depth_maps(model, view_of(photos))
            errors = set_errors(scene, photos, problem, model, seen, cloud)
            errors_by_set.append({**errors, "cpu_s_photo": seconds})
        usable = [each for each in errors_by_set if len(each) > 1]
        rows.append({"case": name, "maps": way, "sets": len(usable), **_means(usable)})
    return rows


def without_prior(model: Reconstruction) -> Reconstruction:
    """Replace each depth prior by the depth range of the points of its image."""
    images = []
    for image in model.images:
        points = model.points[image.point_ids[image.point_ids >= 0]]
        depth = depth_prior_from_points(transform(image.rotation, image.translation, points)[:, 2])
        if depth is not None:
            images.append(replace(image, depth=depth))
    return replace(model, images=tuple(images))


def view_of(photos: ImageSet) -> Any:
    """Return a function that loads the undistorted view with a given image name."""
    index = {name: number for number, name in enumerate(photos.names)}
    return lambda name: photos.view(index[name])


def set_errors(
    scene: SceneFolder,
    photos: ImageSet,
    problem: MappingProblem | None,
    reconstruction: Reconstruction,
    seen: Mapping[str, Bool],
    cloud: Float64,
) -> dict[str, float]:
    """Compute the errors of depth maps and fused cloud (n, 3) of one test set.

    The returned errors are empty if too few camera centers determine the scale of the
    reconstruction. The matches of ``problem`` define the true depth of the scene ``fountain``.
    ``seen`` contains the mask (h, w) of measured pixels of each depth map, by image name.
    """
    maps = {image.name: image.depth for image in reconstruction.images}
    errors = trajectory_errors(reconstruction.poses, scene.truth)
    if errors is None:
        return {}
    scale = errors.truth_from_estimate.scale
    if scene.depth is None:
        assert problem is not None
        return points_near(problem, scene.truth, maps, scale)
    common_pixels = [
        MapBesideTruth.of(depth, read_depth(true_depth_file(scene.depth, name)), seen.get(name))
        for name, depth in maps.items()
    ]
    own_scale_factor = own_scale(common_pixels)
    map_metrics = [map_errors(each, scale, own_scale_factor) for each in common_pixels]
    cameras = {photo.name: photo.pinhole for photo in photos}
    accuracy = evaluate_dense_geometry(reconstruction, cloud, scene, cameras, TOLERANCES)
    assert accuracy is not None  # not None, because the scene has true depth
    result = {"abs_rel": accuracy["depth"]["abs_rel"], **_means(map_metrics)}
    for tolerance in map(str, TOLERANCES):
        centimetres = round(100 * float(tolerance))
        for key in CLOUD_METRICS:
            result[f"{key}_{centimetres}cm"] = accuracy["cloud"][key][tolerance]
    result["points"] = accuracy["cloud"]["points"]
    return result


class MapBesideTruth(NamedTuple):
    """Pixels with estimated and with true depth in one image.

    Each field has one value per pixel, (n,): estimated depth, its std, true depth, and whether
    multi-view stereo measured the pixel.
    """

    depth: Float64
    std: Float64
    truth: Float64
    measured: Bool

    @classmethod
    def of(cls, depth: DepthPrior, truth: Float32, seen: Bool | None) -> MapBesideTruth:
        """Collect the pixels with true depth; the argument ``seen`` is the mask of pixels that
        multi-view stereo measured."""
        assert depth.variance is not None  # refined depth maps always have a std
        xy, depth_samples, true = sample_depth_at_truth(depth.depth, depth.valid, truth)
        variance, _ = sample_bilinear(depth.variance, depth.valid, xy)
        measured_mask = np.zeros(depth.shape, np.bool_) if seen is None else seen
        return cls(
            depth_samples, np.sqrt(np.maximum(variance, 0)), true, sample_nearest(measured_mask, xy)
        )


def own_scale(maps: Sequence[MapBesideTruth]) -> float:
    """Compute the median of true over estimated depth over the measured pixels of a test set.

    All pixels are used if no pixel is measured. The median depth ratio is a more accurate scale
    than the scale from a few camera centers.
    """
    ratios = [each.truth / each.depth for each in maps]
    measured_ratios = [ratio[each.measured] for ratio, each in zip(ratios, maps, strict=True)]
    return float(
        np.median(np.concatenate(measured_ratios if any(map(len, measured_ratios)) else ratios))
    )


def map_errors(pixels: MapBesideTruth, scale: float, own_scale_factor: float) -> dict[str, float]:
    """Compute the depth errors of one depth map.

    The share of accurate pixels and AbsRel are computed after scaling by ``scale``, from the camera
    centers. A second AbsRel and the share of errors within one std are computed after scaling by
    ``own_scale_factor``, which fits the depth maps best.
    """
    measured, relative = pixels.measured, np.abs(scale * pixels.depth - pixels.truth) / pixels.truth
    error = np.abs(own_scale_factor * pixels.depth - pixels.truth)
    within = error <= own_scale_factor * pixels.std
    return {
        "near": float((relative <= NEAR).mean()),
        "measured": float(measured.mean()),
        "abs_rel_of_rest": float(relative[~measured].sum() / len(relative)),
        "abs_rel_own_scale": float((error / pixels.truth).mean()),
        "within_std_measured": float(within[measured].mean()) if measured.any() else np.nan,
        "within_std_rest": float(within[~measured].mean()) if not measured.all() else np.nan,
    }


def triangulated(problem: MappingProblem, truth: Mapping[str, Pose]) -> dict[str, Float64]:
    """Triangulate matches with true poses; return keypoints and depth (n, 3) of each image.

    Points with a reprojection error above a pixel or a small triangulation angle are excluded.
    """
    points_by_image: dict[str, list[Float64]] = {}
    for pair in problem.pairs:
        images = [problem.images[pair.image_a], problem.images[pair.image_b]]
        if not all(image.name in truth for image in images):
            continue
        poses = [truth[image.name] for image in images]
        matrices = [np.column_stack(pose) for pose in poses]
        pixels = [image.keypoints[rows] for image, rows in zip(images, pair.matches.T, strict=True)]
        local = [rays(image.camera, xy) for image, xy in zip(images, pixels, strict=True)]
        points = np.full((len(pair.matches), 3), np.nan)
        for row, (a, b) in enumerate(zip(*local, strict=True)):
            point = pycolmap.triangulate_point(*matrices, a[:2], b[:2])
            if point is not None:
                points[row] = point.ravel()
        good = triangulation_angle_deg(*(camera_center(*pose) for pose in poses), points) > ANGLE
        seen = [transform(*pose, points) for pose in poses]
        for image, xy, each in zip(images, pixels, seen, strict=True):
            off = np.linalg.norm(project(image.camera, each) - xy, axis=1)
            good &= (each[:, 2] > 0) & (off < ERROR_PX)
        for image, xy, each in zip(images, pixels, seen, strict=True):
            samples = np.column_stack([xy, each[:, 2]])[good]
            points_by_image.setdefault(image.name, []).append(samples)
    return {name: np.concatenate(parts) for name, parts in points_by_image.items()}


def points_near(
    problem: MappingProblem,
    truth: Mapping[str, Pose],
    maps: Mapping[str, DepthPrior],
    scale: float,
) -> dict[str, float]:
    """Compute the share of triangulated points whose depth is within 1 % of the depth map."""
    cameras = {image.name: image.camera for image in problem.images}
    right = total = 0
    for name, points in triangulated(problem, truth).items():
        if name not in maps:
            continue
        depth, true = maps[name], points[:, 2]
        xy = scale_pixels(points[:, :2], cameras[name].size, depth.shape[::-1])
        depth_samples, ok = sample_bilinear(depth.depth, depth.valid, xy)
        right += int((ok & (np.abs(scale * depth_samples - true) <= POINT_NEAR * true)).sum())
        total += len(points)
    return {"points_near": right / max(1, total), "true_points": float(total)}


def _means(rows: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """Compute the mean of each metric over the dictionaries that contain the metric."""
    values = {key: [each[key] for each in rows if np.isfinite(each[key])] for key in rows[0]}
    return {key: float(np.mean(known)) if known else np.nan for key, known in values.items()}


def table(rows: Sequence[Mapping[str, Any]]) -> str:
    """Format the rows of all cases as a Markdown table."""
    keys = list(dict.fromkeys(key for row in rows for key in row))
    lines = ["| " + " | ".join(keys) + " |", "|" + " --- |" * len(keys)]
    for row in rows:
        cells = [row.get(key, "") for key in keys]
        texts = [f"{cell:.3f}" if isinstance(cell, float) else str(cell) for cell in cells]
        lines.append("| " + " | ".join(texts) + " |")
    return "\n".join(lines)


if __name__ == "__main__":
    main()
