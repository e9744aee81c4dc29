"""Input arrays of bundle adjustment, their validation, and their layout for the kernels."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mpsfm_core.data import Bool, Float64, Int64
from mpsfm_core.data.camera_models import (
    NUM_DISTORTION,
    NUM_INTRINSICS,
    IntrinsicParameter,
    intrinsic_parameters,
)
from mpsfm_core.data.errors import DataError
from mpsfm_core.optimize import bundle_kernels as kernels
from mpsfm_core.optimize.options import BundleOptions
from mpsfm_core.optimize.rig_basis import RigConstraint
from mpsfm_core.support.threads import thread_limit

RANGE_SIZE = 8000
"""Number of observations per range of 3D points that one thread processes at a time. [ours]"""
MAX_RANGES = 8
"""Maximum number of ranges of 3D points, which threads process in parallel. [ours]"""
MAX_BUFFER_BYTES = 1 << 30
"""Maximum size in bytes of all copies of the reduced camera system, one per range. [ours]"""

DISTORTION = IntrinsicParameter.RADIAL_DISTORTION
Result = TypeVar("Result")
PointRange = tuple[int, int, int]
"""Range of 3D points, as the number of the range, the index of its first point, and the index after
its last point."""


@dataclass(frozen=True, eq=False)
class BundleProblem:
    """Parameters and observations of a bundle adjustment with n images, k cameras and p points.

    Callers fix the gauge by a constant pose. If no depth determines the scale of the scene, callers
    also set ``scale_anchor``.
    """

    rotations: Float64
    """(n, 3, 3) rotation of ``cam_from_world`` of each image."""
    translations: Float64
    """(n, 3) translation of ``cam_from_world`` of each image."""
    intrinsics: Float64
    """(k, 4) camera parameters fx, fy, cx, cy in pixels."""
    camera_of_image: NDArray[np.integer[Any]]
    """(n,) camera of each image, as row of ``intrinsics``."""
    points: Float64
    """(p, 3) 3D points in the world frame."""
    obs_image: NDArray[np.integer[Any]]
    """(m,) index of the image of each observation."""
    obs_point: NDArray[np.integer[Any]]
    """(m,) index of the 3D point of each observation."""
    obs_xy: Float64
    """(m, 2) keypoint of each observation, in COLMAP's pixel coordinates."""
    obs_std_px: Float64 | float = 1.0
    """(m,) standard deviation in pixels of the keypoint of each observation, or one number for all
    keypoints."""
    obs_log_depth: Float64 | None = None
    """(m,) log of the depth map at each observation, NaN if invalid (None without depth)."""
    obs_std_log_depth: Float64 | float = 1.0
    """(m,) standard deviation ``sqrt(variance) / depth`` of each log depth, or one number for all
    observations."""
    variable_pose: Bool | None = None
    """(n,) bool, True for images with variable pose (None makes all poses variable)."""
    variable_point: Bool | None = None
    """(p,) bool, True for variable 3D points (None makes all points variable)."""
    distortion: Float64 | None = None
    """(k, 4) distortion coefficients k1, k2, p1, p2 of COLMAP's OPENCV, or k1, k2, k3, k4 of
    OPENCV_FISHEYE (None uses 0)."""
    fisheye: Bool | None = None
    """(k,) bool, True for OPENCV_FISHEYE cameras and False for OPENCV cameras (None has no fisheye
    cameras)."""
    variable_intrinsics: Bool | None = None
    """(k, 8) bool, True for the variable :class:`~mpsfm_core.data.camera_models.IntrinsicParameter`
    of each camera (None keeps all intrinsics constant)."""
    prior_intrinsics: Float64 | None = None
    """(k, 8) mean of the prior on each intrinsic parameter (None uses the initial values)."""
    prior_std_intrinsics: Float64 | float = np.inf
    """(k, 8) standard deviation of the prior on each intrinsic parameter, or one number for all
    intrinsic parameters (infinite without prior)."""
    log_scales: Float64 | None = None
    """(n,) log of the scale factor on the depth map of each image (None uses 0)."""
    expected_log_scales: Float64 | None = None
    """(n,) mean of the prior on the log scale of each depth map (None uses 0)."""
    std_log_scales: Float64 | float = np.inf
    """(n,) standard deviation of the prior on the log scales, or one number for all images
    (infinite without prior)."""
    variable_scale: Bool | None = None
    """(n,) bool, True for images whose depth map has a variable log scale (None keeps all
    constant)."""
    scale_anchor: int | None = None
    """Image with a variable pose, one translation coordinate of which is kept constant to fix the
    scale. The constant translation coordinate is the one most sensitive to a change of scale about
    the first constant pose."""
    rig: RigConstraint | None = None
    """Relative poses of the images of each frame of a rig, or None if all poses are independent.
    With a rig, ``rig.variable_frame`` replaces ``variable_pose``, and ``scale_anchor`` keeps a
    coordinate of the frame of the image constant."""


