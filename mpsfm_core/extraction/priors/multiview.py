"""Depth and poses from a multi-view network that sees groups of images."""

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
"""Indices of the images of a group, its first image first."""


def choose_groups(count: int, matches: dict[Pair, int], size: int) -> list[tuple[Group, int]]:
    """Partition the images into groups that share verified matches.

    A group starts with the image with most matches and grows greedily by the image that shares
    most matches with it. A group without further new images is filled with images of other
    groups, because more images improve the prediction.

    Args:
        count: Number of images.
        matches: Number of verified matches of each pair.
        size: Maximum size of a group.

    Returns:
        Each group with the number of its own images, which come first. Each image is an own image
        of exactly one group.
    """
    shared = np.zeros((count, count), dtype=np.int64)
    for (a, b), number in matches.items():
        shared[a, b] = shared[b, a] = number
    free = np.ones(count, dtype=np.bool_)
    groups = []
    while free.any():
        first = int(np.where(free, shared[:, free].sum(axis=1), -1).argmax())
        members = _grow_group([first], shared, free, size)
        free[members] = False
        group = _grow_group(members, shared, ~free, size)
        groups.append((tuple(group), len(members)))
    return groups


def _grow_group(group: list[int], shared: Int64, allowed: Any, size: int) -> list[int]:
    """Add the allowed images with most shared matches, one after the other."""
    grown = list(group)
    while len(grown) < size:
        num_shared = np.where(allowed, shared[:, grown].sum(axis=1), 0)
        num_shared[grown] = 0
        if not num_shared.any():
            break
        grown.append(int(num_shared.argmax()))
    return grown


class GroupPriors:
    """Runs the multi-view provider on groups of images; cached."""

    def __init__(self, context: ExtractionContext) -> None:
        assert context.config.multiview is not None
        self.provider = context.provider("multiview", context.config.multiview)
        self.groups: list[tuple[Group, int]] = []
        self._context = context
        self._position: dict[int, tuple[int, int]] = {}
        self._poses: list[Float64 | None] = []

    def run(self, matches: dict[Pair, int]) -> None:
        """Choose the groups by verified matches, and run the network on all groups."""
        size = self._context.config.extraction.group_size
        self.groups = choose_groups(len(self._context.images), matches, size)
        for number, (group, num_own) in enumerate(self.groups):
            self._position |= {image: (number, row) for row, image in enumerate(group[:num_own])}
        shown = [group for group, _ in self.groups]
        self._poses = self._context.each("multiview", shown, self._predict_poses, self.provider)

    def predict(self, group: Group) -> MultiViewPrior:
        """Return the prediction of the network for a group."""
        context, provider = self._context, self.provider

        def compute(instance: Any) -> MultiViewPrior:
            views = [context.view(index) for index in group]
            return validation.run_multiview(provider.spec, instance, views)

        inputs = [context.view_inputs(index, provider) for index in group]
        return context.result(provider, MultiViewPrior, inputs, compute, group)

    def depth(self, image: int) -> DepthPrior:
        """Return the depth of an image, predicted with its group."""
        number, row = self._position[image]
        prior = self.predict(self.groups[number][0])
        if not prior.depth:  # the provider failed, and the run skips failures
            nothing: DepthPrior = EMPTY_RESULTS[DepthPrior]()  # type: ignore[assignment]
            return nothing
        return prior.depth[row]

    def place(self, image: int) -> tuple[int, Pose | None]:
        """Return the number of an image's group, and the pose that the network predicts."""
        number, row = self._position[image]
        poses = self._poses[number]
        if poses is None or not len(poses):
            return number, None
        return number, (poses[row, :, :3].copy(), poses[row, :, 3].copy())

    def described(self) -> list[list[str]]:
        """Return the image names of each group, for the report."""
        names = self._context.images.names
        return [[names[image] for image in group] for group, _ in self.groups]

    def _predict_poses(self, group: Group) -> Float64 | None:
        """Return the poses of a group; its maps stay in the cache, to limit memory."""
        return self.predict(group).poses


def consecutive_groups(images: Sequence[int], size: int) -> list[Group]:
    """Group images in their order, before matches are known."""
    return [tuple(images[start : start + size]) for start in range(0, len(images), size)]
