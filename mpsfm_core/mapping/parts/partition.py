"""Partition of the match graph into overlapping parts.

1. Edges on no cycle of three or four images are removed, unless they connect the graph (maximum
   spanning forest). An edge on no such cycle is often a wrong pair of images that look alike.
2. Each connected component is cut in two (recursive spectral bisection) until no cluster has more
   images than the limit. A cut minimizes the number of matches across the cut among the prefixes of
   the images in the order of the Fiedler vector of the normalized Laplacian (Shi and Malik 2000).
3. Each cluster is extended by the images of adjacent clusters with which it has the most matches.

Images of one frame of a rig are never separated.
"""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_array, csr_array, diags_array, eye_array, triu
from scipy.sparse.csgraph import connected_components, minimum_spanning_tree
from scipy.sparse.linalg import eigsh

from mpsfm_core.data import Bool, Float64, Int64, MappingProblem
from mpsfm_core.mapping.initialization.global_initialization import find_short_cycle_edges
from mpsfm_core.mapping.scene.rig_frames import RigFrames

OVERLAP = 0.1
"""Number of images that extend a cluster, relative to the size of the cluster. [COLMAP
image_overlap / leaf_max_num_images]"""
MIN_COMMON_FRAMES = 5
"""Number of frames that a cluster takes from each adjacent cluster, if so many match. [ours]"""
MIN_BALANCE = 1 / 3
"""Smallest share of the images on one side of a cut. [ours]"""
_DENSE_NODES = 64
"""Number of nodes up to which the eigenvectors of a dense matrix are computed."""
_SHIFT = 1e-3
"""Shift of the Laplacian, which makes the matrix of the shift-invert Lanczos method regular."""


def partition_match_graph(
    problem: MappingProblem, max_images: int, overlap: float = OVERLAP
) -> list[Int64]:
    """Cut the match graph into connected clusters of images, and extend them to overlap.

    Args:
        problem: Mapping problem with verified pairs, whose numbers of matches weight the edges.
        max_images: Maximum number of images of a cluster before the extension.
        overlap: Number of images that extend a cluster, relative to the size of the cluster.

    Returns:
        Ascending image indices of each part. Images without verified pairs are in no part.
    """
    frames, frame_of = np.unique(RigFrames(problem).frame_of, return_inverse=True)
    sizes = np.bincount(frame_of, minlength=len(frames))
    graph = _remove_unconfirmed_edges(_build_frame_graph(problem, frame_of, len(frames)))
    _, component_of = connected_components(graph, directed=False)
    clusters = []
    for component in range(component_of.max(initial=-1) + 1):
        nodes = np.flatnonzero(component_of == component)
        if sizes[nodes].sum() > 1:
            clusters += _bisect(graph, nodes, sizes, max_images)
    cluster_of = np.full(len(frames), -1)
    for number, nodes in enumerate(clusters):
        cluster_of[nodes] = number
    extended = [_extend(graph, nodes, cluster_of, overlap) for nodes in clusters]
    return [np.flatnonzero(np.isin(frame_of, nodes)) for nodes in extended]


def _build_frame_graph(problem: MappingProblem, frame_of: Int64, num_frames: int) -> csr_array:
    """Build the symmetric graph of the numbers of matches between frames."""
    pairs = problem.pairs
    a = frame_of[np.array([pair.image_a for pair in pairs], dtype=np.int64)]
    b = frame_of[np.array([pair.image_b for pair in pairs], dtype=np.int64)]
    counts = np.where(a == b, 0, np.array([len(pair) for pair in pairs], dtype=np.int64))
    both = np.concatenate([a, b]), np.concatenate([b, a])
    shape = num_frames, num_frames
    graph = csr_array(coo_array((np.tile(counts, 2).astype(np.float64), both), shape=shape))
    graph.eliminate_zeros()
    return graph


def _remove_unconfirmed_edges(graph: csr_array) -> csr_array:
    """Remove edges on no cycle of three or four nodes, except those that connect the graph."""
    edges = coo_array(triu(graph))
    a, b = edges.row, edges.col
    is_confirmed = find_short_cycle_edges(a, b, graph.shape[0])
    costs = 1 / edges.data + 2 * ~is_confirmed  # confirmed edges first
    forest = csr_array(minimum_spanning_tree(csr_array((costs, (a, b)), shape=graph.shape)))
    remains = is_confirmed | (np.asarray(forest[a, b]).ravel() > 0)
    once = csr_array((edges.data[remains], (a[remains], b[remains])), shape=graph.shape)
    return csr_array(once + once.T)