class ScalePrior(NamedTuple):
    """Gaussian prior on the variable log scales of depth maps."""

    image: Int64
    """(s,) index of the image of each log scale."""
    slot: Int64
    """(s,) pose slot (index in the linear system) of the image of each log scale."""
    log_scale: Float64
    """(s,) mean."""
    weight: Float64
    """(s,) inverse variance of the prior on each log scale."""

    def cost(self, state: kernels.BundleParameters) -> float:
        """Return the cost of the log scale prior, half the weighted sum of squared residuals."""
        residuals = state.log_scales[self.image] - self.log_scale
        return 0.5 * float(residuals @ (self.weight * residuals))


class IntrinsicPrior(NamedTuple):
    """Gaussian prior on the variable intrinsic parameters of the cameras."""

    camera: Int64
    """(s,) index of the camera of each parameter."""
    parameter: Int64
    """(s,) :class:`~mpsfm_core.data.camera_models.IntrinsicParameter`."""
    slot: Int64
    """(s,) intrinsic slot of each parameter."""
    mean: Float64
    """(s,) mean."""
    weight: Float64
    """(s,) inverse variance of the prior on each parameter."""

    def residuals(self, state: kernels.BundleParameters) -> Float64:
        """Return the differences (s,) between intrinsic parameters and their prior means."""
        values = intrinsic_parameters(state.intrinsics, state.distortion)
        residuals: Float64 = values[self.camera, self.parameter] - self.mean
        return residuals

    def cost(self, state: kernels.BundleParameters) -> float:
        """Return the cost of the prior, half the weighted sum of squared residuals."""
        residuals = self.residuals(state)
        return 0.5 * float(residuals @ (self.weight * residuals))


class PreparedBundle(NamedTuple):
    """Validated bundle adjustment problem in the array layout of the compiled kernels."""

    bundle: kernels.BundleData
    state: kernels.BundleParameters
    pairs: Int64
    """(b, 2) pose slots of the two images of each block of the reduced camera system."""
    scale_prior: ScalePrior
    intrinsic_prior: IntrinsicPrior
    held: Bool
    """(s, 7) bool, True for constant parameters of the images with a pose slot."""
    ranges: list[PointRange]
    longest: int
    """Number of observations of the longest track."""
    rig: RigConstraint | None
    """Relative poses of the images of frames, or None if all poses are independent."""
    rig_gauge: tuple[int, int] | None
    """Frame and pose parameter that is constant to fix the scale gauge of a rig, or None."""


class RangeExecutor(Protocol):
    """Callable that applies a function to all ranges of 3D points, possibly in threads."""

    def __call__(self, function: Callable[[int, int, int], Result]) -> list[Result]:
        """Apply a function to all ranges of 3D points, and return the results in their order."""


