"""Comparison of our dense stage with another CPU pipeline on the same poses.

    python -m benchmarks.dense_peer [--cases kitchen-all-config ...] [--true-poses] [--output DIR]

The other pipeline is pyarchinit-photogrammetry (GPL), which only this benchmark needs:

    pip install --no-deps pyarchinit-photogrammetry pyarchinit-photogrammetry-core

pyarchinit-photogrammetry runs PatchMatch stereo in Rust and COLMAP's fusion on the CPU, with the
defaults for close range (``moderate``). OpenCV's semi-global matching of rectified pairs
initializes PatchMatch. Both pipelines start from the photos and from our sparse model. The
benchmark cases and their reconstructions are those of :mod:`benchmarks.dense`.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pycolmap

from benchmarks._scenes import shared_folder
from benchmarks.dense import CASES, TOLERANCES, mapped_sets, table, view_of, without_prior
from mpsfm_core.data import Bool, DepthPrior, Float64, View
from mpsfm_core.dense.densify import densify
from mpsfm_core.dense.fusion import fuse_depth_maps
from mpsfm_core.dense.options import DenseOptions
from mpsfm_core.evaluation.alignment import trajectory_errors
from mpsfm_core.evaluation.dense_geometry import evaluate_dense_geometry
from mpsfm_core.evaluation.depth_accuracy import sample_depth_at_truth
from mpsfm_core.evaluation.prior_quality import read_depth
from mpsfm_core.evaluation.report import CLOUD_METRICS
from mpsfm_core.evaluation.scene_folder import SceneFolder, read_scene
from mpsfm_core.evaluation.true_surface import true_depth_file
from mpsfm_core.geometry import sample_nearest
from mpsfm_core.geometry.pycolmap_conversion import colmap_from_pinhole
from mpsfm_core.inputs.images import load_images
from mpsfm_core.inputs.options import InputOptions
from mpsfm_core.mapping.scene.reconstruction import Reconstruction
from mpsfm_core.results.colmap_model import build_model
from mpsfm_core.results.ply import read_ply

MODE = "moderate"
"""Quality mode of pyarchinit-photogrammetry, its own default for close-range photos."""
_INSTALL = "pip install --no-deps pyarchinit-photogrammetry pyarchinit-photogrammetry-core"
Maps = dict[str, DepthPrior]


def peer_result(
    model: Reconstruction, view: Callable[[str], View], folder: Path
) -> tuple[Maps, Float64]:
    """Run pyarchinit-photogrammetry; return depth maps by image name and the cloud (n, 3)."""
    try:
        from pyarchinit_photogrammetry.engine import dense as peer
    except ImportError as error:
        raise SystemExit(_INSTALL) from error
    for name in ("images", "sparse", "stereo/depth_maps", "stereo/normal_maps"):
        (folder / name).mkdir(parents=True)
    grey = {}
    for image in model.images:
        picture = np.round(view(image.name).image).astype(np.uint8)[..., ::-1]
        cv2.imwrite(str(folder / "images" / image.name), picture)
        grey[image.index + 1] = cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY)
    cameras = [colmap_from_pinhole(image.camera) for image in model.images]
    nowhere = [np.zeros((len(image.point_ids), 2)) for image in model.images]
    colmap = build_model(model, cameras, nowhere, np.zeros((len(model.points), 3), np.uint8))
    colmap.write_binary(str(folder / "sparse"))
    agree, tolerance, pixels = peer.FILTER_MODES[MODE]
    partners = peer._neighbors(colmap, max_neighbors=peer.PATCHMATCH_PARTNERS)
    maps: Maps = {}
    for number, image in colmap.images.items():
        pose, matrix = peer._pose(image), peer._K(colmap.cameras[image.camera_id])
        span = peer._depth_range(colmap, image, pose)
        if span is None or not partners[number]:
            continue
        sources, depth_maps = [], []
        for other in partners[number]:
            theirs = peer._pose(colmap.images[other])
            their_matrix = peer._K(colmap.cameras[colmap.images[other].camera_id])
            relative = theirs @ np.linalg.inv(pose)
            turned, shift = (np.ascontiguousarray(x) for x in (relative[:3, :3], relative[:3, 3]))
            sources.append((_unit(grey[other]), _params(peer, their_matrix), turned, shift))
            pair = grey[number], grey[other], matrix, their_matrix, pose, theirs, span
            depth = peer._pair_depth(*pair)
            depth_maps += [] if depth is None else [depth]
        start = (
            peer._combine(depth_maps, min(agree, 1), max(tolerance, 0.01)) if depth_maps else None
        )
        normals = None if start is None else peer._normals_from_depth(start, matrix)
        kernel = peer._native.kernel("patchmatch_depth")
        depth, normals, _ = kernel(
            _unit(grey[number]),
            _params(peer, matrix),
            sources,
            tuple(map(float, span)),
            init_depth=start,
            init_normals=normals,
            iterations=4,
            max_cost=peer.PATCHMATCH_COST[MODE],
            min_views=1,
        )
        if (depth > 0).sum() <= 100:
            continue
        normals[depth <= 0] = 0
        for kind, array in (("depth_maps", depth), ("normal_maps", normals)):
            peer.write_colmap_array(folder / "stereo" / kind / f"{image.name}.geometric.bin", array)
        valid = depth > 0
        maps[image.name] = DepthPrior.from_arrays(depth, np.ones_like(depth), valid)
    (folder / "stereo" / "fusion.cfg").write_text("\n".join(maps) + "\n", encoding="utf-8")
    options = pycolmap.StereoFusionOptions()
    options.min_num_pixels, options.max_reproj_error = pixels, 2.0
    options.max_depth_error, options.max_normal_error = 0.01, 20.0
    pycolmap.logging.minloglevel = 1
    cloud = folder / "fused.ply"
    kinds = {"input_type": "geometric", "output_type": "PLY"}
    pycolmap.stereo_fusion(str(cloud), str(folder), options=options, **kinds)
    return maps, read_ply(cloud)[0]


def _unit(grey: Any) -> Any:
    return np.ascontiguousarray(grey, np.float32) / 255


def _params(peer: Any, matrix: Float64) -> tuple[float, ...]:
    k = peer._K_cv(matrix)
    return k[0, 0], k[1, 1], k[0, 2], k[1, 2]


def ours(
    model: Reconstruction, view: Callable[[str], View], prior: bool, true_poses: bool
) -> tuple[Maps, Float64, dict[str, Bool]]:
    """Run our dense stage; return depth maps, fused cloud, and masks of measured pixels."""
    model = model if prior else without_prior(model)
    poses_use_depth = prior and not true_poses
    model, report = densify(model, view, DenseOptions(), poses_use_depth=poses_use_depth)
    cloud = fuse_depth_maps(model, view).points
    return {image.name: image.depth for image in model.images}, cloud, dict(report.measured)


def depth_errors(
    scene: SceneFolder, maps: Maps, chosen: dict[str, Bool], names: Sequence[str], scale: float
) -> dict[str, float]:
    """Compute median relative depth error, share of pixels within 1 %, and share of measured
    pixels."""
    assert scene.depth is not None
    total, errors = 0, [np.zeros(0)]
    for name in names:
        truth = read_depth(true_depth_file(scene.depth, name))
        total += int((truth > 0).sum())
        if name not in maps:
            continue
        xy, depth_samples, true = sample_depth_at_truth(maps[name].depth, maps[name].valid, truth)
        errors.append(np.abs(scale * depth_samples / true - 1)[sample_nearest(chosen[name], xy)])
    relative = np.concatenate(errors)
    return {
        "known": len(relative) / total,
        "median": float(np.median(relative)),
        "abs_rel": float(relative.mean()),
        "within_1%": float((relative < 0.01).mean()),
    }


def main() -> None:
    """Parse the command line and compare the dense pipelines."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    chosen = ["kitchen-all-config", "kitchen-leq30-config"]
    parser.add_argument("--cases", nargs="+", default=chosen, choices=CASES, metavar="CASE")
    parser.add_argument("--true-poses", action="store_true")
    parser.add_argument("--output", type=Path, default=Path("build/benchmarks/dense"))
    arguments = parser.parse_args()
    rows = []
    for case in arguments.cases:
        scene = read_scene(shared_folder() / "data" / CASES[case].scene)
        photos = load_images(scene.images, scene.intrinsics, None, InputOptions())
        cameras = {photo.name: photo.pinhole for photo in photos}
        for number, model in enumerate(mapped_sets(case, arguments.output, arguments.true_poses)):
            view = view_of(photos)
            errors = trajectory_errors(model.poses, scene.truth)
            if errors is None:
                continue
            for way in ("peer", "dense", "without prior"):
                started, clock = time.process_time(), time.perf_counter()
                if way == "peer":
                    with tempfile.TemporaryDirectory() as folder:
                        maps, cloud = peer_result(model, view, Path(folder))
                    seen = {name: depth.valid for name, depth in maps.items()}
                else:
                    maps, cloud, seen = ours(model, view, way == "dense", arguments.true_poses)
                seconds = time.process_time() - started, time.perf_counter() - clock
                scale = errors.truth_from_estimate.scale
                metrics = depth_errors(scene, maps, seen, [i.name for i in model.images], scale)
                judged = evaluate_dense_geometry(model, cloud, scene, cameras, TOLERANCES)
                assert judged is not None
                row: dict[str, Any] = {"case": case, "set": number, "way": way, **metrics}
                for tolerance in map(str, TOLERANCES):
                    for key in CLOUD_METRICS:
                        row[f"{key} {tolerance}"] = judged["cloud"][key][tolerance]
                row["points"] = judged["cloud"]["points"]
                per_photo = [each / len(model.images) for each in seconds]
                row["cpu_s_photo"], row["wall_s_photo"] = per_photo
                rows.append(row)
                print(table(rows[-1:]), flush=True)
    print(table(rows))


if __name__ == "__main__":
    main()
