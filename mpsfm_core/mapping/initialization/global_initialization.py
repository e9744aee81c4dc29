"""Global initialization of well-connected images from relative poses and depth.

1. Measure the baseline length of each verified pair from depth. Pairs whose triangulated points do
   not fit the depth prior get a low weight, because planar scenes have a second, wrong relative
   pose.
2. Keep the largest component of the view graph whose edges are on cycles. An edge of the view graph
   on no cycle cannot be verified by other pairs.
3. Average the relative rotations by IRLS with a Cauchy loss.
4. Solve for the scales of the depth priors, then for the camera centers. Depth scales and camera
   centers are the solutions of linear least-squares problems, solved by IRLS with a Cauchy loss.
   A prior keeps the scales of metric depth maps similar. Without it, depth errors that grow with
   the distance would add up along the path of the camera.
   IRLS starts from the edges on cycles of three or four images, because a few wrong edges between
   distant images would bend the first solution of a large view graph.
5. Remove the image pairs that disagree with the estimated poses, and return the poses of the
   largest component that remains.

Images without a global pose are registered incrementally.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from scipy.sparse import coo_matrix, csr_array
from scipy.sparse.csgraph import (
    breadth_first_order,
    connected_components,
    minimum_spanning_tree,
)
from scipy.sparse.linalg import splu
from scipy.spatial.transform import Rotation

from mpsfm_core.data import Bool, Float64, Int64, VerifiedPair
from mpsfm_core.geometry import camera_center, rotation_angle_deg, triangulation_angle_deg
from mpsfm_core.geometry.statistics import MAD_TO_STD, group_medians
from mpsfm_core.mapping.scene.graph import BLOCK_MATCHES
from mpsfm_core.mapping.scene.scene import Scene
from mpsfm_core.mapping.triangulation import triangulate_midpoints

MIN_ANGLE_DEG = 1.5
"""Smallest triangulation angle of a match that measures the baseline of a pair. [COLMAP
min_angle]"""
MIN_MATCHES = 10
"""Minimum number of matches with a triangulation angle above ``MIN_ANGLE_DEG`` for a pair to be
used in global initialization. [ours]"""
MAX_ROTATION_ERROR_DEG = 5.0
"""Maximum angle between the measured and the estimated relative rotation of an image pair.
[ours]"""
MAX_CENTER_ERROR = 0.3
"""Maximum distance between the measured and the estimated relative camera center of a pair,
relative to its baseline, with a margin for direction errors of several degrees. [ours]
"""
PLANAR_WEIGHT = 0.1
"""Weight of each match of a pair that a homography also explains, because a planar scene has two
possible relative poses. [tuned: benchmarks.accuracy on rendered_kitchen]
"""
UNCONFIRMED_WEIGHT = 1e-3
"""First IRLS weight of a pair on no cycle of three or four images, relative to the weight of other
pairs. [tuned: benchmarks.scale on streets]"""
NUM_ITERATIONS = 20
"""Number of IRLS iterations of rotation averaging and of the linear solvers. [ours]"""
DAMPING = 1e-9
"""Damping that fixes the gauge of the view graph's Laplacian, relative to its largest entry."""


class GlobalPoses(NamedTuple):
    """Poses of the images of one component, estimated by global initialization."""

    images: Int64
    """(m,) indices of the images of the component."""
    rotations: Float64
    """(m, 3, 3) rotations ``cam_from_world``."""
    translations: Float64
    """(m, 3) translations ``cam_from_world``."""
    scales: Float64
    """(m,) scales of the depth priors, in world units per unit of the prior."""


class _RelativePoses(NamedTuple):
    """Measured relative poses of m image pairs."""

    a: Int64
    """(m,) index of the first image of each pair."""
    b: Int64
    """(m,) index of the second image of each pair."""
    rotation: Float64
    """(m, 3, 3) relative rotations ``b_from_a``."""
    translation: Float64
    """(m, 3) relative translations ``b_from_a``, of length 1."""
    log_length: Float64
    """(m, 2) log length of the baseline in the units of the depth priors of ``a`` and ``b``."""
    weight: Float64
    """(m,) number of matches of each pair, reduced if depth priors do not fit the triangulated
    points.
    """

    def select(self, rows: Bool) -> _RelativePoses:
        """Return the relative poses of the image pairs that ``rows`` (m,) selects."""
        fields: list[Any] = [values[rows] for values in self]
        return _RelativePoses(*fields)


