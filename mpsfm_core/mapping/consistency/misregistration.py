"""Detection of misregistered images, whose matches mostly contradict their pose.

A match is explained if both of its keypoints observe the same 3D point. If hardly any match of a
pair of registered images is explained, the matches are wrong or one image is misregistered.
Misregistered images are detected in three ways.

1. An image pair may have more unexplained matches than the maximum flow of explained matches
   between both images. The images on the smaller side of the minimum cut may be misregistered.
2. Two images may match a third image that cannot be registered, so at most one of the two has a
   correct pose. The matches of both images with the third image count as unexplained matches
   between both images.
3. The unexplained matches of one image may clearly outnumber its explained matches, summed over all
   pairs.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import (
    breadth_first_order,
    connected_components,
    maximum_flow,
    minimum_spanning_tree,
)

from mpsfm_core.data import Bool, Int64
from mpsfm_core.mapping.scene.scene import Scene

MAX_EXPLAINED_RATIO = 0.25
"""Share of the matches of a pair whose keypoints observe the same 3D point, up to which the matches
contradict the poses of both images. If both poses are correct, well over half of the matches
observe common 3D points. [ours]"""
MIN_SIGNIFICANCE = 0.5
"""Minimum excess of the matches that contradict the pose of an image over those that support it, in
standard deviations of the excess if each image pair supports or contradicts the pose at random.
[tuned: benchmarks.symmetry]"""


class Misregistration(NamedTuple):
    """Set of images that may be misregistered together."""

    images: tuple[int, ...]
    """Indices of the misregistered images, which are the smaller side of a cut of the match
    graph."""
    supporting_pairs: Int64
    """(k, 2) pairs of a misregistered and another image whose matches support the present poses."""
    margin: int
    """Number of matches that contradict the poses of the misregistered images, minus number of
    matches that support the poses."""
    splits: bool = False
    """True if only one image pair connects the misregistered images to the model and several image
    pairs contradict their poses. Misregistered images that only one image pair connects to the
    model are deregistered if re-registration fails."""


class ContradictedCut(NamedTuple):
    """Cut of the match graph into two parts whose common matches mostly contradict the poses."""

    inside: Bool
    """(n,) bool mask of the images in the smaller part of the cut match graph."""
    margin: int
    """Number of contradicting matches across the cut, minus number of explained matches."""
    num_supporting_pairs: int
    """Number of image pairs across the cut with explained matches."""
    num_contradicting_pairs: int
    """Number of image pairs across the cut whose matches contradict the poses."""

    @property
    def has_one_link(self) -> bool:
        """True if one pair across the cut supports the poses and several pairs contradict them."""
        return self.num_supporting_pairs == 1 and self.num_contradicting_pairs > 1


def detect_misregistrations(scene: Scene, min_matches: int) -> list[Misregistration]:
    """Detect groups of registered images whose matches mostly contradict their poses.

    Args:
        scene: The scene with the registered images.
        min_matches: Smallest number of matches of a pair that can contradict poses.

    Returns:
        Sets of images that may be misregistered together, the largest excess of contradicting
        matches first.
    """
    matches, explained = count_pair_matches(scene)
    is_explained = explained > MAX_EXPLAINED_RATIO * matches
    contradicting = np.where(is_explained | (matches < min_matches), 0, matches)
    separating = _count_separating_matches(scene.registered, contradicting)
    if not separating.any():
        return []
    capacities = csr_array(explained.astype(np.int32))
    detected: dict[tuple[int, ...], Misregistration] = {}

    def add(inside: Bool, margin: int, splits: bool = False) -> None:
        images = tuple(map(int, np.flatnonzero(inside)))
        previous = detected.get(images)
        if previous is not None:
            margin, splits = max(margin, previous.margin), splits or previous.splits
        outside = scene.registered & ~inside
        pairs = np.argwhere(is_explained & inside[:, None] & outside)
        detected[images] = Misregistration(images, pairs, margin, splits)

    for image, margin in _find_contradicted_images(scene.registered, contradicting, explained):
        add(scene.mask([image]), margin)
    for cut in find_contradicted_cuts(scene.registered, contradicting, explained):
        is_group = bool(np.count_nonzero(cut.inside) > 1)
        add(cut.inside, cut.margin, splits=is_group and cut.has_one_link)
    for a, b in np.argwhere(np.triu(separating > compute_widest_paths(explained))):
        flow = maximum_flow(capacities, int(a), int(b))
        margin = int(separating[a, b] - flow.flow_value)
        if margin <= 0:
            continue
        residual_graph = capacities - flow.flow
        residual_graph.eliminate_zeros()
        side = breadth_first_order(residual_graph, int(a), return_predecessors=False)
        inside = scene.mask(side)
        if 2 * inside.sum() > scene.registered.sum():
            inside = scene.registered & ~inside
        add(inside, margin)
    if not detected:
        # a wrong relative pose also explains the matches of its own image pair, however many there
        # are
        for cut in find_contradicted_cuts(scene.registered, contradicting, explained, 0.0):
            if cut.has_one_link and np.count_nonzero(cut.inside) > 1:
                add(cut.inside, cut.margin, splits=True)
    return sorted(detected.values(), key=lambda group: (-group.margin, group.images))


def count_pair_matches(scene: Scene) -> tuple[Int64, Int64]:
    """Count the matches (n, n) and the explained matches (n, n) of each two images."""
    graph, n = scene.graph, scene.num_images
    a, b = graph.image_of[graph.source], graph.image_of[graph.target]
    pairs = a * n + b
    matches, explained = (
        np.bincount(edges, minlength=n * n).reshape(n, n)
        for edges in (pairs, pairs[scene.explained_edges()])
    )
    return matches, explained


def compute_widest_paths(capacities: Int64) -> Int64:
    """Compute the capacity of the widest path between each two graph nodes (Kruskal).

    The capacity of a path is the smallest capacity of its edges, and a lower bound of the maximum
    flow.

    Args:
        capacities: (n, n) symmetric capacities of the graph edges, 0 without an edge.

    Returns:
        (n, n) symmetric path capacities, 0 for nodes that are not connected.
    """
    widest = np.zeros_like(capacities)
    component = [np.array([node]) for node in range(len(capacities))]
    a, b = np.nonzero(np.triu(capacities))
    for edge in np.argsort(-capacities[a, b], kind="stable"):
        component_a, component_b = component[a[edge]], component[b[edge]]
        if component_a is component_b:
            continue
        capacity = capacities[a[edge], b[edge]]
        widest[np.ix_(component_a, component_b)] = capacity
        widest[np.ix_(component_b, component_a)] = capacity
        merged = np.concatenate([component_a, component_b])
        for node in merged:
            component[node] = merged
    return widest


def _find_contradicted_images(
    registered: Bool, contradicting: Int64, explained: Int64
) -> list[tuple[int, int]]:
    """Return registered images with clearly more contradicting than explained matches.

    Args:
        registered: (n,) bool.
        contradicting: (n, n) number of unexplained matches of each contradicting image pair.
        explained: (n, n) number of matches of each image pair that observe common points.

    Returns:
        Images, each with its excess of contradicting matches.
    """
    contradicting = np.where(registered[:, None] & registered, contradicting, 0)
    margin = (contradicting - explained).sum(axis=1)
    std = np.sqrt((contradicting**2 + explained**2).sum(axis=1))
    images = np.flatnonzero(margin > MIN_SIGNIFICANCE * std)
    return [(int(image), int(margin[image])) for image in images]


def find_contradicted_cuts(
    registered: Bool,
    contradicting: Int64,
    explained: Int64,
    min_significance: float = MIN_SIGNIFICANCE,
) -> list[ContradictedCut]:
    """Find cuts of the match graph whose matches mostly contradict the poses of the images.

    Each candidate cut removes an edge of the maximum spanning tree of the numbers of explained
    matches. The candidate cuts include every part of the model that a single pair connects to the
    rest. The matches of all image pairs across a cut are counted.

    Args:
        registered: (n,) bool.
        contradicting: (n, n) number of unexplained matches of each contradicting image pair.
        explained: (n, n) number of matches of each image pair that observe common points.
        min_significance: Minimum excess of contradicting matches in standard deviations.
    """
    images = np.flatnonzero(registered)
    explained = explained[np.ix_(images, images)]
    contradicting = contradicting[np.ix_(images, images)]
    costs = np.where(explained > 0, 1.0 / np.maximum(explained, 1), 0)
    edges = np.argwhere(minimum_spanning_tree(csr_array(costs)).toarray() > 0)
    a, b = np.nonzero(np.triu(explained + contradicting))
    against, support = contradicting[a, b], explained[a, b]
    counts = [against, support, against**2 + support**2, support > 0, against > 0]
    sums = sum_across_tree_cuts(edges, np.stack([a, b], axis=1), np.stack(counts, 1), len(images))
    margins, stds = sums[:, 0] - sums[:, 1], np.sqrt(sums[:, 2])
    cuts = []
    for row in np.flatnonzero(margins > min_significance * stds):
        others = np.delete(edges, row, axis=0)
        forest = csr_array((np.ones(len(others)), others.T), shape=explained.shape)
        part_of = connected_components(forest, directed=False)[1]
        inside = part_of == part_of[edges[row, 0]]
        if 2 * inside.sum() > len(images):
            inside = ~inside
        smaller_part = np.zeros_like(registered)
        smaller_part[images[inside]] = True
        num_supporting, num_contradicting = map(int, sums[row, 3:])
        cuts.append(
            ContradictedCut(smaller_part, int(margins[row]), num_supporting, num_contradicting)
        )
    return cuts


def sum_across_tree_cuts(edges: Int64, pairs: Int64, values: Int64, num_nodes: int) -> Int64:
    """Sum the values of the pairs of nodes that each edge of a forest separates.

    Removing an edge separates the part with its first node from all other nodes. The sums over the
    pairs across the cut follow from sums over the subtrees of rooted trees, in linear time.

    Args:
        edges: (e, 2) edges of the forest.
        pairs: (p, 2) pairs of different nodes.
        values: (p, k) values of the pairs.
        num_nodes: Number of nodes.

    Returns:
        (e, k) sums for each edge.
    """
    forest = csr_array((np.ones(len(edges)), edges.T), shape=(num_nodes, num_nodes))
    parent, root = np.full(num_nodes, -1), np.full(num_nodes, -1)
    order = np.zeros(0, dtype=np.int64)
    for first in range(num_nodes):
        if root[first] < 0:
            nodes, parents = breadth_first_order(forest, first, directed=False)
            parent[nodes[1:]], root[nodes] = parents[nodes[1:]], first
            order = np.concatenate([order, nodes])
    depth = np.zeros(num_nodes, dtype=np.int64)
    for node in order:
        if parent[node] >= 0:
            depth[node] = depth[parent[node]] + 1
    is_inner = root[pairs[:, 0]] == root[pairs[:, 1]]
    ancestor = _find_common_ancestors(pairs[is_inner], parent, depth)
    # sums over subtrees of: the pairs of each node, those within its tree, and pairs in the subtree
    ends = np.zeros((3, num_nodes, values.shape[1]), dtype=np.int64)
    for column in range(2):
        np.add.at(ends[0], pairs[:, column], values)
        np.add.at(ends[1], pairs[is_inner, column], values[is_inner])
    np.add.at(ends[2], ancestor, values[is_inner])
    for node in order[::-1]:
        if parent[node] >= 0:
            ends[:, parent[node]] += ends[:, node]
    all_ends, tree_ends, within = ends
    is_child = parent[edges[:, 0]] == edges[:, 1]
    child = np.where(is_child, edges[:, 0], edges[:, 1])
    top = root[child]
    below = all_ends[child] - 2 * within[child]
    across_edge = tree_ends[child] - 2 * within[child]
    within_above = within[top] - within[child] - across_edge
    above = all_ends[top] - all_ends[child] - 2 * within_above
    sums: Int64 = np.where(is_child[:, None], below, above)
    return sums


def _find_common_ancestors(pairs: Int64, parent: Int64, depth: Int64) -> Int64:
    """Return the lowest common ancestor (p,) of each pair (p, 2) of nodes of the same tree."""
    a: Int64 = pairs[:, 0].copy()
    b: Int64 = pairs[:, 1].copy()
    active = np.flatnonzero(a != b)
    while len(active):
        a_active, b_active = a[active], b[active]
        a_moves = depth[a_active] >= depth[b_active]
        b_moves = depth[b_active] >= depth[a_active]
        a[active] = np.where(a_moves, parent[a_active], a_active)
        b[active] = np.where(b_moves, parent[b_active], b_active)
        active = active[a[active] != b[active]]
    return a


def _count_separating_matches(registered: Bool, contradicting: Int64) -> Int64:
    """Count the matches that contradict the poses of two images, as a table (n, n) of pairs.

    A pair has at least the number of its unexplained matches. If an unregistered image matches both
    images of the pair, the pair has at least the smaller of these two numbers of matches.
    """
    both_registered = registered[:, None] & registered
    separating = np.where(both_registered, contradicting, 0)
    for image in np.flatnonzero(~registered):
        counts = np.where(registered, contradicting[image], 0)
        separating = np.maximum(separating, np.minimum(counts[:, None], counts))
    np.fill_diagonal(separating, 0)
    return separating