def prepare_bundle(problem: BundleProblem, options: BundleOptions) -> PreparedBundle:
    """Validate a bundle adjustment problem and sort its observations by point.

    Raises:
        DataError: An array of the problem has a wrong shape, an index out of range, a value that is
            not finite, or a standard deviation that is not positive.
    """
    state = _state(problem)
    images, points, cameras = (len(a) for a in (state.rotations, state.points, state.intrinsics))
    obs = _observations(problem, images, points)
    variable_pose = _mask(problem.variable_pose, "variable_pose", images, True)
    rig, anchor = problem.rig, problem.scale_anchor
    if rig is not None:
        rig.check(state.rotations, state.translations)
        variable_pose = rig.variable_images()
    variable_point = _mask(problem.variable_point, "variable_point", points, True)
    variable = _variable_intrinsics(problem.variable_intrinsics, cameras)
    variable_scale = _mask(problem.variable_scale, "variable_scale", images, False)
    fisheye = _mask(problem.fisheye, "fisheye", cameras, False)
    intrinsic_slot = np.ascontiguousarray(_slots(variable.T.ravel()).reshape(-1, cameras).T)
    moving = variable_pose | variable_scale
    num_poses, pose_slot = int(np.count_nonzero(moving)), _slots(moving)
    first_block, block_column = _find_blocks(obs, pose_slot, variable_point, num_poses)
    layout = kernels.ParameterLayout(
        _indices(problem.camera_of_image, "camera_of_image", images, cameras),
        pose_slot,
        intrinsic_slot,
        np.asarray(variable.any(axis=1)),
        fisheye | (state.distortion != 0).any(axis=1) | variable[:, DISTORTION:].any(axis=1),
        fisheye,
        variable_point,
        variable_scale,
        num_poses,
        first_block,
        block_column,
    )
    rows = np.repeat(np.arange(num_poses), np.diff(first_block))
    pairs = np.stack([rows, block_column.astype(np.int64)], axis=1)
    held = np.repeat(~variable_pose[:, None], kernels.NUM_IMAGE_PARAMS, axis=1)
    held[:, kernels.LOG_SCALE_IDX] = ~variable_scale
    rig_gauge = None
    if rig is not None and anchor is not None:
        rig_gauge = rig.find_gauge(anchor, state.rotations, state.translations)
    elif anchor is not None:
        held[_scale_gauge(anchor, variable_pose, state)] = True
    robust = kernels.RobustLosses(
        int(options.reprojection_loss),
        options.reprojection_scale,
        int(options.depth_loss),
        options.depth_scale,
    )
    return PreparedBundle(
        kernels.BundleData(obs, layout, robust),
        state,
        pairs,
        _scale_prior(problem, variable_scale, layout.pose_slot),
        _intrinsic_prior(problem, variable, intrinsic_slot),
        held[moving],
        _ranges(obs.start, len(pairs)),
        int(np.diff(obs.start).max(initial=0)),
        rig,
        rig_gauge,
    )


@contextmanager
def range_executor(ranges: list[PointRange], threads: int | None) -> Iterator[RangeExecutor]:
    """Provide an executor that processes ranges of 3D points, in threads if useful."""
    count = min(len(ranges), threads or thread_limit())
    if count < 2:

        def run_here(function: Callable[[int, int, int], Result]) -> list[Result]:
            return [function(*part) for part in ranges]

        yield run_here
        return
    with ThreadPoolExecutor(count) as pool:

        def run(function: Callable[[int, int, int], Result]) -> list[Result]:
            return list(pool.map(lambda part: function(*part), ranges))

        yield run


def _state(problem: BundleProblem) -> kernels.BundleParameters:
    count, cameras = len(problem.rotations), len(problem.intrinsics)
    no_distortion = np.zeros((cameras, NUM_DISTORTION))
    distortion = no_distortion if problem.distortion is None else problem.distortion
    return kernels.BundleParameters(
        _numbers(problem.rotations, "rotations", (count, 3, 3)).copy(),
        _numbers(problem.translations, "translations", (count, 3)).copy(),
        _numbers_or_zero(problem.log_scales, "log_scales", count).copy(),
        _numbers(problem.intrinsics, "intrinsics", (cameras, 4)).copy(),
        _numbers(distortion, "distortion", (cameras, NUM_DISTORTION)).copy(),
        _numbers(problem.points, "points", (len(problem.points), 3)).copy(),
    )


