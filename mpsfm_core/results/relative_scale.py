"""Measure how well matches alone determine the distances between the frames of rigs.

Two panoramas in different rooms share points that are seen through a door. These points determine
the direction of the baseline. The ratio of this baseline to others follows from points that three
frames see, or from depth priors. The covariance of bundle adjustment without depth priors shows
which of both is the case.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.sparse import bsr_array, csr_array

from mpsfm_core.data import Float64, Int64, MappingProblem
from mpsfm_core.geometry import camera_center
from mpsfm_core.mapping.scene.reconstruction import RegisteredImage

MIN_SHARED_POINTS = 3
"""Minimum number of common 3D points of two frames whose distance is judged. [minimal sample of
PnP]"""
MAX_FRAMES = 300
"""Maximum number of frames, because the run time is cubic in the number of frames. [ours]"""
_POSE, _POINT = 6, 3


def measure_relative_scale_std(
    frames: Sequence[Sequence[RegisteredImage]], points: Float64, problem: MappingProblem
) -> float | None:
    """Return the largest relative std of a distance between two frames, from matches alone.

    The covariance is the inverse of the Gauss-Newton matrix of reprojection errors after the Schur
    complement of the points. Keypoint noise is estimated from the residuals. The gauge, which
    includes the scale, is fixed by the mean of all distances.

    Args:
        frames: Registered images of each frame.
        points: (p, 3) 3D points in world units.
        problem: Mapping problem with the keypoints of the images.

    Returns:
        Standard deviation of the distance of two frames with common points, relative to the larger
        of this distance and the median distance. None for fewer than two such distances or more
        than :data:`MAX_FRAMES` frames.
    """
    if not 2 < len(frames) <= MAX_FRAMES:
        return None
    centers = np.array([camera_center(f[0].rotation, f[0].translation) for f in frames])
    observations = _Observations(frames, centers, points, problem)
    edges = observations.find_edges()
    if len(edges) < 2:
        return None
    baselines = centers[edges[:, 0]] - centers[edges[:, 1]]
    lengths = np.linalg.norm(baselines, axis=1)
    references = np.maximum(lengths, np.median(lengths))
    directions = baselines / np.maximum(lengths, 1e-12)[:, None] / references[:, None]
    by_frame = np.zeros((len(edges), len(frames), _POSE))
    rows = np.arange(len(edges))
    by_frame[rows, edges[:, 0], 3:], by_frame[rows, edges[:, 1], 3:] = directions, -directions
    jacobian = by_frame.reshape(len(edges), -1)
    jacobian = jacobian - jacobian.mean(axis=0)
    information = observations.compute_information()
    gauge = _find_gauge(centers)
    covariance = np.linalg.inv(information + np.diagonal(information).max() * gauge @ gauge.T)
    variances = np.einsum("ei,ij,ej->e", jacobian, covariance, jacobian)
    return float(observations.std_px * np.sqrt(np.maximum(variances, 0.0)).max())


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
        return np.argwhere(np.triu(shared, 1) >= MIN_SHARED_POINTS)

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
