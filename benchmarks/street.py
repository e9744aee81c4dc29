"""Point clouds of generated streets with sky, trees, thin poles and a pedestrian.

    python -m benchmarks.street [--seeds 0 1 2]

A street has a ground plane, houses, trees of spheres, poles 6 to 12 cm wide, and a sky with clouds.
A pedestrian stands in another place in each photo. Poses are exact. Depth priors have smooth
errors, no sharp depth edges, and a finite depth in the sky. The distance of a point to the nearest
surface of the static scene is exact.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import cv2
import numpy as np

from mpsfm_core.data import DepthPrior, Float32, Float64, Int64, PinholeCamera, UInt8, View
from mpsfm_core.dense.densify import densify
from mpsfm_core.dense.fusion import FusedPointCloud, fuse_depth_maps
from mpsfm_core.dense.options import DenseOptions
from mpsfm_core.evaluation.cloud_accuracy import cloud_accuracy, thin_points
from mpsfm_core.geometry import camera_center, pixel_centers, rays, unproject
from mpsfm_core.mapping.scene.reconstruction import Reconstruction, RegisteredImage
from mpsfm_core.testing.synthetic.degraded_depth import DepthErrors, degrade_depth
from mpsfm_core.testing.synthetic.scenes import (
    AnalyticScene,
    Box,
    Plane,
    Sphere,
    Surface,
    Texture,
    look_at,
)

CAMERA = PinholeCamera(512, 384, 400.0, 400.0, 256.0, 192.0)
NUM_VIEWS = 12
SUPERSAMPLING = 2
"""Rendered pixels per pixel of a photo along each side, so that depth edges have mixed colors."""
PRIOR_WIDTH = 128
"""Width of the depth prior; each of its pixels averages the depth of a block of pixels."""
SKY_DEPTH = 40.0
"""Largest depth of the prior in meters, which is also the depth of the prior in the sky."""
PRIOR_STD = 0.1
"""Relative std that the depth priors declare."""
IMAGE_NOISE = 2.0
"""Std of the image noise in gray levels."""
TOLERANCES = (0.02, 0.05, 0.1)
"""Distance thresholds in meters of accuracy and completeness."""
OUTLIER_M, OUTLIER_STDS = 0.05, 5.0
"""Distances from any surface, in meters and in stds of the point, above which a point is wrong."""


class Street(NamedTuple):
    """Generated street with its photos and a reconstruction with exact poses."""

    static: tuple[Surface, ...]
    """Ground, houses, trees and poles."""
    poles: range
    """Indices of the poles in ``static``."""
    views: Mapping[str, View]
    reconstruction: Reconstruction
    surface: Float64
    """(n, 3) points of the static surfaces that the photos show, up to ``SKY_DEPTH`` away."""
    pole_surface: Float64
    """(n, 3) points of ``surface`` on poles."""


def make_street(seed: int) -> Street:
    """Generate a street and render its photos and depth priors."""
    rng = np.random.default_rng([seed, 54])
    surfaces: list[Surface] = [
        Plane((0, 0, 0), (0, 0, 1)),
        Box((rng.uniform(-4, -1), 17, 3.5), (6, 2, 3.5), yaw_deg=rng.uniform(-8, 8)),
        Box((rng.uniform(8, 11), 19, 2.5), (3, 3, 2.5), yaw_deg=rng.uniform(-30, 30)),
        Box((rng.uniform(-15, 15), 32, 4), (5, 3, 4)),
    ]
    for x in (rng.uniform(-6, -3), rng.uniform(3, 6)):
        y = rng.uniform(9, 12)
        surfaces.append(Box((x, y, 1.2), (0.12, 0.12, 1.2), yaw_deg=rng.uniform(0, 90)))
        for offset in rng.normal(0, (0.9, 0.9, 0.6), (25, 3)):
            center = tuple((np.array([x, y, 3.3]) + offset).tolist())
            surfaces.append(Sphere(center, rng.uniform(0.15, 0.45)))
    start = len(surfaces)
    for x in rng.uniform(-5, 5, 5):
        half = rng.uniform(0.03, 0.06)
        surfaces.append(Box((x, rng.uniform(6, 10), 1.6), (half, half, 1.6)))
    poles = range(start, len(surfaces))
    views, images, points, pole_points = {}, [], [], []
    for index in range(NUM_VIEWS):
        x = 0.8 * (index - (NUM_VIEWS - 1) / 2)
        eye = np.array([x, 0, 1.6]) + rng.normal(0, 0.1, 3)
        pose = look_at(eye, np.array([0.5 * x, 12, 2.4]))
        pedestrian = Box((rng.uniform(-4, 4), rng.uniform(7, 9), 0.9), (0.25, 0.15, 0.9))
        scene = AnalyticScene((*surfaces, pedestrian), Texture(seed=seed))
        name = f"{index:02d}.png"
        rgb, depth, surface_idx = _render(scene, pose, seed, rng)
        views[name] = View(name, rgb, CAMERA)
        prior = _make_prior(depth, name, seed)
        no_points = np.zeros(0, np.int64)
        images.append(
            RegisteredImage(index, name, CAMERA, pose[:, :3], pose[:, 3], no_points, prior, 1.0)
        )
        known = (depth > 0) & (depth < SKY_DEPTH) & (surface_idx < len(surfaces))
        xy = pixel_centers(*CAMERA.size)[known]
        local = unproject(CAMERA, xy, depth[known])
        world = local @ pose[:, :3] + camera_center(pose[:, :3], pose[:, 3])
        points.append(world)
        pole_points.append(world[np.isin(surface_idx[known], poles)])
    spacing = min(TOLERANCES) / 2
    return Street(
        tuple(surfaces),
        poles,
        views,
        Reconstruction(tuple(images), np.zeros((0, 3)), np.zeros(0)),
        thin_points(np.concatenate(points), spacing),
        thin_points(np.concatenate(pole_points), spacing),
    )


def _render(
    scene: AnalyticScene, pose: Float64, seed: int, rng: np.random.Generator
) -> tuple[UInt8, Float32, Int64]:
    """Render a photo with sky and noise, true depth (0 in the sky) and indices of surfaces."""
    width, height = CAMERA.size
    fine = CAMERA.resized(SUPERSAMPLING * width, SUPERSAMPLING * height)
    xy = pixel_centers(*fine.size).reshape(-1, 2)
    seen = scene.sample(fine, pose, xy)
    rgb = scene.texture.colors(seen.points, seen.surface, seen.depth / fine.fx)
    directions = rays(fine, xy[~seen.valid]) @ pose[:, :3]
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    none, far = np.zeros(len(directions), np.int64), np.full(len(directions), 0.02)
    clouds = Texture(longest_wave=0.6, contrast=0.3, seed=seed + 1).colors(directions, none, far)
    rgb[~seen.valid] = 0.3 * clouds.mean(axis=1, keepdims=True) + (120, 150, 185)
    photo = cv2.resize(rgb.reshape(*fine.size[::-1], 3), (width, height), interpolation=3)
    photo = np.clip(photo + rng.normal(0, IMAGE_NOISE, photo.shape), 0, 255).astype(np.uint8)
    centers = scene.sample(CAMERA, pose, pixel_centers(width, height))
    shape = height, width
    return photo, centers.depth.reshape(shape).astype(np.float32), centers.surface.reshape(shape)


def _make_prior(depth: Float32, name: str, seed: int) -> DepthPrior:
    """Make a depth prior with smooth errors, soft depth edges and a finite depth in the sky."""
    filled = np.where(depth > 0, np.minimum(depth, SKY_DEPTH), np.float32(SKY_DEPTH))
    size = PRIOR_WIDTH, PRIOR_WIDTH * CAMERA.height // CAMERA.width
    soft = cv2.resize(filled, size, interpolation=cv2.INTER_AREA)
    wrong = degrade_depth(soft, name, DepthErrors(scale=0.0, field=0.07), seed)
    return DepthPrior.from_arrays(wrong, (PRIOR_STD * wrong) ** 2)


def distance_to_surfaces(points: Float64, surfaces: Sequence[Surface]) -> Float64:
    """Compute the distances (n,) of points (n, 3) to the nearest of planes, boxes and spheres."""
    nearest = np.full(len(points), np.inf)
    for surface in surfaces:
        if isinstance(surface, Plane):
            normal = np.asarray(surface.normal) / np.linalg.norm(surface.normal)
            distance = (points - surface.point) @ normal
        elif isinstance(surface, Sphere):
            distance = np.linalg.norm(points - surface.center, axis=1) - surface.radius
        elif isinstance(surface, Box):
            yaw = np.deg2rad(surface.yaw_deg)
            axes = np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0]])
            world_from_box = np.vstack([axes, [0, 0, 1]])
            local = np.abs((points - surface.center) @ world_from_box) - surface.half_size
            outside = np.linalg.norm(np.maximum(local, 0), axis=1)
            distance = outside + np.minimum(local.max(axis=1), 0)
        else:
            raise TypeError(f"no distance to a {type(surface).__name__}")
        nearest = np.minimum(nearest, np.abs(distance))
    return nearest


def outlier_ratios(distance: Float64, std: Float32) -> dict[str, float]:
    """Compute ratios of points (n,) farther from any surface than 5 cm, 5 stds and both."""
    far, unlikely = distance > OUTLIER_M, distance > OUTLIER_STDS * std
    return {
        "far": float(far.mean()),
        "unlikely": float(unlikely.mean()),
        "both": float((far & unlikely).mean()),
    }


def evaluate_cloud(street: Street, cloud: FusedPointCloud) -> dict[str, float]:
    """Compare the cloud of a street with its surfaces."""
    distance = distance_to_surfaces(cloud.points, street.static)
    accuracy = cloud_accuracy(cloud.points, street.surface, TOLERANCES)
    poles = cloud_accuracy(cloud.points, street.pole_surface, TOLERANCES)
    result = outlier_ratios(distance, cloud.std)
    for tolerance in map(str, TOLERANCES):
        result[f"completeness {tolerance}"] = accuracy["completeness"][tolerance]
        result[f"f1 {tolerance}"] = accuracy["f1"][tolerance]
    result["poles 0.1"] = poles["completeness"]["0.1"]
    result["points"] = len(cloud.points)
    return result


def main() -> None:
    """Parse the command line, and print a table with one row per street."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2])
    arguments = parser.parse_args()
    for row, seed in enumerate(arguments.seeds):
        street = make_street(seed)
        dense, _ = densify(
            street.reconstruction, street.views.__getitem__, DenseOptions(), poses_use_depth=False
        )
        errors = evaluate_cloud(street, fuse_depth_maps(dense, street.views.__getitem__))
        if row == 0:
            print("| seed | " + " | ".join(errors) + " |\n|" + " ---: |" * (len(errors) + 1))
        cells = [f"{100 * v:.1f}" if v <= 1 else f"{v:.0f}" for v in errors.values()]
        print(f"| {seed} | " + " | ".join(cells) + " |", flush=True)


if __name__ == "__main__":
    main()
