"""Measure how well matches alone determine the distances and poses of the frames of rigs.

Two panoramas in different rooms share points that are seen through a door. These points determine
the direction of the baseline. The ratio of this baseline to others follows from points that three
frames see, or from depth priors. If the points fill a narrow cone, even rotation and direction
depend on depth priors. The covariance of bundle adjustment without depth priors shows which is the
case. The disagreement of the depth maps of two frames shows whether depth priors can help.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.sparse import bsr_array, csr_array

from mpsfm_core.data import Float64, Int64, MappingProblem
from mpsfm_core.geometry import camera_center
from mpsfm_core.mapping.refinement.filtering import MIN_IMAGE_POINTS
from mpsfm_core.mapping.scene.depth_map import DepthMap
from mpsfm_core.mapping.scene.reconstruction import RegisteredImage

MAX_FRAMES = 300
"""Maximum number of frames, because the run time is cubic in the number of frames. [ours]"""
DAMPING = 1e-12
"""Relative damping of the poses, which makes the information of unconnected frames invertible."""
MAX_ERROR_DEG = 180.0
"""Upper bound of predicted pose errors, because linearized errors are unbounded."""
_POSE, _POINT = 6, 3


class FrameErrors(NamedTuple):
    """Errors of the frames of rigs that matches alone predict."""

    relative_scale_std: float | None
    """Largest standard deviation of the distance of two frames with common points, relative to the
    larger of this distance and the median distance. None for fewer than two such distances."""
    pose_deg: Float64
    """(n,) median over the other frames of the root mean square relative pose error, which is the
    larger of the rotation error and the translation direction error."""
    depth_disagreement: float
    """Largest median difference of the log depths of two frames at their common points, in its
    declared standard deviations; 0 without such points. Depth errors of neighboring points are
    taken as equal, so many points do not reduce the standard deviation."""


def measure_frame_errors(
    frames: Sequence[Sequence[RegisteredImage]], points: Float64, problem: MappingProblem
) -> FrameErrors | None:
    """Predict the errors of distances and poses of frames from matches alone.

    The covariance is the inverse of the Gauss-Newton matrix of reprojection errors after the Schur
    complement of the points. Keypoint noise is estimated from the residuals. The gauge, which
    includes the scale, is fixed by the mean of all distances.

    Args:
        frames: Registered images of each frame.
        points: (p, 3) 3D points in world units.
        problem: Mapping problem with the keypoints and depth priors of the images.

    Returns:
        The predicted errors, or None if no two frames have common points, or for more than
        :data:`MAX_FRAMES` frames.
    """
    if not 1 < len(frames) <= MAX_FRAMES:
        return None
    centers = np.array([camera_center(f[0].rotation, f[0].translation) for f in frames])
    observations = _Observations(frames, centers, points, problem)
    edges = observations.find_edges()
    if not len(edges):
        return None
    information = observations.compute_information()
    gauge = _find_gauge(centers)
    constraint = gauge @ gauge.T + DAMPING * np.eye(len(gauge))
    covariance = np.linalg.inv(information + np.diagonal(information).max() * constraint)
    covariance *= observations.std_px**2
    return FrameErrors(
        _compute_scale_std(covariance, centers, edges) if len(edges) > 1 else None,
        _compute_pose_errors(covariance, centers),
        _measure_depth_disagreement(frames, points, problem, edges),
    )


def _compute_scale_std(covariance: Float64, centers: Float64, edges: Int64) -> float:
    """Return the largest relative standard deviation of the lengths of edges (e, 2)."""
    baselines = centers[edges[:, 0]] - centers[edges[:, 1]]
    lengths = np.linalg.norm(baselines, axis=1)
    references = np.maximum(lengths, np.median(lengths))
    directions = baselines / np.maximum(lengths, 1e-12)[:, None] / references[:, None]
    by_frame = np.zeros((len(edges), len(centers), _POSE))
    rows = np.arange(len(edges))
    by_frame[rows, edges[:, 0], 3:], by_frame[rows, edges[:, 1], 3:] = directions, -directions
    jacobian = by_frame.reshape(len(edges), -1)
    jacobian = jacobian - jacobian.mean(axis=0)
    variances = np.einsum("ei,ij,ej->e", jacobian, covariance, jacobian)
    return float(np.sqrt(np.maximum(variances, 0.0)).max())


def _compute_pose_errors(covariance: Float64, centers: Float64) -> Float64:
    """Return the median relative pose error (n,) of each frame in degrees."""
    num_frames = len(centers)
    blocks = covariance.reshape(num_frames, _POSE, num_frames, _POSE).transpose(0, 2, 1, 3)
    rows = np.arange(num_frames)
    own = blocks[rows, rows]
    errors = np.empty(num_frames)
    for frame in range(num_frames):
        others = np.delete(rows, frame)
        baselines = centers[others] - centers[frame]
        lengths = np.maximum(np.linalg.norm(baselines, axis=1), 1e-12)[:, None, None]
        directions = baselines[:, :, None] / lengths
        # A frame with the shift d moves its center by -d, and its rotation turns all directions.
        across = np.eye(3) - directions @ directions.transpose(0, 2, 1)
        turned = np.cross(np.eye(3)[None], directions.transpose(0, 2, 1)).transpose(0, 2, 1)
        by_frame = np.concatenate([turned, across / lengths], axis=2)
        by_other = np.concatenate([np.zeros_like(turned), -across / lengths], axis=2)
        turn = np.eye(3, _POSE)[None]
        squares = [
            _sum_variances(a, b, own[frame], blocks[frame, others], own[others])
            for a, b in ((turn, -turn), (by_frame, by_other))
        ]
        errors[frame] = np.median(np.sqrt(np.maximum(*squares)))
    bounded: Float64 = np.minimum(np.degrees(errors), MAX_ERROR_DEG)
    return bounded


def _sum_variances(
    by_a: Float64, by_b: Float64, cov_a: Float64, cov_ab: Float64, cov_b: Float64
) -> Float64:
    """Return the summed variances (m,) of ``by_a x_a + by_b x_b``, which has 3 coordinates."""
    parts = by_a @ cov_a @ by_a.swapaxes(1, 2) + by_b @ cov_b @ by_b.swapaxes(1, 2)
    parts = parts + 2 * (by_a @ cov_ab @ by_b.swapaxes(1, 2))
    variances: Float64 = np.maximum(np.trace(parts, axis1=1, axis2=2), 0.0)
    return variances


def _measure_depth_disagreement(
    frames: Sequence[Sequence[RegisteredImage]],
    points: Float64,
    problem: MappingProblem,
    edges: Int64,
) -> float:
    """Return the largest disagreement of depth between two frames with common points."""
    depths = [_compare_depth(frame, points, problem) for frame in frames]
    largest = 0.0
    for a, b in edges:
        (ids_a, errors_a, stds_a), (ids_b, errors_b, stds_b) = depths[a], depths[b]
        common, of_a, of_b = np.intersect1d(ids_a, ids_b, return_indices=True)
        if len(common) >= MIN_IMAGE_POINTS:
            differences = errors_a[of_a] - errors_b[of_b]
            ratios = differences / np.hypot(stds_a[of_a], stds_b[of_b])
            largest = max(largest, abs(float(np.median(ratios))))
    return largest


def _compare_depth(
    frame: Sequence[RegisteredImage], points: Float64, problem: MappingProblem
) -> tuple[Int64, Float64, Float64]:
    """Return the ids (m,) of the points with depth, and errors and std (m,) of their log depth."""
    ids, errors, stds = [], [], []
    for image in frame:
        depth_map = DepthMap(problem.images[image.index])
        seen = np.flatnonzero((image.point_ids >= 0) & depth_map.keypoint_valid)
        z = points[image.point_ids[seen]] @ image.rotation[2] + image.translation[2]
        prior = image.scale * depth_map.prior_at_keypoints(seen)
        std = depth_map.keypoint_log_std[seen]
        used = (z > 0) & (prior > 0) & (std > 0)
        ids.append(image.point_ids[seen[used]])
        errors.append(np.log(prior[used] / z[used]))
        stds.append(std[used])
    return np.concatenate(ids), np.concatenate(errors), np.concatenate(stds)


class _Observations:
    """Linearized observations of the points that at least two frames observe.

    A frame moves by a rotation vector ``w`` around its center and a shift ``d``, which changes a
    point ``X`` in the frame of a camera by ``R (w x (X - c) + d)``.
    """

    def __init__(
        self,
        frames: Sequence[Sequence[RegisteredImage]],
        centers: Float64,
        points: Float64,
        problem: MappingProblem,
    ) -> None:
        numbers, ids_of, by_points, by_poses, errors = [], [], [], [], []
        for number, image in ((n, image) for n, frame in enumerate(frames) for image in frame):
            seen = np.flatnonzero(image.point_ids >= 0)
            ids = image.point_ids[seen]
            keypoints = problem.images[image.index].keypoints[seen]
            by_point, residuals = _linearize(image, points[ids], keypoints)
            by_rotation = np.cross((points[ids] - centers[number])[:, None], by_point)
            numbers.append(np.full(len(ids), number))
            ids_of.append(ids)
            by_points.append(by_point)
            by_poses.append(np.concatenate([by_rotation, by_point], axis=2))
            errors.append(residuals)
        frame_of, ids = np.concatenate(numbers), np.concatenate(ids_of)
        pairs = np.unique(np.stack([ids, frame_of], axis=1), axis=0)
        num_frames = np.bincount(pairs[:, 0], minlength=len(points))
        used = num_frames[ids] > 1
        self.frame_of: Int64 = frame_of[used]
        self._pairs: Int64 = pairs[num_frames[pairs[:, 0]] > 1]
        _, self._point_of = np.unique(ids[used], return_inverse=True)
        self._by_point = np.concatenate(by_points)[used]
        self._by_pose = np.concatenate(by_poses)[used]
        self.num_frames = len(frames)
        redundancy = 2 * used.sum() - _POINT * len(np.unique(ids[used])) - _POSE * len(frames)
        self.std_px = float(np.sqrt((np.concatenate(errors)[used] ** 2).sum() / max(redundancy, 1)))

    def find_edges(self) -> Int64:
        """Return the pairs (e, 2) of frames with common points."""
        visible = csr_array(
            (np.ones(len(self._pairs)), (self._pairs[:, 1], self._pairs[:, 0])),
            shape=(self.num_frames, int(self._pairs[:, 0].max(initial=0)) + 1),
        )
        shared = (visible @ visible.T).toarray()
        return np.argwhere(np.triu(shared, 1) >= MIN_IMAGE_POINTS)

    def compute_information(self) -> Float64:
        """Return the information matrix (6n, 6n) of the frames after eliminating the points."""
        num_points = int(self._point_of.max()) + 1
        hessians = np.zeros((num_points, _POINT, _POINT))
        by_point = self._by_point
        np.add.at(hessians, self._point_of, np.einsum("mki,mkj->mij", by_point, by_point))
        damping = 1e-9 * np.trace(hessians, axis1=1, axis2=2)[:, None, None] * np.eye(_POINT)
        factors = np.linalg.cholesky(np.linalg.inv(hessians + damping)).transpose(0, 2, 1)
        coupling = np.einsum("mki,mkj->mij", by_point, self._by_pose)
        coupling = factors[self._point_of] @ coupling
        order = np.lexsort((self.frame_of, self._point_of))
        pointers = np.concatenate([[0], np.cumsum(np.bincount(self._point_of))])
        matrix = bsr_array(
            (coupling[order], self.frame_of[order], pointers),
            shape=(_POINT * num_points, _POSE * self.num_frames),
        ).tocsr()
        own = np.zeros((self.num_frames, _POSE, _POSE))
        np.add.at(own, self.frame_of, np.einsum("mki,mkj->mij", self._by_pose, self._by_pose))
        information: Float64 = -(matrix.T @ matrix).toarray()
        for number in range(self.num_frames):
            block = slice(_POSE * number, _POSE * (number + 1))
            information[block, block] += own[number]
        return information


def _linearize(image: RegisteredImage, points: Float64, xy: Float64) -> tuple[Float64, Float64]:
    """Return derivatives (m, 2, 3) of pixels by points in the world frame, and residuals (m, 2)."""
    x, y, z = (points @ image.rotation.T + image.translation).T
    z = np.maximum(z, 1e-9)
    camera, zero = image.camera, np.zeros_like(z)
    derivative = np.stack(
        [camera.fx / z, zero, -camera.fx * x / z**2, zero, camera.fy / z, -camera.fy * y / z**2],
        axis=1,
    ).reshape(-1, 2, 3)
    pixels = np.stack([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy], axis=1)
    return derivative @ image.rotation, pixels - xy


def _find_gauge(centers: Float64) -> Float64:
    """Return an orthonormal basis (6n, 7) of the gauge freedom of the poses.

    Rotations, shifts and scalings of the whole model change no reprojection error.
    """
    spread = max(float(np.ptp(centers, axis=0).max()), 1e-12)
    offsets = centers - centers.mean(axis=0)
    gauge = np.zeros((len(centers), _POSE, 7))
    gauge[:, :3, :3] = np.eye(3)
    gauge[:, 3:, :3] = np.cross(np.eye(3)[None], offsets[:, None]).transpose(0, 2, 1)
    gauge[:, 3:, 3:6] = spread * np.eye(3)
    gauge[:, 3:, 6] = offsets
    basis: Float64 = np.linalg.qr(gauge.reshape(-1, 7))[0]
    return basis