def _bisect(graph: csr_array, nodes: Int64, sizes: Int64, max_images: int) -> list[Int64]:
    """Cut connected nodes in two until each cluster has at most ``max_images`` images."""
    if sizes[nodes].sum() <= max_images or len(nodes) < 2:
        return [nodes]
    inner = graph[nodes][:, nodes]
    inside = _connect_sides(inner, _find_cut(inner, sizes[nodes]))
    return [
        cluster
        for side in (nodes[inside], nodes[~inside])
        for cluster in _bisect(graph, side, sizes, max_images)
    ]


def _find_cut(graph: csr_array, sizes: Int64) -> Bool:
    """Find the balanced cut with the fewest matches along the Fiedler vector.

    Args:
        graph: (n, n) symmetric weights of a connected graph.
        sizes: (n,) number of images of each node.

    Returns:
        (n,) bool mask of one side.
    """
    order = np.argsort(_compute_fiedler_vector(graph), kind="stable")
    position = np.empty_like(order)
    position[order] = np.arange(len(order))
    edges = graph.tocoo()
    low = np.minimum(position[edges.row], position[edges.col])
    high = np.maximum(position[edges.row], position[edges.col])
    num_nodes = len(order)
    change = np.bincount(low, edges.data, num_nodes) - np.bincount(high, edges.data, num_nodes)
    cut_weight = np.cumsum(change)[:-1]  # entry k: weight across the cut behind position k
    filled = np.cumsum(sizes[order])[:-1] / sizes.sum()
    balance = np.minimum(filled, 1 - filled)
    cut_weight[balance < min(MIN_BALANCE, balance.max())] = np.inf
    side: Bool = position <= np.argmin(cut_weight)
    return side


def _compute_fiedler_vector(graph: csr_array) -> Float64:
    """Compute the second eigenvector of the normalized Laplacian, in the random-walk scaling."""
    degree = np.asarray(graph.sum(axis=1)).ravel()
    scaling = diags_array(1 / np.sqrt(degree))
    laplacian = eye_array(len(degree)) - scaling @ graph @ scaling
    if len(degree) <= _DENSE_NODES:
        vector = np.linalg.eigh(laplacian.toarray())[1][:, 1]
    else:
        start = np.random.default_rng(0).normal(size=len(degree))
        values, vectors = eigsh(laplacian.tocsc(), k=2, sigma=-_SHIFT, v0=start)
        vector = vectors[:, np.argmax(values)]
    vector = vector / np.sqrt(degree)
    fiedler: Float64 = vector * np.sign(vector[np.argmax(np.abs(vector))])
    return fiedler


def _connect_sides(graph: csr_array, inside: Bool) -> Bool:
    """Move fragments to the other side of a cut, so that both sides are connected."""
    for _ in range(2):
        nodes = np.flatnonzero(inside)
        _, fragment_of = connected_components(graph[nodes][:, nodes], directed=False)
        largest = np.bincount(fragment_of).argmax()
        inside = np.ones_like(inside)
        inside[nodes[fragment_of == largest]] = False  # the other side, with all fragments
    return inside


def _extend(graph: csr_array, nodes: Int64, cluster_of: Int64, overlap: float) -> Int64:
    """Extend a cluster by the best matching frames of each adjacent cluster.

    The number of frames from an adjacent cluster is proportional to its matches with the cluster,
    and at least ``MIN_COMMON_FRAMES``.
    """
    weights = np.asarray(graph[nodes].sum(axis=0)).ravel()
    weights[nodes] = 0
    outside = np.flatnonzero(weights)
    outside = outside[np.argsort(-weights[outside], kind="stable")]
    total = weights.sum()
    budget = overlap * len(nodes)
    added = [nodes]
    for neighbor in np.unique(cluster_of[outside]):
        candidates = outside[cluster_of[outside] == neighbor]
        share = weights[candidates].sum() / total
        added.append(candidates[: max(round(budget * share), MIN_COMMON_FRAMES)])
    return np.sort(np.concatenate(added))
