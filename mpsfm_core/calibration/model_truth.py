"""True depth from the points of a COLMAP model.

The poses of the model are fixed, and every point is triangulated again from its viewing rays alone.
The depth priors of the reconstruction therefore do not influence the true depth. The covariance of
a point contains only the errors of its rays.

Points concentrate on texture, where depth networks have smaller errors than on textureless
surfaces. Pixels are therefore sampled uniformly, and each pixel gets the depth of its nearest
point.
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
"""Minimum triangulation angle in degrees of a 3D point whose depth counts as true [reference:
robust_triangles]."""
MAX_LOG_STD = 0.05
"""Maximum relative std of the depth of a 3D point whose depth counts as true [ours]."""
MAX_ERROR_STD = 4.0
"""Maximum reprojection error, in keypoint stds, of a 3D point whose depth counts as true
[reference: 4 px]."""
STD_PX_RANGE = (0.3, 3.0)
"""Minimum and maximum of the estimated keypoint noise in pixels [ours]."""
REACH = 0.08
"""Maximum distance of a pixel to its nearest point, relative to the image width [ours]."""


def depth_truth_from_model(
    model: pycolmap.Reconstruction, images: ImageSet
) -> dict[str, DepthTruth]:
    """Triangulate true depth at the observations of each image of a COLMAP model, by image name."""
    seen = _observe(model, images)
    if not len(seen.points):
        return {}
    problem = _triangulate(seen)
    depth = _camera_points(problem)[:, 2]
    variance = propagate_depth_variance(
        compute_point_covariances(problem, SOFT_L1_OPTIONS)[seen.point],
        problem.rotations[seen.image],
    )
    std = np.sqrt(variance) / np.maximum(depth, 1e-9)
    good = _reliable_points(problem)[seen.point] & (depth > 0) & (std < MAX_LOG_STD)
    truth = {}
    for number, name in enumerate(seen.names):
        rows = good & (seen.image == number)
        truth[name] = DepthTruth(seen.view_xy[rows], depth[rows], std[rows])
    return truth


def sample_evenly(
    truth: DepthTruth, size: tuple[int, int], count: int, rng: np.random.Generator
) -> DepthTruth:
    """Sample pixels uniformly and return the true depth of the point nearest to each pixel.

    Several pixels may get the depth of the same 3D point. Pixels without a point within
    :data:`REACH` are omitted.

    Args:
        truth: True depth at the observed points of a view.
        size: (width, height) of the view in pixels.
        count: Number of pixels to sample.
        rng: Random generator.
    """
    pixels = rng.uniform((0.0, 0.0), size, (count, 2))
    reach = REACH * size[0]
    distance, nearest = cKDTree(truth.xy).query(pixels, distance_upper_bound=reach)
    rows = nearest[np.isfinite(distance)]
    return DepthTruth(truth.xy[rows], truth.depth[rows], truth.std[rows])


class _ModelObservations(NamedTuple):
    """Observations of a model with n images, p points and m observations, sorted by point."""

    names: list[str]
    """Names of the n images."""
    rotations: Float64
    """(n, 3, 3) rotations of ``cam_from_world``."""
    translations: Float64
    """(n, 3) translations of ``cam_from_world``."""
    focals: Float64
    """(n,) focal lengths of the images in pixels."""
    points: Float64
    """(p, 3) triangulated points, world frame."""
    image: Int64
    """(m,) image index of each observation."""
    point: Int64
    """(m,) point index of each observation."""
    xy: Float64
    """(m, 2) undistorted positions of the observations, pixels relative to the principal point."""
    view_xy: Float64
    """(m, 2) positions of the observations in COLMAP pixels of the view."""


def _observe(model: pycolmap.Reconstruction, images: ImageSet) -> _ModelObservations:
    """Collect the observations of the images that are in the model and in the image set."""
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
    """Triangulate all points for fixed poses and measure the keypoint noise."""
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
    """Estimate the std of keypoints in pixels from the residuals of tracks longer than two."""
    lengths = np.bincount(problem.obs_point)[problem.obs_point]
    long = lengths > 2
    if not long.any():
        return 1.0
    # A point with n observations has 2 n residuals and 3 parameters, so 2 n - 3 degrees of freedom.
    lost = np.sqrt(2 * lengths[long] / (2 * lengths[long] - 3))
    residuals = _residuals(problem)[long] * lost[:, None]
    return float(np.clip(MAD_TO_STD * np.median(np.abs(residuals)), *STD_PX_RANGE))


def _reliable_points(problem: BundleProblem) -> Bool:
    """Return the mask (p,) of points with large triangulation angle and small residuals."""
    centers = camera_center(problem.rotations, problem.translations)[problem.obs_image]
    angles = compute_max_triangulation_angles(
        problem.points, np.asarray(problem.obs_point, dtype=np.int64), centers
    )
    worst = np.zeros(len(problem.points))
    error = np.linalg.norm(_residuals(problem), axis=1) / problem.obs_std_px
    np.maximum.at(worst, problem.obs_point, error)
    good: Bool = (angles >= MIN_ANGLE_DEG) & (worst <= MAX_ERROR_STD)
    return good


def _camera_points(problem: BundleProblem) -> Float64:
    """Transform the points of all observations to their camera frames, (m, 3)."""
    points: Float64 = np.einsum(
        "nij,nj->ni", problem.rotations[problem.obs_image], problem.points[problem.obs_point]
    )
    placed: Float64 = points + problem.translations[problem.obs_image]
    return placed


def _residuals(problem: BundleProblem) -> Float64:
    """Compute reprojection residuals (m, 2) in pixels, infinite for points behind the camera."""
    points = _camera_points(problem)
    focal = problem.intrinsics[problem.camera_of_image[problem.obs_image], 0]
    front = points[:, 2] > 0
    projected = points[:, :2] / np.where(front, points[:, 2], 1.0)[:, None] * focal[:, None]
    residuals: Float64 = np.where(front[:, None], projected - problem.obs_xy, np.inf)
    return residuals