def estimate_global_poses(scene: Scene, candidates: Bool) -> GlobalPoses | None:
    """Estimate the poses of the largest component of consistent image pairs.

    Args:
        scene: The scene with its verified pairs, which stays unchanged.
        candidates: (n,) bool mask of the images that may be registered.

    Returns:
        Image poses, or None if no pairs are consistent along cycles of the view graph.
    """
    pairs = [p for p in scene.problem.pairs if candidates[p.image_a] and candidates[p.image_b]]
    num_images = scene.num_images
    edges = _measure_relative_poses(scene, pairs)
    edges = edges.select(_select_largest_cyclic_component(edges, num_images))
    if not len(edges.a):
        return None
    is_confirmed = find_short_cycle_edges(edges.a, edges.b, num_images)
    rotations = average_rotations(
        edges.a, edges.b, edges.rotation, edges.weight, num_images, is_confirmed
    )
    first_weights = np.where(is_confirmed, 1.0, UNCONFIRMED_WEIGHT)
    log_ratios = edges.log_length[:, 0] - edges.log_length[:, 1]
    group = scene.depth_group_of  # depth priors of one depth group share a scale
    is_metric = np.array([depth_map.prior.metric for depth_map in scene.maps])
    num_metric = np.bincount(group[is_metric], minlength=num_images)
    group_log_scales = average_differences(
        group[edges.a],
        group[edges.b],
        log_ratios,
        edges.weight,
        num_images,
        first_weights,
        float(np.median(edges.weight)) * num_metric.astype(np.float64),
    )
    log_scales = group_log_scales[group]
    lengths = np.exp((log_scales[edges.a] + log_scales[edges.b] + edges.log_length.sum(axis=1)) / 2)
    baselines = -np.einsum("nji,nj->ni", rotations[edges.b], edges.translation) * lengths[:, None]
    centers = average_differences(
        edges.a, edges.b, baselines, edges.weight / lengths, num_images, first_weights
    )
    relative = rotations[edges.b] @ rotations[edges.a].transpose(0, 2, 1)
    rotation_errors_deg = rotation_angle_deg(relative.transpose(0, 2, 1) @ edges.rotation)
    center_errors = np.linalg.norm(centers[edges.b] - centers[edges.a] - baselines, axis=1)
    is_consistent = rotation_errors_deg <= MAX_ROTATION_ERROR_DEG
    is_consistent &= center_errors / lengths <= MAX_CENTER_ERROR
    edges = edges.select(is_consistent)
    edges = edges.select(_select_largest_cyclic_component(edges, num_images))
    images = np.unique(np.concatenate([edges.a, edges.b]))
    if not len(images):
        return None
    translations = -np.einsum("nij,nj->ni", rotations[images], centers[images])
    return GlobalPoses(images, rotations[images], translations, np.exp(log_scales[images]))


def average_rotations(
    a: Int64,
    b: Int64,
    b_from_a: Float64,
    weights: Float64,
    num_images: int,
    is_confirmed: Bool,
) -> Float64:
    """Average relative rotations by IRLS in the tangent space with a Cauchy loss.

    The rotations are averaged by IRLS as in Chatterjee and Govindu, Efficient and Robust
    Large-Scale Rotation Averaging, ICCV 2013, but with a Cauchy loss. The maximum spanning tree
    gives the initial rotations, in which edges on no short cycle only connect the parts of the
    tree. The edges of the view graph must form one connected component.

    Args:
        a: (m,) index of the first image of each view-graph edge.
        b: (m,) index of the second image of each view-graph edge.
        b_from_a: (m, 3, 3) relative rotations ``R[b] @ R[a].T``.
        weights: (m,) weight of each graph edge.
        num_images: Number of images.
        is_confirmed: (m,) bool mask of the edges that the tree prefers, see
            :func:`find_short_cycle_edges`.

    Returns:
        (num_images, 3, 3) rotations ``cam_from_world``.
    """
    costs = 1 / weights
    costs += costs.max() * ~is_confirmed
    rotations = _chain_rotations(a, b, b_from_a, costs, num_images)
    for _ in range(NUM_ITERATIONS):
        residuals = rotations[b].transpose(0, 2, 1) @ b_from_a @ rotations[a]
        rotvecs = -Rotation.from_matrix(residuals).as_rotvec()
        robust_weights = _cauchy_weights(np.linalg.norm(rotvecs, axis=1))
        updates = _solve_differences(a, b, rotvecs, weights * robust_weights, num_images)
        rotations = rotations @ Rotation.from_rotvec(-updates).as_matrix()
    return rotations


