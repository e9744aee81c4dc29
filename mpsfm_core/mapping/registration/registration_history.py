"""What history to register images have shown: not to be repeated, and which view is to blame."""

from __future__ import annotations

from collections import defaultdict
from typing import NamedTuple

import numpy as np

from mpsfm_core.data import Bool
from mpsfm_core.data.decisions import Reason
from mpsfm_core.mapping.options import RegistrationOptions
from mpsfm_core.mapping.registration.pose_support import ScoredPose

MIN_CONTRADICTING_IMAGES = 2
"""Newcomers that contradict a view before it is the one to go (ours)."""


class _Attempt(NamedTuple):
    """The images that an image was posed beside, and the best pose that was found."""

    references: list[int]
    pose: ScoredPose | None


class RegistrationHistory:
    """Memory of the history within one component.

    ``refuted``: (n, n) bool, an image is not to be posed beside another: their matches led to a
    pose whose depth contradicted the scene.
    """

    def __init__(self, num_images: int, options: RegistrationOptions) -> None:
        self.excluded_references: Bool = np.zeros((num_images, num_images), dtype=np.bool_)
        self._options = options
        self._searches: dict[int, int] = defaultdict(int)
        self._last: dict[int, _Attempt] = {}
        self._contradicted: dict[int, set[int]] = defaultdict(set)
        self._refused: dict[tuple[int, bytes], Reason] = {}
        self._displaced: set[int] = set()

    def num_searches(self, image: int) -> int:
        """How often the pose of an image was searched for."""
        return self._searches[image]

    def last_best_pose(self, image: int) -> ScoredPose | None:
        """The best pose that the last attempt at an image knew."""
        return self._last[image].pose if image in self._last else None

    def is_exhausted(self, image: int, references: list[int]) -> bool:
        """Whether another search for the pose of an image would only repeat the last one.

        A few are different in any case: they take other halves of the matches.
        """
        several = self._searches[image] >= self._options.resampled_attempts
        return several and image in self._last and self._last[image].references == references

    def record_attempt(
        self, image: int, references: list[int], best: ScoredPose | None, *, searched: bool
    ) -> None:
        """Note an attempt and the best pose known after it."""
        self._searches[image] += searched
        self._last[image] = _Attempt(references, best)

    def record_contradiction(self, view: int, newcomer: int) -> None:
        """Note that the depth of a newcomer contradicts that of a registered view."""
        self._contradicted[view].add(newcomer)

    def pop_contradicted_image(self, registered: Bool) -> tuple[int, int] | None:
        """The view that most newcomers contradict who are not registered yet, and their number.

        The check blames the newcomer, but several of them may be right and the one view wrong.
        Each view is named once; None when no registered one is contradicted by several.
        """
        blame = {
            view: int((~registered[list(newcomers)]).sum())
            for view, newcomers in self._contradicted.items()
            if registered[view] and view not in self._displaced
        }
        worst = max(blame, key=lambda view: blame[view], default=-1)
        if blame.get(worst, 0) < MIN_CONTRADICTING_IMAGES:
            return None
        self._contradicted.clear()
        self._displaced.add(worst)
        return worst, blame[worst]

    def pose_rejection(self, image: int, pose: ScoredPose) -> Reason | None:
        """Why this very pose of an image was refused in the present scene, if it was."""
        return self._refused.get(_key(image, pose))

    def reject_pose(self, image: int, pose: ScoredPose, reason: Reason) -> None:
        """Note that the scene around a pose of an image did not hold."""
        self._refused[_key(image, pose)] = reason

    def clear_pose_rejections(self) -> None:
        """Let refused poses be tried again."""
        self._refused.clear()

    def clear(self) -> None:
        """Let everything be tried again: the scene may be right now where it was wrong."""
        self.excluded_references[:] = False
        self._last.clear()
        self.clear_pose_rejections()


def _key(image: int, pose: ScoredPose) -> tuple[int, bytes]:
    return image, pose.rotation.tobytes() + pose.translation.tobytes()