def _observations(problem: BundleProblem, images: int, points: int) -> kernels.BundleObservations:
    count = len(problem.obs_image)
    image = _indices(problem.obs_image, "obs_image", count, images)
    point = _indices(problem.obs_point, "obs_point", count, points)
    xy = _numbers(problem.obs_xy, "obs_xy", (count, 2))
    weight = _inverse_std(problem.obs_std_px, "obs_std_px", count)
    log_depth = depth_weight = np.zeros(count)
    if problem.obs_log_depth is not None:
        given = np.asarray(problem.obs_log_depth, dtype=np.float64)
        known = ~np.isnan(given)
        log_depth = _numbers(np.where(known, given, 0.0), "obs_log_depth", (count,))
        std = np.where(known, problem.obs_std_log_depth, 1.0)
        depth_weight = np.where(known, _inverse_std(std, "obs_std_log_depth", count), 0.0)
    start, order = _sorted_by_point(image, point, images, points)
    return kernels.BundleObservations(
        start, image[order], xy[order], weight[order], log_depth[order], depth_weight[order]
    )


def _sorted_by_point(
    image: NDArray[np.int32], point: NDArray[np.int32], images: int, points: int
) -> tuple[Int64, Int64]:
    """Sort observations by point and image, and return each point's first observation."""
    by_image, order = np.empty(len(image), np.int64), np.empty(len(image), np.int64)
    start = np.zeros(points + 2, np.int64)
    kernels.counting_sort(image, np.arange(len(image)), np.zeros(images + 2, np.int64), by_image)
    kernels.counting_sort(point, by_image, start, order)
    return start[:-1], order


def _find_blocks(
    obs: kernels.BundleObservations,
    pose_slot: NDArray[np.int32],
    variable_point: Bool,
    num_poses: int,
) -> tuple[Int64, NDArray[np.int32]]:
    """Return the first block of each row of the reduced camera system, and all block columns."""
    lengths = np.diff(obs.start)
    slots = np.where(np.repeat(variable_point, lengths), pose_slot[obs.image], np.int32(-1))
    rows = np.flatnonzero(slots >= 0)
    start, order = np.zeros(num_poses + 2, np.int64), np.empty(len(rows), np.int64)
    kernels.counting_sort(slots, rows, start, order)
    ends, first = np.repeat(obs.start[1:], lengths), np.zeros(num_poses + 1, np.int64)
    columns = np.empty(0, np.int32)
    for _ in range(2):  # count the blocks, then list their columns
        last = np.full(num_poses, -1, np.int64)
        kernels.find_covisible_poses(slots, ends, order, start, last, first, columns)
        columns = np.empty(first[-1], np.int32) if not len(columns) else columns
    return first, columns


def _numbers_or_zero(values: Float64 | None, name: str, count: int) -> Float64:
    return _numbers(np.zeros(count) if values is None else values, name, (count,))


def _scale_prior(
    problem: BundleProblem, variable: Bool, pose_slot: NDArray[np.int32]
) -> ScalePrior:
    count = len(variable)
    expected = _numbers_or_zero(problem.expected_log_scales, "expected_log_scales", count)
    std = np.broadcast_to(np.asarray(problem.std_log_scales, dtype=np.float64), (count,))
    if not (std > 0).all():
        raise DataError("std_log_scales", "must be positive")
    image = np.flatnonzero(variable & np.isfinite(std))
    slot = pose_slot[image].astype(np.int64)
    return ScalePrior(image, slot, expected[image], 1.0 / std[image] ** 2)


def _variable_intrinsics(variable: Bool | None, cameras: int) -> Bool:
    """Validate the mask (k, 8) of variable intrinsic parameters."""
    if variable is None:
        return np.zeros((cameras, NUM_INTRINSICS), dtype=np.bool_)
    if variable.shape != (cameras, NUM_INTRINSICS) or variable.dtype != np.bool_:
        shape = f"({cameras}, {NUM_INTRINSICS})"
        raise DataError("variable_intrinsics", f"mask must be bool of shape {shape}")
    return variable