def average_differences(
    a: Int64,
    b: Int64,
    differences: Float64,
    weights: Float64,
    num_nodes: int,
    first_weights: Float64,
    prior_weights: Float64 | float = 0.0,
) -> Float64:
    """Solve ``x[b] - x[a] = differences`` for node values ``x`` by IRLS with a Cauchy loss.

    Args:
        a: (m,) index of the first node of each graph edge.
        b: (m,) index of the second node of each graph edge.
        differences: (m, ...) measured differences ``x[b] - x[a]``.
        weights: (m,) weight of each graph edge.
        num_nodes: Number of nodes.
        first_weights: (m,) weights that replace those of the loss in the first iteration.
        prior_weights: (num_nodes,) weights of the prior ``x = 0`` of the nodes.

    Returns:
        (num_nodes, ...) node values with mean 0. All graph nodes without edges share one value.
    """
    measured = differences.reshape(len(differences), -1)
    robust_weights = first_weights
    for _ in range(NUM_ITERATIONS):
        values = _solve_differences(
            a, b, measured, weights * robust_weights, num_nodes, prior_weights
        )
        errors = np.linalg.norm(values[b] - values[a] - measured, axis=1)
        robust_weights = _cauchy_weights(errors)
    values -= values.mean(axis=0)
    return values.reshape(num_nodes, *differences.shape[1:])


def _solve_differences(
    a: Int64,
    b: Int64,
    differences: Float64,
    weights: Float64,
    num_nodes: int,
    prior_weights: Float64 | float = 0.0,
) -> Float64:
    """Solve for node values (n, d) with a prior by weighted linear least squares."""
    ends = np.concatenate([a, b])
    degree = np.bincount(ends, np.concatenate([weights, weights]), minlength=num_nodes)
    diagonal = degree + DAMPING * degree.max() + prior_weights
    nodes = np.arange(num_nodes)
    entries = np.concatenate([-weights, -weights, diagonal])
    rows_and_columns = np.concatenate([a, b, nodes]), np.concatenate([b, a, nodes])
    laplacian = coo_matrix((entries, rows_and_columns), shape=(num_nodes, num_nodes)).tocsc()
    right_side = np.zeros((num_nodes, differences.shape[1]))
    np.add.at(right_side, b, weights[:, None] * differences)
    np.add.at(right_side, a, -weights[:, None] * differences)
    values: Float64 = splu(laplacian).solve(right_side)
    return values


def _cauchy_weights(errors: Float64) -> Float64:
    """Return IRLS weights of a Cauchy loss with the robust standard deviation as its scale."""
    scale = max(MAD_TO_STD * float(np.median(errors)), 1e-12)
    weights: Float64 = 1 / (1 + (errors / scale) ** 2)
    return weights


def _chain_rotations(
    a: Int64, b: Int64, b_from_a: Float64, costs: Float64, num_images: int
) -> Float64:
    """Chain relative rotations along the minimum spanning tree of the view graph.

    One wrong edge in the tree rotates a whole part, from which the robust loss cannot recover.
    Edges that may be wrong should therefore have higher costs (m,) than all other edges.
    """
    graph = coo_matrix((costs, (a, b)), shape=(num_images, num_images)).tocsr()
    tree = minimum_spanning_tree(graph)
    order, parents = breadth_first_order(tree, int(a[0]), directed=False)
    relative = {
        (int(i), int(j)): j_from_i
        for image_a, image_b, rotation in zip(a, b, b_from_a, strict=True)
        for i, j, j_from_i in ((image_a, image_b, rotation), (image_b, image_a, rotation.T))
    }
    rotations = np.tile(np.eye(3), (num_images, 1, 1))
    for image in map(int, order[1:]):
        parent = int(parents[image])
        rotations[image] = relative[parent, image] @ rotations[parent]
    return rotations


