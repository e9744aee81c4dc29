"""Images that fewer matches hold where they are than would hold them elsewhere.

Where two registered images see hardly any of their matches as common points, either these are
false, or one of the two stands where it does by others that are. What lies between them tells: the
fewest explained matches that must go for the two to come apart (a minimum cut). If those are fewer
than the matches that the two have with each other, the images on the smaller side of the cut may
belong elsewhere. The same holds for two images that another one, which could not be registered,
matches both: it can stand beside one of them only. And a single image may belong elsewhere that no
pair alone outweighs, but all of its pairs together.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import breadth_first_order, maximum_flow

from mpsfm_core.data import Bool, Int64
from mpsfm_core.mapping.scene.scene import Scene

MAX_EXPLAINED = 0.25
"""Share of the matches of two images that see the same point, up to which the two stand against
each other (ours; of right pairs it is well above a half)."""
CLEARLY_MORE = 0.5
"""Of what the matches of so many pairs would come to by chance, if each pair spoke for one place or
the other as it happens: by so much more must those against an image's place be. (Ours, two rooms:
with 0 right images move too, whose false matches are a few more; ``benchmarks/symmetry.py``.)"""


class Misregistration(NamedTuple):
    """``images``: of the smaller side of a cut. ``links`` (k, 2): one of them and an image of the
    rest beside which it stands. ``margin``: by how many matches what is torn apart has more than
    what holds them."""

    images: tuple[int, ...]
    links: Int64
    margin: int


def detect_misregistrations(scene: Scene, min_matches: int) -> list[Misregistration]:
    """All such groups of registered images, the largest margin first.

    ``min_matches``: of two images whose matches are heard.
    """
    matches, explained = count_pair_matches(scene)
    held = explained > MAX_EXPLAINED * matches
    against = np.where(held | (matches < min_matches), 0, matches)
    apart = _apart(scene.registered, against)
    if not apart.any():
        return []
    flows = csr_array(explained.astype(np.int32))
    found: dict[tuple[int, ...], Misregistration] = {}

    def add(inside: Bool, margin: int) -> None:
        images = tuple(map(int, np.flatnonzero(inside)))
        if images not in found or found[images].margin < margin:
            links = np.argwhere(held & inside[:, None] & (scene.registered & ~inside))
            found[images] = Misregistration(images, links, margin)

    for image, margin in _outweighed(scene.registered, against, explained):
        add(scene.mask([image]), margin)
    for a, b in np.argwhere(np.triu(apart > compute_widest_paths(explained))):
        flow = maximum_flow(flows, int(a), int(b))
        margin = int(apart[a, b] - flow.flow_value)
        if margin <= 0:
            continue
        open_ways = flows - flow.flow
        open_ways.eliminate_zeros()
        side = breadth_first_order(open_ways, int(a), return_predecessors=False)
        inside = scene.mask(side)
        if 2 * inside.sum() > scene.registered.sum():
            inside = scene.registered & ~inside
        add(inside, margin)
    return sorted(found.values(), key=lambda hold: (-hold.margin, hold.images))


def count_pair_matches(scene: Scene) -> tuple[Int64, Int64]:
    """(n, n) matches of each two images, and those of them that see the same point."""
    graph, n = scene.graph, scene.num_images
    a, b = graph.image_of[graph.source], graph.image_of[graph.target]
    pairs = a * n + b
    matches, explained = (
        np.bincount(edges, minlength=n * n).reshape(n, n)
        for edges in (pairs, pairs[scene.explained_edges()])
    )
    return matches, explained


def compute_widest_paths(held: Int64) -> Int64:
    """(n, n) the most that each two images are held by along one way: its weakest link.

    ``held`` (n, n): of each two images; what holds two along all ways is at least this.
    """
    widest = np.zeros_like(held)
    group = [np.array([image]) for image in range(len(held))]
    a, b = np.nonzero(np.triu(held))
    for link in np.argsort(-held[a, b], kind="stable"):
        one, other = group[a[link]], group[b[link]]
        if one is other:
            continue
        widest[np.ix_(one, other)] = widest[np.ix_(other, one)] = held[a[link], b[link]]
        joined = np.concatenate([one, other])
        for image in joined:
            group[image] = joined
    return widest


def _outweighed(registered: Bool, against: Int64, explained: Int64) -> list[tuple[int, int]]:
    """Registered images against whose place clearly more matches of all their pairs speak than for
    it, and by how many more.

    ``against``, ``explained`` (n, n): of each two images; only registered ones explain any.
    """
    against = np.where(registered[:, None] & registered, against, 0)
    margin = (against - explained).sum(axis=1)
    by_chance = np.sqrt((against**2 + explained**2).sum(axis=1))
    clear = np.flatnonzero(margin > CLEARLY_MORE * by_chance)
    return [(int(image), int(margin[image])) for image in clear]


def _apart(registered: Bool, against: Int64) -> Int64:
    """(n, n) matches that stand against the places of each two registered images.

    ``against`` (n, n): those of each two images that see no common points. Of an image that is not
    registered, two others can have what the lesser of them has.
    """
    both = registered[:, None] & registered
    apart = np.where(both, against, 0)
    for image in np.flatnonzero(~registered):
        of_image = np.where(registered, against[image], 0)
        apart = np.maximum(apart, np.minimum(of_image[:, None], of_image))
    np.fill_diagonal(apart, 0)
    return apart
