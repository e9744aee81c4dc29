"""What happens in a run: told to who listens, and kept for the report."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Iterable, Iterator
from contextlib import contextmanager

from mpsfm_core.data import MappingProblem, VerifiedPair
from mpsfm_core.data.decisions import ImageReason, Reason
from mpsfm_core.mapping.events import MappingEvents
from mpsfm_core.mapping.scene.conversion import current
from mpsfm_core.mapping.scene.reconstruction import MappingReport, Reconstruction
from mpsfm_core.mapping.scene.scene import Scene


class Journal:
    """``image_reasons``: image name -> why it is not registered, or was not at one time."""

    def __init__(self, problem: MappingProblem, events: MappingEvents) -> None:
        self.image_reasons = _first_reasons(problem)
        self._problem = problem
        self._events = events
        self._pair_reasons: dict[str, Reason] = {}
        self._seconds: dict[str, float] = defaultdict(float)
        self._counts: dict[str, int] = defaultdict(int)

    def registered(self, image: int, count: int) -> None:
        """An image was registered, as the ``count``-th of its group."""
        images = self._problem.images
        self._events.image_registered(images[image].name, count, len(images))

    def scene_changed(self, scene: Scene) -> None:
        """Images or points have moved; who wants to see them now pays for a copy."""
        self._events.scene_changed(lambda: current(scene))

    def rejected(self, image: int, reason: Reason) -> None:
        """An image was not registered, or is no longer."""
        name = self._problem.images[image].name
        self.image_reasons[name] = reason
        self._events.image_rejected(name, reason)

    def pair_rejected(self, pair: VerifiedPair, reason: Reason) -> None:
        """A pair could not start a group."""
        names = [self._problem.images[image].name for image in (pair.image_a, pair.image_b)]
        self._pair_reasons[" ".join(names)] = reason

    @contextmanager
    def timed(self, step: str) -> Iterator[None]:
        """Count what is done meanwhile for a step."""
        start = time.perf_counter()
        try:
            yield
        finally:
            self._seconds[step] += time.perf_counter() - start
            self._counts[step] += 1

    def report(self, models: Iterable[Reconstruction]) -> MappingReport:
        """All of it, without reasons for the images of the models."""
        names = {image.name for model in models for image in model.images}
        reasons = {name: why for name, why in self.image_reasons.items() if name not in names}
        return MappingReport(reasons, self._pair_reasons, dict(self._seconds), dict(self._counts))


def _first_reasons(problem: MappingProblem) -> dict[str, Reason]:
    """Why each image is not registered, before any was tried."""
    matched = {index for pair in problem.pairs for index in (pair.image_a, pair.image_b)}
    reasons = {}
    for index, image in enumerate(problem.images):
        reason = ImageReason.NO_REGISTERED_NEIGHBOR.because()
        if not image.depth.valid.any():
            reason = ImageReason.NO_VALID_DEPTH.because()
        elif index not in matched:
            reason = ImageReason.NO_VERIFIED_MATCHES.because()
        reasons[image.name] = reason
    return reasons