def _measure_relative_poses(scene: Scene, pairs: list[VerifiedPair]) -> _RelativePoses:
    """Measure the baseline of each image pair by the depth priors of both images.

    The median absolute deviation from the log baseline gives the Cauchy weight of the pair.
    """
    a = np.array([pair.image_a for pair in pairs], dtype=np.int64)
    b = np.array([pair.image_b for pair in pairs], dtype=np.int64)
    rotation = np.array([pair.rotation for pair in pairs]).reshape(-1, 3, 3)
    translation = np.array([pair.translation for pair in pairs]).reshape(-1, 3)
    translation = translation / np.maximum(np.linalg.norm(translation, axis=1), 1e-12)[:, None]
    log_lengths, deviations = np.zeros((len(pairs), 2)), np.zeros(len(pairs))
    counts = np.zeros(len(pairs), dtype=np.int64)
    num_blocks = 1 + sum(map(len, pairs)) // BLOCK_MATCHES
    for rows in np.array_split(np.arange(len(pairs)), num_blocks):
        block = [pairs[row] for row in rows.tolist()]
        measured = _measure_log_baselines(scene, block, rotation[rows], translation[rows])
        log_lengths[rows], deviations[rows], counts[rows] = measured
    weight = np.array([len(p) * (1.0 if p.calibrated else PLANAR_WEIGHT) for p in pairs])
    is_measured = counts >= MIN_MATCHES
    if is_measured.any():
        weight[is_measured] *= _cauchy_weights(deviations[is_measured])
    return _RelativePoses(a, b, rotation, translation, log_lengths, weight).select(is_measured)


def _measure_log_baselines(
    scene: Scene, pairs: list[VerifiedPair], rotation: Float64, translation: Float64
) -> tuple[Float64, Float64, Int64]:
    """Measure log baselines as the medians of ``log(depth prior / triangulated depth)``.

    Args:
        scene: The scene.
        pairs: The m image pairs.
        rotation: (m, 3, 3) relative rotations ``b_from_a``.
        translation: (m, 3) relative translations ``b_from_a``, of length 1.

    Returns:
        Log baselines (m, 2) by the depth priors of ``a`` and ``b``, their median absolute
        deviations (m,), and numbers (m,) of usable matches.
    """
    empty = np.zeros(0, np.int64)
    pair_of = np.repeat(np.arange(len(pairs)), [len(pair) for pair in pairs])
    offsets = scene.graph.offsets
    source = np.concatenate([empty, *(p.matches[:, 0] + offsets[p.image_a] for p in pairs)])
    target = np.concatenate([empty, *(p.matches[:, 1] + offsets[p.image_b] for p in pairs)])
    centers = camera_center(rotation, translation)[pair_of]
    rays_b = np.einsum("nji,nj->ni", rotation[pair_of], scene.rays(target))
    points = triangulate_midpoints(np.zeros_like(rays_b), scene.rays(source), centers, rays_b)
    z_a = points[:, 2]
    z_b = np.einsum("nj,nj->n", rotation[pair_of, 2], points) + translation[pair_of, 2]
    with np.errstate(invalid="ignore", divide="ignore"):
        angles_deg = triangulation_angle_deg(np.zeros_like(centers), centers, points)
        usable = (angles_deg >= MIN_ANGLE_DEG) & (z_a > 0) & (z_b > 0)
        usable &= scene.keypoint_valid[source] & scene.keypoint_valid[target]
        log_ratios = np.log(
            np.stack([scene.keypoint_prior[source] / z_a, scene.keypoint_prior[target] / z_b])
        )
    log_lengths = np.stack(
        [group_medians(ratios[usable], pair_of[usable], len(pairs)) for ratios in log_ratios],
        axis=1,
    )
    deviations = np.max(np.abs(log_ratios - log_lengths[pair_of].T), axis=0)
    pair_deviations = group_medians(deviations[usable], pair_of[usable], len(pairs))
    return log_lengths, pair_deviations, np.bincount(pair_of[usable], minlength=len(pairs))


