"""Tests of the coarse correction against finite differences and dense linear algebra."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mpsfm_core.optimize import coarse_correction
from mpsfm_core.optimize.coarse_correction import Clusters, CoarseSpace

STEP = 1e-6


def make_poses(count: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    rotations = Rotation.from_rotvec(rng.normal(0, 1, (count, 3))).as_matrix()
    return rotations, rng.normal(0, 5, (count, 3))


def make_system(count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return blocks, pairs, diagonal blocks, and the dense positive definite matrix."""
    rng = np.random.default_rng(1)
    factor = rng.normal(0, 1, (7 * count, 7 * count))
    dense = factor @ factor.T + np.eye(7 * count)
    all_blocks = dense.reshape(count, 7, count, 7).transpose(0, 2, 1, 3)
    pairs = np.stack(np.triu_indices(count), axis=1)
    blocks = all_blocks[pairs[:, 0], pairs[:, 1]].copy()
    diagonal = all_blocks[np.arange(count), np.arange(count)].copy()
    blocks[pairs[:, 0] == pairs[:, 1]] = np.nan  # those of single poses are not used
    return blocks, pairs, diagonal, dense


def build_space(count: int, held: np.ndarray | None = None) -> CoarseSpace:
    rotations, translations = make_poses(count)
    centers = -np.einsum("nji,nj->ni", rotations, translations)
    held = np.zeros((count, 7), dtype=np.bool_) if held is None else held
    return CoarseSpace.build(Clusters.of_cameras(centers), rotations, translations, held)


def expand(space: CoarseSpace) -> np.ndarray:
    """Return the prolongation (7 s, 7 c), by which steps of c clusters move s poses."""
    cluster_of, num_clusters = space.clusters
    matrix = np.zeros((len(cluster_of), 7, num_clusters, 7))
    matrix[np.arange(len(cluster_of)), :, cluster_of] = space.modes
    return matrix.reshape(7 * len(cluster_of), 7 * num_clusters)


@pytest.mark.parametrize("mode", range(7))
def test_modes_move_cameras_by_a_similarity_transform(mode: int) -> None:
    """If points move with the cameras, their camera coordinates change only by the scale."""
    rotations, translations = make_poses(4)
    space = build_space(4)
    assert space.clusters.num_clusters == 1
    step = STEP * space.modes[:, :, mode]
    moved = Rotation.from_rotvec(step[:, :3]).as_matrix() @ rotations
    centers = -np.einsum("nji,nj->ni", rotations, translations)
    centroid = centers.mean(axis=0)
    rotation = Rotation.from_rotvec(STEP * np.eye(7)[mode, :3]).as_matrix()
    scale = np.exp(STEP * np.eye(7)[mode, 6])
    point = np.array([0.3, -2.0, 1.0])
    shift = centroid + STEP * np.eye(7)[mode, 3:6]
    moved_point = scale * rotation @ (point - centroid) + shift
    before = rotations @ point + translations
    after = moved @ moved_point + translations + step[:, 3:6]
    np.testing.assert_allclose(after, before * np.exp(step[:, 6:]), atol=1e-10)
    assert np.abs(step).max() > 0.1 * STEP


def test_correction_solves_the_projected_system(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(coarse_correction, "MIN_CLUSTER_POSES", 3)
    held = np.zeros((17, 7), dtype=np.bool_)
    held[0], held[5, 6] = True, True
    space = build_space(17, held)
    assert space.clusters.num_clusters == 4
    blocks, pairs, diagonal, dense = make_system(17)
    residual = np.random.default_rng(2).normal(0, 1, 7 * 17)
    basis = expand(space)
    expected = basis @ np.linalg.solve(basis.T @ dense @ basis, basis.T @ residual)
    correction = space.project(blocks, pairs, diagonal)(residual)
    np.testing.assert_allclose(correction, expected, rtol=1e-6, atol=1e-8)
    assert (correction.reshape(-1, 7)[held] == 0).all()


def test_constant_clusters_and_singular_systems_get_no_correction() -> None:
    blocks, pairs, diagonal, _ = make_system(4)
    constant = build_space(4, np.ones((4, 7), dtype=np.bool_))
    assert (constant.project(blocks, pairs, diagonal)(np.ones(28)) == 0).all()
    indefinite = build_space(4).project(-blocks, pairs, -diagonal)
    assert (indefinite(np.ones(28)) == 0).all()


def test_clusters_are_compact_and_of_similar_size() -> None:
    centers = np.random.default_rng(0).uniform(0, [40, 10, 1], (700, 3))
    clusters = Clusters.of_cameras(centers)
    sizes = np.bincount(clusters.cluster_of)
    assert clusters.num_clusters == len(sizes) == 32
    assert sizes.min() >= 20 and np.ptp(sizes) <= 1
    spreads = [np.ptp(centers[clusters.cluster_of == n, :2], axis=0).max() for n in range(32)]
    assert max(spreads) < 8
