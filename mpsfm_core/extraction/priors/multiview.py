"""Depth and poses from a multi-view network that processes groups of images."""

from __future__ import annotations

from typing import Any

import numpy as np

from mpsfm_core.data import DepthPrior, Float64, Int64, MultiViewPrior, Pose
from mpsfm_core.extraction.context import ExtractionContext
from mpsfm_core.extraction.empty_results import EMPTY_RESULTS
from mpsfm_core.extraction.pairs.pairing import Pair
from mpsfm_core.providers.kinds.multiview import run_multiview

Group = tuple[int, ...]
"""Image indices of a group that the multi-view network processes together."""


def choose_groups(count: int, matches: dict[Pair, int], size: int) -> list[tuple[Group, int]]:
    """Partition the images into groups that share verified matches.

    A group starts with the ungrouped image that has most matches. The group grows greedily by the
    image that shares most matches with the group. A group below the maximum size is filled with
    images of other groups, because more images improve the prediction.

    Args:
        count: Number of images.
        matches: Number of verified matches of each pair.
        size: Maximum number of images in a group.

    Returns:
        The image indices of each group and the number of its core images, which come first in the
        group. Each image is a core image of exactly one group, whose prediction gives the depth of
        the image.
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
    """Add the allowed images that share most matches with a group, one after the other."""
    grown = list(group)
    while len(grown) < size:
        num_shared = np.where(allowed, shared[:, grown].sum(axis=1), 0)
        num_shared[grown] = 0
        if not num_shared.any():
            break
        grown.append(int(num_shared.argmax()))
    return grown


class GroupPriors:
    """Runs the multi-view provider on groups of images and caches the predictions."""

    def __init__(self, context: ExtractionContext) -> None:
        assert context.config.multiview is not None
        self.provider = context.provider("multiview", context.config.multiview)
        self.groups: list[tuple[Group, int]] = []
        self._context = context
        self._position: dict[int, tuple[int, int]] = {}
        self._poses: list[Float64 | None] = []

    def run(self, matches: dict[Pair, int]) -> None:
        """Choose image groups by verified matches, and run the multi-view network on each."""
        size = self._context.config.extraction.group_size
        self.groups = choose_groups(len(self._context.images), matches, size)
        for number, (group, num_own) in enumerate(self.groups):
            self._position |= {image: (number, row) for row, image in enumerate(group[:num_own])}
        shown = [group for group, _ in self.groups]
        self._poses = self._context.each("multiview", shown, self._predict_poses, self.provider)

    def predict(self, group: Group) -> MultiViewPrior:
        """Return cached or computed depth and poses of an image group by the multi-view network."""
        context, provider = self._context, self.provider

        def compute(instance: Any) -> MultiViewPrior:
            views = [context.view(index) for index in group]
            return run_multiview(provider.spec, instance, views)

        inputs = [context.view_inputs(index, provider) for index in group]
        return context.result(provider, MultiViewPrior, inputs, compute, group)

    def depth(self, image: int) -> DepthPrior:
        """Return the depth prior of an image from the prediction for its group."""
        number, row = self._position[image]
        prior = self.predict(self.groups[number][0])
        if not prior.depth:  # the provider failed, and the run skips failures
            nothing: DepthPrior = EMPTY_RESULTS[DepthPrior]()  # type: ignore[assignment]
            return nothing
        return prior.depth[row]

    def place(self, image: int) -> tuple[int, Pose | None]:
        """Return an image's group number, and the pose that the multi-view network predicts."""
        number, row = self._position[image]
        poses = self._poses[number]
        if poses is None or not len(poses):
            return number, None
        return number, (poses[row, :, :3].copy(), poses[row, :, 3].copy())

    def _predict_poses(self, group: Group) -> Float64 | None:
        """Predict the poses of an image group; depth maps stay in the disk cache."""
        return self.predict(group).poses