def _select_largest_cyclic_component(edges: _RelativePoses, num_images: int) -> Bool:
    """Return a mask (m,) of the edges on cycles in the largest component of such edges.

    An edge of the view graph that is on no cycle cannot be verified by other edges.
    """
    selected = find_cycle_edges(edges.a, edges.b, num_images)
    if selected.any():
        ends = np.concatenate([edges.a[selected], edges.b[selected]])
        label = label_components(edges.a[selected], edges.b[selected], num_images)
        sizes = np.bincount(label[np.unique(ends)])
        selected &= label[edges.a] == sizes.argmax()
    return selected


def find_cycle_edges(a: Int64, b: Int64, num_nodes: int) -> Bool:
    """Find the edges of a graph that are not bridges, by random labels on the cycle space.

    Each edge outside of a spanning forest has a random label, which is added by XOR along the cycle
    that the edge closes. A forest edge is a bridge if its accumulated label is 0.

    Args:
        a: (m,) index of the first node of each graph edge.
        b: (m,) index of the second node of each graph edge. No pair of graph nodes may occur twice.
        num_nodes: Number of nodes.

    Returns:
        (m,) bool mask of the graph edges on a cycle.
    """
    root = num_nodes  # an extra root node joins the spanning trees of all components
    component_nodes = np.unique(label_components(a, b, num_nodes), return_index=True)[1]
    first = np.concatenate([a, component_nodes])
    second = np.concatenate([b, np.full(len(component_nodes), root)])
    graph = coo_matrix((np.ones(len(first)), (first, second)), shape=(num_nodes + 1,) * 2)
    order, parents = breadth_first_order(graph.tocsr(), root, directed=False)
    first_is_child = parents[first] == second
    in_tree = first_is_child | (parents[second] == first)
    labels = np.random.default_rng(0).integers(1, np.iinfo(np.int64).max, len(first))
    node_labels = np.zeros(num_nodes + 1, dtype=np.int64)
    for ends in (first, second):
        np.bitwise_xor.at(node_labels, ends[~in_tree], labels[~in_tree])
    for node in order[:0:-1]:
        node_labels[parents[node]] ^= node_labels[node]
    child = np.where(first_is_child, first, second)
    on_cycle: Bool = ~in_tree | (node_labels[child] != 0)
    return on_cycle[: len(a)]


def find_short_cycle_edges(a: Int64, b: Int64, num_nodes: int) -> Bool:
    """Find the edges of a graph that are on a cycle of three or four nodes.

    An edge of the view graph on no such cycle is often a wrong pair of images that look alike.

    Args:
        a: (m,) index of the first node of each graph edge.
        b: (m,) index of the second node of each graph edge. No pair of graph nodes may occur twice.
        num_nodes: Number of nodes.

    Returns:
        (m,) bool mask of the graph edges on a short cycle.
    """
    ends = np.concatenate([a, b]), np.concatenate([b, a])
    links = csr_array((np.ones(2 * len(a)), ends), shape=(num_nodes, num_nodes))
    degree = np.bincount(ends[0], minlength=num_nodes)
    walks_2 = csr_array(links @ links)
    on_cycle: Bool = np.asarray(walks_2[a, b]).ravel() > 0
    a, b = a[~on_cycle], b[~on_cycle]
    num_walks_3 = walks_2[a].multiply(links[b]).sum(axis=1)
    on_cycle[~on_cycle] = num_walks_3 > degree[a] + degree[b] - 1  # walks that repeat the edge a-b
    return on_cycle


def label_components(a: Int64, b: Int64, num_nodes: int) -> Int64:
    """Label the connected components of a graph, and return the label of each node."""
    matrix = coo_matrix((np.ones(len(a)), (a, b)), shape=(num_nodes, num_nodes))
    labels: Int64 = connected_components(matrix, directed=False)[1]
    return labels
