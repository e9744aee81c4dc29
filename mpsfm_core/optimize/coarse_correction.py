"""Coarse correction of the preconditioner for the reduced camera system of many poses.

Conjugate gradients with a block-Jacobi preconditioner take hundreds of iterations for errors that
many neighboring poses have in common, such as drift. The coarse correction solves for one
similarity transform of each cluster of nearby cameras, and is added to the block-Jacobi
preconditioner (Konolige and Brown, "Multigrid for Bundle Adjustment", 2020, with two levels).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy.linalg import LinAlgError, cho_factor, cho_solve
from scipy.sparse import bsr_array

from mpsfm_core.data import Bool, Float64, Int64
from mpsfm_core.geometry import camera_center
from mpsfm_core.optimize.bundle_kernels import LOG_SCALE_IDX, NUM_IMAGE_PARAMS
from mpsfm_core.support import jit

MIN_CLUSTER_POSES = 20
"""Minimum number of poses of a cluster. [tuned: benchmarks.scale]"""
MAX_CLUSTERS = 128
"""Maximum number of clusters, which limits the time of a dense factorization. [tuned:
benchmarks.scale]"""
MIN_PIVOT = 1e-10
"""Damping of the coarse system, relative to its diagonal. [ours]"""


class Clusters(NamedTuple):
    """Clusters of nearby cameras."""

    cluster_of: Int64
    """(s,) cluster of each pose."""
    num_clusters: int
    """Number of clusters."""

    @classmethod
    def of_cameras(cls, centers: Float64) -> Clusters:
        """Split camera centers (s, 3) at medians of their widest axis into 2^k clusters."""
        clusters = [np.arange(len(centers))]
        while len(clusters) < MAX_CLUSTERS:
            if len(centers) < 2 * len(clusters) * MIN_CLUSTER_POSES:
                break
            halves = []
            for rows in clusters:
                axis = np.argmax(np.ptp(centers[rows], axis=0))
                order = np.argsort(centers[rows, axis], kind="stable")
                halves += np.array_split(rows[order], 2)
            clusters = halves
        cluster_of = np.zeros(len(centers), dtype=np.int64)
        for cluster, rows in enumerate(clusters):
            cluster_of[rows] = cluster
        return cls(cluster_of, len(clusters))


class CoarseSpace(NamedTuple):
    """Steps of poses that move clusters of cameras by similarity transforms."""

    clusters: Clusters
    modes: Float64
    """(s, 7, 7) step of each pose for rotation, translation and log scale of its cluster."""

    @classmethod
    def build(
        cls, clusters: Clusters, rotations: Float64, translations: Float64, held: Bool
    ) -> CoarseSpace:
        """Build the steps of poses for similarity transforms of clusters.

        Args:
            clusters: Clusters of the cameras.
            rotations: (s, 3, 3) ``cam_from_world``.
            translations: (s, 3) ``cam_from_world``.
            held: (s, 7) mask of the constant parameters of each pose.
        """
        cluster_of, num_clusters = clusters
        centroids = np.zeros((num_clusters, 3))
        np.add.at(centroids, cluster_of, camera_center(rotations, translations))
        centroids /= np.bincount(cluster_of, minlength=num_clusters)[:, None]
        centroid = centroids[cluster_of]
        modes = np.zeros((len(rotations), NUM_IMAGE_PARAMS, NUM_IMAGE_PARAMS))
        modes[:, :3, :3] = modes[:, 3:6, 3:6] = -rotations
        modes[:, 3:6, :3] = -np.cross(rotations, centroid[:, None])
        modes[:, 3:6, 6] = np.einsum("nab,nb->na", rotations, centroid) + translations
        modes[:, LOG_SCALE_IDX, 6] = 1.0
        modes[held] = 0.0
        return cls(clusters, modes)

    def project(
        self, blocks: Float64, pairs: Int64, diagonal: Float64
    ) -> Callable[[Float64], Float64]:
        """Project a reduced camera system on the coarse space, and factorize it.

        Args:
            blocks: (b, 7, 7) blocks of pairs of poses; those of single poses are not used.
            pairs: (b, 2) poses of each block.
            diagonal: (s, 7, 7) damped blocks of single poses.

        Returns:
            Function from a residual (7 s,) to its coarse correction (7 s,), which is 0 if the
            projected system is singular.
        """
        cluster_of, num_clusters = self.clusters
        size = self.modes.shape[-1] * num_clusters
        matrix = np.zeros((size, size))
        _project_blocks(blocks, pairs, diagonal, self.modes, cluster_of, matrix)
        pivots = np.diagonal(matrix)
        matrix[np.diag_indices(size)] += np.where(pivots > 0, MIN_PIVOT * pivots, 1.0)
        try:
            factor = cho_factor(matrix, lower=True, overwrite_a=True, check_finite=False)
        except LinAlgError:
            return np.zeros_like

        starts = np.arange(len(cluster_of) + 1)
        basis = bsr_array(
            (self.modes, cluster_of, starts), shape=(NUM_IMAGE_PARAMS * len(cluster_of), size)
        )
        transposed = basis.T

        def correct(residual: Float64) -> Float64:
            coarse = cho_solve(factor, transposed @ residual, check_finite=False)
            correction: Float64 = basis @ coarse
            return correction

        return correct


@jit.kernel()
def _project_blocks(
    blocks: Float64,
    pairs: Int64,
    diagonal: Float64,
    modes: Float64,
    cluster_of: Int64,
    out: Float64,
) -> None:
    """Add ``modes[i].T @ block @ modes[j]`` of all blocks and their transposes to ``out``."""
    size = modes.shape[-1]
    product = np.empty((size, size))
    for n in range(len(pairs) + len(diagonal)):
        is_pair = n < len(pairs)
        i, j = (pairs[n, 0], pairs[n, 1]) if is_pair else (n - len(pairs), n - len(pairs))
        if is_pair and i == j:
            continue
        for a in range(size):
            for b in range(size):
                value = 0.0
                for c in range(size):
                    entry = blocks[n, a, c] if is_pair else diagonal[i, a, c]
                    value += entry * modes[j, c, b]
                product[a, b] = value
        row, column = size * cluster_of[i], size * cluster_of[j]
        for a in range(size):
            for b in range(size):
                value = 0.0
                for c in range(size):
                    value += modes[i, c, a] * product[c, b]
                out[row + a, column + b] += value
                if is_pair:
                    out[column + b, row + a] += value
