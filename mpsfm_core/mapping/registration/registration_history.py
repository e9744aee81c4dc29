"""Record of registration attempts that avoids repeated failures."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.sparse import csr_array

from mpsfm_core.data import Bool
from mpsfm_core.data.decisions import ImageReason, Reason, reason_from_json
from mpsfm_core.mapping.options import RegistrationOptions
from mpsfm_core.mapping.registration.pose_support import ScoredPose
from mpsfm_core.mapping.state import StateDict

MIN_CONTRADICTING_IMAGES = 2
"""Number of rejected images whose depth must contradict a registered image before that image is
deregistered. [ours]"""


class _Attempt(NamedTuple):
    """Last attempt to estimate the pose of an image."""

    references: list[int]
    pose: ScoredPose | None


class RegistrationHistory:
    """Record of the registration attempts within one component.

    Attributes:
        excluded_references: Reference images with which each image must not be registered, because
            their matches led to a pose with contradicting depth.
    """

    def __init__(self, options: RegistrationOptions) -> None:
        self.excluded_references: dict[int, set[int]] = defaultdict(set)
        self._options = options
        self._num_searches: dict[int, int] = defaultdict(int)
        self._last_attempts: dict[int, _Attempt] = {}
        self._contradicting: dict[int, set[int]] = defaultdict(set)
        self._rejected_poses: dict[tuple[int, bytes], Reason] = {}
        self._deregistered: set[int] = set()

    def exclude(self, images: Sequence[int], references: Sequence[int]) -> None:
        """Exclude reference images from the registration of images of a frame."""
        for image in images:
            self.excluded_references[image].update(references)

    def count_searches(self, image: int) -> int:
        """Return the number of times that the pose of an image was estimated."""
        return self._num_searches[image]

    def get_last_pose(self, image: int) -> ScoredPose | None:
        """Return the best pose of the last registration attempt of an image."""
        return self._last_attempts[image].pose if image in self._last_attempts else None

    def is_exhausted(self, image: int, references: list[int]) -> bool:
        """Return True if pose estimation from ``references`` would repeat the last attempt.

        The first pose estimations of an image differ, because each estimation draws other random
        halves of the matches.
        """
        is_resampled = self._num_searches[image] >= self._options.max_resampled_attempts
        last = self._last_attempts.get(image)
        return is_resampled and last is not None and last.references == references

    def record_attempt(
        self, image: int, references: list[int], best: ScoredPose | None, *, searched: bool
    ) -> None:
        """Record a registration attempt, its best pose, and whether poses were estimated."""
        self._num_searches[image] += searched
        self._last_attempts[image] = _Attempt(references, best)

    def record_contradiction(self, registered_image: int, new_image: int) -> None:
        """Record that the depth of a rejected image contradicts the depth of a registered image."""
        self._contradicting[registered_image].add(new_image)

    def pop_contradicted_image(self, registered: Bool) -> tuple[int, int] | None:
        """Return the registered image that the most rejected images contradict, and how many do.

        If the depth of a new and a registered image contradict each other, the pose of the
        registered image may be wrong. A registered image is returned at most once, even if further
        images contradict the image. If an image is returned, all recorded contradictions are
        removed.

        Args:
            registered: (n,) bool mask of the images that are registered at present.

        Returns:
            The contradicted image and the number of rejected images, or None if fewer than
            :data:`MIN_CONTRADICTING_IMAGES` rejected images contradict each registered image.
        """
        counts = {
            image: int((~registered[list(new_images)]).sum())
            for image, new_images in self._contradicting.items()
            if registered[image] and image not in self._deregistered
        }
        worst = max(counts, key=lambda image: counts[image], default=-1)
        if counts.get(worst, 0) < MIN_CONTRADICTING_IMAGES:
            return None
        self._contradicting.clear()
        self._deregistered.add(worst)
        return worst, counts[worst]

    def get_rejection(self, image: int, pose: ScoredPose) -> Reason | None:
        """Return the reason why a pose was rejected in the present scene, or None."""
        return self._rejected_poses.get(_pose_key(image, pose))

    def reject_pose(self, image: int, pose: ScoredPose, reason: Reason) -> None:
        """Record that a pose of an image failed verification in the present scene."""
        self._rejected_poses[_pose_key(image, pose)] = reason

    def clear_pose_rejections(self) -> None:
        """Allow rejected poses again after poses or points of the scene have changed."""
        self._rejected_poses.clear()

    def select_scores(self, scores: csr_array) -> csr_array:
        """Return the matching scores (n, n) without those of excluded reference images."""
        is_excluded = np.zeros(len(scores.data), dtype=np.bool_)
        for image, references in self.excluded_references.items():
            row = slice(*scores.indptr[image : image + 2])
            is_excluded[row] = np.isin(scores.indices[row], list(references))
        selected = np.where(is_excluded, 0.0, scores.data)
        return csr_array((selected, scores.indices, scores.indptr), shape=scores.shape)

    def clear(self) -> None:
        """Allow all registration attempts again after the scene was refined or corrected."""
        self.excluded_references.clear()
        self._last_attempts.clear()
        self.clear_pose_rejections()

    def state_dict(self) -> StateDict:
        """Return the recorded registration attempts and rejections for a checkpoint."""
        return {
            "excluded_references": [
                (image, sorted(excluded)) for image, excluded in self.excluded_references.items()
            ],
            "num_searches": list(self._num_searches.items()),
            "last_attempts": [
                {"image": image, "references": references, "pose": pose and {**vars(pose)}}
                for image, (references, pose) in self._last_attempts.items()
            ],
            "contradicting": [
                (image, sorted(new_images)) for image, new_images in self._contradicting.items()
            ],
            "rejected_poses": [
                {"image": image, "pose": np.frombuffer(pose), "reason": reason.to_json()}
                for (image, pose), reason in self._rejected_poses.items()
            ],
            "deregistered": sorted(self._deregistered),
        }

    def load_state_dict(self, state: StateDict) -> None:
        """Restore the recorded registration attempts and rejections from a checkpoint."""
        self.excluded_references.update(
            (image, set(excluded)) for image, excluded in state["excluded_references"]
        )
        self._num_searches.update(state["num_searches"])
        for attempt in state["last_attempts"]:
            pose = attempt["pose"] and ScoredPose(**attempt["pose"])
            self._last_attempts[attempt["image"]] = _Attempt(attempt["references"], pose)
        self._contradicting.update(
            (image, set(new_images)) for image, new_images in state["contradicting"]
        )
        for rejected in state["rejected_poses"]:
            key = rejected["image"], rejected["pose"].tobytes()
            self._rejected_poses[key] = reason_from_json(ImageReason, rejected["reason"])
        self._deregistered.update(state["deregistered"])


def _pose_key(image: int, pose: ScoredPose) -> tuple[int, bytes]:
    return image, pose.rotation.tobytes() + pose.translation.tobytes()
