"""Log of a mapper run, which sends progress events and collects rejection reasons and times."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Iterable, Iterator
from contextlib import contextmanager

from mpsfm_core.data import MappingProblem, VerifiedPair
from mpsfm_core.data.decisions import ImageReason, Reason
from mpsfm_core.mapping.events import MappingEvents
from mpsfm_core.mapping.scene.conversion import capture_scene_state
from mpsfm_core.mapping.scene.reconstruction import MappingReport, Reconstruction
from mpsfm_core.mapping.scene.scene import Scene
from mpsfm_core.mapping.state import StateDict, reasons_from_json, reasons_to_json


class EventLog:
    """Events, rejection reasons and step times of one mapper run.

    Attributes:
        image_reasons: Last reason why an image was not registered, by image name.
    """

    def __init__(self, problem: MappingProblem, events: MappingEvents) -> None:
        self.image_reasons = _initial_reasons(problem)
        self._problem = problem
        self._events = events
        self._pair_reasons: dict[str, Reason] = {}
        self._seconds: dict[str, float] = defaultdict(float)
        self._counts: dict[str, int] = defaultdict(int)

    def registered(self, image: int, count: int) -> None:
        """Notify the event receiver that the ``count``-th image of a component is registered."""
        images = self._problem.images
        self._events.image_registered(images[image].name, count, len(images))

    def scene_changed(self, scene: Scene) -> None:
        """Notify the event receiver of a scene change, and copy the scene only on its request."""
        self._events.scene_changed(lambda: capture_scene_state(scene))

    def rejected(self, image: int, reason: Reason) -> None:
        """Record why an image was rejected or deregistered, and notify the event receiver."""
        name = self._problem.images[image].name
        self.image_reasons[name] = reason
        self._events.image_rejected(name, reason)

    def pair_rejected(self, pair: VerifiedPair, reason: Reason) -> None:
        """Record the reason why an image pair cannot initialize a component."""
        names = [self._problem.images[image].name for image in (pair.image_a, pair.image_b)]
        self._pair_reasons[" ".join(names)] = reason

    @contextmanager
    def timed(self, step: str) -> Iterator[None]:
        """Add the run time of the ``with`` block to a named step of the mapper."""
        start = time.perf_counter()
        try:
            yield
        finally:
            self._seconds[step] += time.perf_counter() - start
            self._counts[step] += 1

    def report(self, models: Iterable[Reconstruction]) -> MappingReport:
        """Return the report of the run, with the rejection reasons of images outside ``models``."""
        names = {image.name for model in models for image in model.images}
        reasons = {name: reason for name, reason in self.image_reasons.items() if name not in names}
        return MappingReport(reasons, self._pair_reasons, dict(self._seconds), dict(self._counts))

    def state_dict(self) -> StateDict:
        """Return the collected rejection reasons and run times for a checkpoint."""
        return {
            "image_reasons": reasons_to_json(self.image_reasons),
            "pair_reasons": reasons_to_json(self._pair_reasons),
            "seconds": dict(self._seconds),
            "counts": dict(self._counts),
        }

    def load_state_dict(self, state: StateDict) -> None:
        """Restore the collected rejection reasons and run times from a checkpoint."""
        self.image_reasons = reasons_from_json(state["image_reasons"])
        self._pair_reasons = reasons_from_json(state["pair_reasons"])
        self._seconds.update(state["seconds"])
        self._counts.update(state["counts"])


def _initial_reasons(problem: MappingProblem) -> dict[str, Reason]:
    """Return the rejection reason of each image that applies before any registration attempt."""
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
