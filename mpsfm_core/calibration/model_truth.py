"""The points of a COLMAP model as true depth.

The model's poses are kept; every point is placed anew where its rays alone want it. So the depth
that a reconstruction of ours was given has no part in the depth that it is compared with, and the
covariance of a point is that of its rays.

Points crowd where there is texture, and there networks err less than on blank walls. What is
compared is therefore not the points but pixels drawn evenly, each with the point nearest to it.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pycolmap
from scipy.spatial import cKDTree

from mpsfm_core.calibration.samples import DepthTruth
from mpsfm_core.data import Bool, Float64, Int64
from mpsfm_core.geometry import camera_center
from mpsfm_core.geometry.statistics import MAD_TO_STD
from mpsfm_core.inputs.images import ImageSet
from mpsfm_core.mapping.scene.kernels import compute_max_triangulation_angles
from mpsfm_core.optimize.bundle_adjustment import BundleProblem, adjust_bundle
from mpsfm_core.optimize.covariance import compute_point_covariances, propagate_depth_variance
from mpsfm_core.optimize.options import SOFT_L1_OPTIONS

MIN_ANGLE_DEG = 2.0
"""Points of a smaller triangulation angle are no truth (reference: robust_triangles)."""
MAX_LOG_STD = 0.05
"""Nor is a depth that its rays leave less certain than this share of it (ours)."""
MAX_ERROR_STD = 4.0
"""Nor is a point with an observation this many standard deviations off (reference: 4 px)."""
STD_PX_RANGE = (0.3, 3.0)
"""Bounds of the measured noise of keypoints (ours)."""
REACH = 0.08
"""A pixel farther than this share of the view's width from all points is not compared (ours; 0.04
to 0.15 gave stds within 12 % in the HoloLens room)."""


def depth_truth_from_model(
    model: pycolmap.Reconstruction, images: ImageSet
) -> dict[str, DepthTruth]:
    """True depth at the observed points of each image that both the model and the set have."""
    seen = _observe(model, images)
    if not len(seen.points):
        return {}
    problem = _triangulate(seen)
    depth = _in_camera(problem)[:, 2]
    variance = propagate_depth_variance(
        compute_point_covariances(problem, SOFT_L1_OPTIONS)[seen.point],
        problem.rotations[seen.image],
    )
    std = np.sqrt(variance) / np.maximum(depth, 1e-9)
    good = _well_placed(problem)[seen.point] & (depth > 0) & (std < MAX_LOG_STD)
    truth = {}
    for number, name in enumerate(seen.names):
        rows = good & (seen.image == number)
        truth[name] = DepthTruth(seen.view_xy[rows], depth[rows], std[rows])
    return truth


def sample_evenly(
    truth: DepthTruth, size: tuple[int, int], count: int, rng: np.random.Generator
) -> DepthTruth:
    """The points nearest to ``count`` pixels drawn evenly from a view of ``size`` (width, height).

    A point occurs as often as it stands for a pixel, a pixel without a point in :data:`REACH` is
    left out.
    """
    pixels = rng.uniform((0.0, 0.0), size, (count, 2))
    reach = REACH * size[0]
    distance, nearest = cKDTree(truth.xy).query(pixels, distance_upper_bound=reach)
    rows = nearest[np.isfinite(distance)]
    return DepthTruth(truth.xy[rows], truth.depth[rows], truth.std[rows])


class _ModelObservations(NamedTuple):
    """Observations of a model, sorted by point.

    ``names``: of the images, ``rotations`` (n, 3, 3), ``translations`` (n, 3), ``focals`` (n,).
    ``points``: (p, 3). ``image``, ``point``: (m,), ``xy``: (m, 2), undistorted and relative to the
    principal point; ``view_xy``: (m, 2), pixels of the view.
    """

    names: list[str]
    rotations: Float64
    translations: Float64
    focals: Float64
    points: Float64
    image: Int64
    point: Int64
    xy: Float64
    view_xy: Float64


def _observe(model: pycolmap.Reconstruction, images: ImageSet) -> _ModelObservations:
    sources = {image.name: image for image in images}
    posed = [i for i in model.images.values() if i.has_pose and i.name in sources]
    posed.sort(key=lambda image: str(image.name))
    poses, focals, columns, ids = [], [], [], []
    for number, image in enumerate(posed):
        camera = model.cameras[image.camera_id]
        observed = [point for point in image.points2D if point.has_point3D()]
        original = np.array([point.xy for point in observed], dtype=np.float64).reshape(-1, 2)
        focal = float(camera.mean_focal_length())
        view_xy = sources[str(image.name)].view_pixels(original)
        numbers = np.full((len(original), 1), float(number))
        columns.append(np.hstack([numbers, focal * camera.cam_from_img(original), view_xy]))
        ids += [int(point.point3D_id) for point in observed]
        poses.append(np.asarray(image.cam_from_world().matrix(), dtype=np.float64))
        focals.append(focal)
    known, point = np.unique(np.array(ids, dtype=np.int64), return_inverse=True)
    order = np.argsort(point, kind="stable")
    rows = np.concatenate([np.zeros((0, 5)), *columns])[order]
    matrices = np.array(poses).reshape(-1, 3, 4)
    return _ModelObservations(
        [str(image.name) for image in posed],
        matrices[:, :, :3],
        matrices[:, :, 3],
        np.array(focals),
        np.array([model.points3D[int(i)].xyz for i in known], dtype=np.float64).reshape(-1, 3),
        rows[:, 0].astype(np.int64),
        point[order].astype(np.int64),
        rows[:, 1:3],
        rows[:, 3:5],
    )


def _triangulate(seen: _ModelObservations) -> BundleProblem:
    """Points where their rays want them for the given poses; the noise of keypoints measured."""
    zeros = np.zeros(len(seen.focals))
    problem = BundleProblem(
        seen.rotations,
        seen.translations,
        np.stack([seen.focals, seen.focals, zeros, zeros], axis=1),
        np.arange(len(seen.focals)),
        seen.points,
        seen.image,
        seen.point,
        seen.xy,
        variable_pose=np.zeros(len(seen.focals), dtype=np.bool_),
    )
    problem = replace(problem, points=adjust_bundle(problem, SOFT_L1_OPTIONS).points)
    return replace(problem, obs_std_px=_noise_px(problem))


def _noise_px(problem: BundleProblem) -> float:
    """Std of keypoints, from the residuals of points that more than two images see."""
    lengths = np.bincount(problem.obs_point)[problem.obs_point]
    long = lengths > 2
    if not long.any():
        return 1.0
    # A point has three coordinates that fit themselves to its 2 x length residuals.
    lost = np.sqrt(2 * lengths[long] / (2 * lengths[long] - 3))
    residuals = _residuals(problem)[long] * lost[:, None]
    return float(np.clip(MAD_TO_STD * np.median(np.abs(residuals)), *STD_PX_RANGE))


def _well_placed(problem: BundleProblem) -> Bool:
    """(p,) points that are seen under a large angle and agree with all their observations."""
    centers = camera_center(problem.rotations, problem.translations)[problem.obs_image]
    angles = compute_max_triangulation_angles(
        problem.points, np.asarray(problem.obs_point, dtype=np.int64), centers
    )
    worst = np.zeros(len(problem.points))
    error = np.linalg.norm(_residuals(problem), axis=1) / problem.obs_std_px
    np.maximum.at(worst, problem.obs_point, error)
    good: Bool = (angles >= MIN_ANGLE_DEG) & (worst <= MAX_ERROR_STD)
    return good


def _in_camera(problem: BundleProblem) -> Float64:
    """Points (m, 3) of all observations in their camera frames."""
    points: Float64 = np.einsum(
        "nij,nj->ni", problem.rotations[problem.obs_image], problem.points[problem.obs_point]
    )
    placed: Float64 = points + problem.translations[problem.obs_image]
    return placed


def _residuals(problem: BundleProblem) -> Float64:
    """Reprojection residuals (m, 2), pixels; infinite behind the camera."""
    points = _in_camera(problem)
    focal = problem.intrinsics[problem.camera_of_image[problem.obs_image], 0]
    front = points[:, 2] > 0
    projected = points[:, :2] / np.where(front, points[:, 2], 1.0)[:, None] * focal[:, None]
    residuals: Float64 = np.where(front[:, None], projected - problem.obs_xy, np.inf)
    return residuals
