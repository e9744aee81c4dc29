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

from collections.abc import Iterable
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np
from scipy.sparse import csr_array, eye_array
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

MAX_COMMON_IMAGES = 0.5
"""Intersection over union of two sets of misregistered images above which the sets count as the
same. The sets that cuts of a sequence at neighboring images separate are nearly equal. [tuned:
benchmarks.symmetry, benchmarks.walks]"""


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

    def differs_from(self, others: Iterable[Misregistration]) -> bool:
        """Return whether no other set has most of its images in common with this set.

        A set that may be split off the model only equals a set of the same images.
        """
        images = frozenset(self.images)
        for other in others:
            num_common = len(images.intersection(other.images))
            num_images = len(images.union(other.images))
            is_similar = num_common > MAX_COMMON_IMAGES * num_images and not self.splits
            if is_similar or num_common == num_images:
                return False
        return True


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


class PairCounts(NamedTuple):
    """Numbers of matches of image pairs, each pair once.

    The pairs are sorted by both images.
    """

    a: Int64
    """(p,) index of the first image of each pair."""
    b: Int64
    """(p,) index of the second image of each pair, larger than ``a``."""
    explained: Int64
    """(p,) number of matches whose keypoints observe the same 3D point."""
    contradicting: Int64
    """(p,) number of matches if they contradict the poses of both images, else 0."""
    is_explained: Bool
    """(p,) bool mask of the pairs whose matches support the poses of both images."""

    def between(self, images: Bool) -> PairCounts:
        """Return the counts of the pairs of which both images are in the mask (n,)."""
        rows = images[self.a] & images[self.b]
        fields: list[Any] = [values[rows] for values in self]
        return PairCounts(*fields)

    def graph(self, values: Any, num_images: int) -> csr_array:
        """Return a symmetric sparse matrix (n, n) with a value (p,) of each pair."""
        ends = np.concatenate([self.a, self.b]), np.concatenate([self.b, self.a])
        matrix = csr_array((np.tile(values, 2), ends), shape=(num_images, num_images))
        matrix.eliminate_zeros()
        return matrix


def detect_misregistrations(scene: Scene, min_matches: int) -> list[Misregistration]:
    """Detect groups of registered images whose matches mostly contradict their poses.

    The matches of all images of a frame are counted together, and the first image represents the
    frame.

    Args:
        scene: The scene with the registered images.
        min_matches: Smallest number of matches of a pair that can contradict poses.

    Returns:
        Sets of images that may be misregistered together, the largest excess of contradicting
        matches first.
    """
    registered = scene.registered & scene.rigs.is_first
    return find_misregistrations(count_pair_matches(scene, min_matches), registered)


def find_misregistrations(counts: PairCounts, registered: Bool) -> list[Misregistration]:
    """Find groups of registered images whose matches mostly contradict their poses.

    Args:
        counts: Numbers of matches of all image pairs.
        registered: (n,) bool mask of the registered images.

    Returns:
        See :func:`detect_misregistrations`.
    """
    separating = _count_separating_matches(counts, registered)
    if not separating:
        return []
    capacities = counts.graph(counts.explained.astype(np.int32), len(registered))
    supporting = counts.graph(counts.is_explained, len(registered)).tocoo()
    detected: dict[tuple[int, ...], Misregistration] = {}

    def add(inside: Bool, margin: int, splits: bool = False) -> None:
        images = tuple(map(int, np.flatnonzero(inside)))
        previous = detected.get(images)
        if previous is not None:
            margin, splits = max(margin, previous.margin), splits or previous.splits
        leaves = inside[supporting.row] & (registered & ~inside)[supporting.col]
        pairs = np.stack([supporting.row, supporting.col], axis=1)[leaves].astype(np.int64)
        detected[images] = Misregistration(images, pairs, margin, splits)

    among_registered = counts.between(registered)
    for image, margin in _find_contradicted_images(among_registered, len(registered)):
        add(_mask([image], registered), margin)
    for cut in find_contradicted_cuts(among_registered, registered):
        is_group = bool(np.count_nonzero(cut.inside) > 1)
        add(cut.inside, cut.margin, splits=is_group and cut.has_one_link)
    pairs = np.array(sorted(separating), dtype=np.int64)
    widths = compute_widest_paths(counts, pairs, len(registered))
    for (a, b), width in zip(pairs.tolist(), widths, strict=True):
        if separating[a, b] <= width:
            continue
        flow = maximum_flow(capacities, a, b)
        margin = int(separating[a, b] - flow.flow_value)
        if margin <= 0:
            continue
        residual_graph = capacities - flow.flow
        residual_graph.eliminate_zeros()
        side = breadth_first_order(residual_graph, a, return_predecessors=False)
        inside = _mask(side, registered)
        if 2 * inside.sum() > registered.sum():
            inside = registered & ~inside
        add(inside, margin)
    if not detected:
        # a wrong relative pose also explains the matches of its own image pair, however many there
        # are
        for cut in find_contradicted_cuts(among_registered, registered, 0.0):
            if cut.has_one_link and np.count_nonzero(cut.inside) > 1:
                add(cut.inside, cut.margin, splits=True)
    return sorted(detected.values(), key=lambda group: (-group.margin, group.images))


