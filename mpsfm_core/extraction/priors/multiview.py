"""Depth of photos that a network sees together: which it is shown at once, and what it says."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from mpsfm_core.data import DepthPrior, Float64, Int64, MultiViewPrior, Pose
from mpsfm_core.extraction.context import ExtractionContext
from mpsfm_core.extraction.empty_results import EMPTY_RESULTS
from mpsfm_core.extraction.pairs.pairing import Pair
from mpsfm_core.providers import validation

Group = tuple[int, ...]
"""Images that are shown together, the one that the group grew from first."""


def choose_groups(count: int, matches: dict[Pair, int], size: int) -> list[tuple[Group, int]]:
    """Groups of at most ``size`` images that see the same, so that each image is in one of them.

    ``matches``: verified matches of pairs of images. Each group is followed by the number of its
    images that are in no group before; these come first. A group grows from the image with most
    matches, by the image that has most matches to it; where no new one is left it is filled with
    images of other groups, as a network sees more in more photos.
    """
    shared = np.zeros((count, count), dtype=np.int64)
    for (a, b), number in matches.items():
        shared[a, b] = shared[b, a] = number
    free = np.ones(count, dtype=np.bool_)
    groups = []
    while free.any():
        first = int(np.where(free, shared[:, free].sum(axis=1), -1).argmax())
        own = _grown([first], shared, free, size)
        free[own] = False
        group = _grown(own, shared, ~free, size)
        groups.append((tuple(group), len(own)))
    return groups


def _grown(group: list[int], shared: Int64, allowed: Any, size: int) -> list[int]:
    """The group with the allowed images that share most with it, one after the other."""
    grown = list(group)
    while len(grown) < size:
        ties = np.where(allowed, shared[:, grown].sum(axis=1), 0)
        ties[grown] = 0
        if not ties.any():
            break
        grown.append(int(ties.argmax()))
    return grown


class GroupPriors:
    """Runs the multi-view provider of a configuration on groups of images; cached."""

    def __init__(self, context: ExtractionContext) -> None:
        assert context.config.multiview is not None
        self.provider = context.provider("multiview", context.config.multiview)
        self.groups: list[tuple[Group, int]] = []
        self._context = context
        self._place: dict[int, tuple[int, int]] = {}
        self._poses: list[Float64 | None] = []

    def run(self, matches: dict[Pair, int]) -> None:
        """Choose the groups by verified matches, and ask about all of them."""
        size = self._context.config.extraction.group_size
        self.groups = choose_groups(len(self._context.images), matches, size)
        for number, (group, own) in enumerate(self.groups):
            self._place |= {image: (number, row) for row, image in enumerate(group[:own])}
        shown = [group for group, _ in self.groups]
        self._poses = self._context.each("multiview", shown, self._see, self.provider)

    def predict(self, group: Group) -> MultiViewPrior:
        """What the network says of a group."""
        context, provider = self._context, self.provider

        def compute(instance: Any) -> MultiViewPrior:
            views = [context.view(index) for index in group]
            return validation.run_multiview(provider.spec, instance, views)

        inputs = [context.view_inputs(index, provider) for index in group]
        return context.result(provider, MultiViewPrior, inputs, compute, group)

    def depth(self, image: int) -> DepthPrior:
        """Depth of an image, of the group that it belongs to."""
        number, row = self._place[image]
        prior = self.predict(self.groups[number][0])
        if not prior.depth:  # the provider failed, and the run goes on
            nothing: DepthPrior = EMPTY_RESULTS[DepthPrior]()  # type: ignore[assignment]
            return nothing
        return prior.depth[row]

    def place(self, image: int) -> tuple[int, Pose | None]:
        """The number of an image's group, and the pose that the network proposes."""
        number, row = self._place[image]
        poses = self._poses[number]
        if poses is None or not len(poses):
            return number, None
        return number, (poses[row, :, :3].copy(), poses[row, :, 3].copy())

    def described(self) -> list[list[str]]:
        """Names of the images of each group, for the report."""
        names = self._context.images.names
        return [[names[image] for image in group] for group, _ in self.groups]

    def _see(self, group: Group) -> Float64 | None:
        """The poses; leaves the maps in the cache: those of all images need not fit in memory."""
        return self.predict(group).poses


def consecutive_groups(images: Sequence[int], size: int) -> list[Group]:
    """Groups of images that follow each other, for before anything is known of them."""
    return [tuple(images[start : start + size]) for start in range(0, len(images), size)]