def _intrinsic_prior(
    problem: BundleProblem, variable: Bool, slot: NDArray[np.int32]
) -> IntrinsicPrior:
    shape = variable.shape
    std = np.asarray(problem.prior_std_intrinsics, dtype=np.float64)
    if std.ndim and std.shape != shape:
        raise DataError("prior_std_intrinsics", f"array must have shape {shape}, got {std.shape}")
    std = np.broadcast_to(std, shape)
    if not (std > 0).all():
        raise DataError("prior_std_intrinsics", "must be positive")
    means = problem.prior_intrinsics
    if means is None:
        means = intrinsic_parameters(problem.intrinsics, problem.distortion)
    means = _numbers(means, "prior_intrinsics", shape)
    parameter, camera = np.nonzero((variable & np.isfinite(std)).T)
    chosen = camera, parameter
    slots = slot[chosen].astype(np.int64)
    return IntrinsicPrior(camera, parameter, slots, means[chosen], 1.0 / std[chosen] ** 2)


def _numbers(values: ArrayLike, name: str, shape: tuple[int, ...]) -> Float64:
    array = np.ascontiguousarray(values, dtype=np.float64)
    if array.shape != shape:
        raise DataError(name, f"array must have shape {shape}, got {array.shape}")
    if not np.isfinite(array).all():
        raise DataError(name, "must be finite")
    return array


def _inverse_std(std: Float64 | float, name: str, count: int) -> Float64:
    array = _numbers(np.broadcast_to(std, (count,)) if np.ndim(std) == 0 else std, name, (count,))
    if not (array > 0).all():
        raise DataError(name, "must be positive")
    return 1.0 / array


def _indices(values: NDArray[Any], name: str, count: int, limit: int) -> NDArray[np.int32]:
    array = np.asarray(values)
    if array.shape != (count,) or array.dtype.kind not in "iu":
        raise DataError(name, f"indices must be integers of shape ({count},)")
    if count and not 0 <= array.min() <= array.max() < limit:
        raise DataError(name, f"indices must lie in [0, {limit})")
    return np.array(array, dtype=np.int32)


def _mask(values: Bool | None, name: str, count: int, default: bool) -> Bool:
    if values is None:
        return np.full(count, default)
    array = np.array(values)
    if array.shape != (count,) or array.dtype != np.bool_:
        raise DataError(name, f"mask must be bool of shape ({count},)")
    return array


def _slots(variable: Bool) -> NDArray[np.int32]:
    return np.where(variable, np.cumsum(variable) - 1, -1).astype(np.int32)


def _scale_gauge(anchor: int, variable: Bool, state: kernels.BundleParameters) -> tuple[int, int]:
    """Return the image and pose parameter to keep constant, which fixes the scale gauge."""
    if not (0 <= anchor < len(variable) and variable[anchor]) or variable.all():
        raise DataError(
            "scale_anchor",
            "scale anchor must be an image with variable pose, and another pose must be constant",
        )
    first = int(np.argmin(variable))
    center = -state.rotations[first].T @ state.translations[first]
    offset = state.rotations[anchor] @ center + state.translations[anchor]
    return anchor, 3 + int(np.argmax(np.abs(offset)))


def _ranges(start: Int64, pairs: int) -> list[PointRange]:
    """Split 3D points into ranges with similar numbers of observations."""
    max_count = MAX_BUFFER_BYTES // (8 * int(kernels.NUM_IMAGE_PARAMS) ** 2 * max(pairs, 1))
    count = max(1, min(MAX_RANGES, int(start[-1]) // RANGE_SIZE, max_count))
    ends = np.searchsorted(start, start[-1] * np.arange(1, count) / count)
    edges = [0, *ends.tolist(), len(start) - 1]
    return [(i, edges[i], edges[i + 1]) for i in range(count)]