def count_pair_matches(scene: Scene, min_matches: int = 0) -> PairCounts:
    """Count the explained and the contradicting matches of each pair of frames.

    The first image of a frame represents the frame, and is the frame of an image without a rig.
    Matches within a frame are not counted.

    Args:
        scene: The scene with the registered images.
        min_matches: Smallest number of matches of a pair that can contradict poses.
    """
    graph, n = scene.graph, scene.num_images
    frame_of = scene.rigs.frame_of[graph.image_of]
    a, b = frame_of[graph.source], frame_of[graph.target]
    once = a < b
    keys, pair_of, matches = np.unique(
        a[once] * n + b[once], return_inverse=True, return_counts=True
    )
    explained = np.bincount(pair_of[scene.explained_edges()[once]], minlength=len(keys))
    return count_contradictions(keys // n, keys % n, matches, explained, min_matches)


def count_contradictions(
    a: Int64, b: Int64, matches: Int64, explained: Int64, min_matches: int
) -> PairCounts:
    """Return match counts of pairs; pairs with few explained matches contradict the poses.

    Args:
        a: (p,) index of the first image of each pair.
        b: (p,) index of the second image of each pair, larger than ``a``.
        matches: (p,) number of matches.
        explained: (p,) number of matches whose keypoints observe the same 3D point.
        min_matches: Smallest number of matches of a pair that can contradict poses.
    """
    is_explained = explained > MAX_EXPLAINED_RATIO * matches
    contradicting = np.where(is_explained | (matches < min_matches), 0, matches)
    return PairCounts(a, b, explained, contradicting, is_explained)


def compute_widest_paths(counts: PairCounts, pairs: Int64, num_images: int) -> Int64:
    """Compute the capacity of the widest path of explained matches between images.

    The capacity of a path is the smallest number of explained matches of its edges, and a lower
    bound of the maximum flow. The widest path is in the maximum spanning tree.

    Args:
        counts: Numbers of matches of all image pairs.
        pairs: (q, 2) pairs of different images.
        num_images: Number of images.

    Returns:
        (q,) path capacities, 0 for images that are not connected.
    """
    tree = _find_spanning_forest(counts, num_images).tocoo()
    parent, root, depth, _ = _root_forest(np.stack([tree.row, tree.col], axis=1), num_images)
    capacity = np.zeros(num_images, dtype=np.int64)  # of the edge to the parent
    child = np.where(parent[tree.row] == tree.col, tree.row, tree.col)
    capacity[child] = np.rint(1.0 / tree.data)
    is_connected = root[pairs[:, 0]] == root[pairs[:, 1]]
    widths = np.zeros(len(pairs), dtype=np.int64)
    widths[is_connected] = _climb(pairs[is_connected], parent, depth, capacity)[1]
    return widths


def _mask(images: Any, registered: Bool) -> Bool:
    """Return a bool mask (n,) of the given images."""
    mask = np.zeros_like(registered)
    mask[images] = True
    return mask


def _find_contradicted_images(counts: PairCounts, num_images: int) -> list[tuple[int, int]]:
    """Return registered images with clearly more contradicting than explained matches.

    Args:
        counts: Numbers of matches of the pairs of registered images.
        num_images: Number of images.

    Returns:
        Images, each with its excess of contradicting matches.
    """
    ends = np.concatenate([counts.a, counts.b])
    excess = np.tile(counts.contradicting - counts.explained, 2)
    squares = np.tile(counts.contradicting**2 + counts.explained**2, 2)
    margin = np.bincount(ends, excess, num_images)
    std = np.sqrt(np.bincount(ends, squares, num_images))
    images = np.flatnonzero(margin > MIN_SIGNIFICANCE * std)
    return [(int(image), int(margin[image])) for image in images]


def find_contradicted_cuts(
    counts: PairCounts, registered: Bool, min_significance: float = MIN_SIGNIFICANCE
) -> list[ContradictedCut]:
    """Find cuts of the match graph whose matches mostly contradict the poses of the images.

    Each candidate cut removes an edge of the maximum spanning tree of the numbers of explained
    matches. The candidate cuts include every part of the model that a single pair connects to the
    rest. The matches of all image pairs across a cut are counted, except for contradicting pairs
    that no other pair confirms. Otherwise a few pairs of distant images that look alike would
    outnumber the matches across a thin cut of a large model.

    Args:
        counts: Numbers of matches of the pairs of registered images.
        registered: (n,) bool mask of the registered images.
        min_significance: Minimum excess of contradicting matches in standard deviations.
    """
    num_images = len(registered)
    forest = _find_spanning_forest(counts, num_images).tocoo()
    edges = np.stack([forest.row, forest.col], axis=1)
    is_confirmed = _find_confirmed_contradictions(counts, num_images)
    against, support = np.where(is_confirmed, counts.contradicting, 0), counts.explained
    values = [against, support, against**2 + support**2, support > 0, against > 0]
    pairs = np.stack([counts.a, counts.b], axis=1)
    sums = sum_across_tree_cuts(edges, pairs, np.stack(values, axis=1), num_images)
    margins, stds = sums[:, 0] - sums[:, 1], np.sqrt(sums[:, 2])
    cuts = []
    for row in np.flatnonzero(margins > min_significance * stds):
        others = np.delete(edges, row, axis=0)
        rest = csr_array((np.ones(len(others)), others.T), shape=forest.shape)
        part_of = connected_components(rest, directed=False)[1]
        inside = part_of == part_of[edges[row, 0]]
        if 2 * inside.sum() > registered.sum():
            inside = registered & ~inside
        num_supporting, num_contradicting = map(int, sums[row, 3:])
        cuts.append(ContradictedCut(inside, int(margins[row]), num_supporting, num_contradicting))
    return cuts


def _find_confirmed_contradictions(counts: PairCounts, num_images: int) -> Bool:
    """Return a mask (p,) of the contradicting pairs that another contradicting pair confirms.

    If a group of images is misregistered, neighbors of both images of a contradicting pair also
    contradict each other. Neighbors are images with explained matches.
    """
    neighbors = counts.graph(counts.is_explained.astype(np.int64), num_images)
    neighbors = neighbors + eye_array(num_images, dtype=np.int64, format="csr")
    confirmed: Bool = counts.contradicting > 0
    contradictions = counts.graph(confirmed.astype(np.int64), num_images)
    a, b = counts.a[confirmed], counts.b[confirmed]
    num_confirming = csr_array(neighbors @ contradictions)[a].multiply(neighbors[b]).sum(axis=1)
    confirmed[confirmed] = num_confirming > 1  # a pair also confirms itself
    return confirmed


def _find_spanning_forest(counts: PairCounts, num_images: int) -> csr_array:
    """Find the maximum spanning forest of the numbers of explained matches.

    Returns:
        (n, n) sparse matrix with the inverse number of explained matches of each forest edge.
    """
    costs = np.where(counts.explained > 0, 1.0 / np.maximum(counts.explained, 1), 0.0)
    return csr_array(minimum_spanning_tree(counts.graph(costs, num_images)))


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
    parent, root, depth, order = _root_forest(edges, num_nodes)
    is_inner = root[pairs[:, 0]] == root[pairs[:, 1]]
    ancestor, _ = _climb(pairs[is_inner], parent, depth, np.zeros(num_nodes, dtype=np.int64))
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


def _root_forest(edges: Int64, num_nodes: int) -> tuple[Int64, Int64, Int64, Int64]:
    """Root each tree of a forest at its first node.

    Args:
        edges: (e, 2) edges of the forest.
        num_nodes: Number of nodes.

    Returns:
        Parent (n,) of each node, -1 for roots, root (n,) of each node, depth (n,) of each node, and
        all nodes in an order that has parents before children.
    """
    forest = csr_array((np.ones(len(edges)), edges.T), shape=(num_nodes, num_nodes))
    # an extra root node joins all trees, so that one traversal visits all nodes
    label = connected_components(forest, directed=False)[1]
    first = np.unique(label, return_index=True)[1]
    joined = np.concatenate([edges, np.stack([np.full(len(first), num_nodes), first], axis=1)])
    graph = csr_array((np.ones(len(joined)), joined.T), shape=(num_nodes + 1,) * 2)
    order, parent = breadth_first_order(graph, num_nodes, directed=False)
    order, parent = order[1:].astype(np.int64), parent[:-1].astype(np.int64)
    parent[first] = -1
    depth = np.zeros(num_nodes, dtype=np.int64)
    for node in order:
        if parent[node] >= 0:
            depth[node] = depth[parent[node]] + 1
    return parent, first[label], depth, order


def _climb(pairs: Int64, parent: Int64, depth: Int64, capacity: Int64) -> tuple[Int64, Int64]:
    """Climb a tree from both nodes of each pair (p, 2) to their lowest common ancestor.

    Args:
        pairs: (p, 2) pairs of nodes of the same tree.
        parent: (n,) parent of each node.
        depth: (n,) depth of each node.
        capacity: (n,) capacity of the edge from each node to its parent.

    Returns:
        Common ancestors (p,), and smallest capacities (p,) of the edges of the path.
    """
    a: Int64 = pairs[:, 0].copy()
    b: Int64 = pairs[:, 1].copy()
    width = np.full(len(pairs), np.iinfo(np.int64).max)
    active = np.flatnonzero(a != b)
    while len(active):
        a_active, b_active = a[active], b[active]
        a_moves = depth[a_active] >= depth[b_active]
        b_moves = depth[b_active] >= depth[a_active]
        for nodes, moves in ((a_active, a_moves), (b_active, b_moves)):
            width[active[moves]] = np.minimum(width[active[moves]], capacity[nodes[moves]])
        a[active] = np.where(a_moves, parent[a_active], a_active)
        b[active] = np.where(b_moves, parent[b_active], b_active)
        active = active[a[active] != b[active]]
    return a, width


def _count_separating_matches(counts: PairCounts, registered: Bool) -> dict[tuple[int, int], int]:
    """Count the matches that contradict the poses of two registered images, by pair ``a < b``.

    A pair has at least the number of its unexplained matches. If an unregistered image matches both
    images of the pair, the pair has at least the smaller of these two numbers of matches.
    """
    rows = np.flatnonzero(counts.contradicting > 0)
    a, b, matches = (values[rows].tolist() for values in (counts.a, counts.b, counts.contradicting))
    separating: dict[tuple[int, int], int] = {}
    partners: dict[int, list[tuple[int, int]]] = {}
    for first, second, number in zip(a, b, matches, strict=True):
        if registered[first] and registered[second]:
            separating[first, second] = number
        elif registered[first] or registered[second]:
            image, other = (second, first) if registered[first] else (first, second)
            partners.setdefault(image, []).append((other, number))
    for matched in partners.values():
        for (first, number_a), (second, number_b) in combinations(sorted(matched), 2):
            number = min(number_a, number_b)
            separating[first, second] = max(separating.get((first, second), 0), number)
    return separating
