"""The dense stage: from a finished reconstruction to one with measured depth."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np

from mpsfm_core.data import Bool, DepthPrior, View
from mpsfm_core.dense.consistency import Agreement, compare_depth, splat_depth
from mpsfm_core.dense.options import DenseOptions
from mpsfm_core.dense.posterior import Observed, posterior, with_known
from mpsfm_core.dense.source_views import choose_sources
from mpsfm_core.dense.stereo import StereoDepth, match_depth
from mpsfm_core.dense.view import DenseView
from mpsfm_core.scene.reconstruction import Reconstruction, RegisteredImage

_MAX_COST = 0.9
"""Of depth that counts as measured: black photos agree on everything (ours)."""
_NOISE_FACTOR = 1.25
"""Of the noise that differences between views speak for: they share errors of poses (ours)."""
_SEEN_STDS = 1.5
"""Depth seen from elsewhere counts up to so many std of the known depth from it: what is further
may be seen past an edge (ours)."""
_SEEN_FACTOR = 3.0
"""Its std in that of the view's own matches (ours)."""


@dataclass(frozen=True)
class DenseReport:
    """For people and the summary: ``sources``: image name -> the views it was matched with;
    ``confirmed``: image name -> share of its pixels whose depth other views confirm."""

    sources: dict[str, list[str]]
    confirmed: dict[str, float]


def densify(
    reconstruction: Reconstruction,
    view_of: Callable[[str], View],
    options: DenseOptions,
    workers: int | None = None,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> tuple[Reconstruction, DenseReport]:
    """The reconstruction with depth that was measured in the photos where that is possible.

    ``view_of``: undistorted view by name. ``workers``: images at once, None for one a core; what
    comes out does not depend on it. ``progress``: is told how many images of how many are matched.
    Images that no other one overlaps keep their maps, and so do those without confirmed pose.
    """
    posed = [row for row, image in enumerate(reconstruction.images) if image.confirmed]
    images = [reconstruction.images[row] for row in posed]
    sources = choose_sources(images, options.num_sources)
    views = _Views(images, view_of, options.max_size)

    def matched(row: int) -> StereoDepth:
        return match_depth(views[row], [views[other] for other in sources[row]], options)

    rows = [row for row, others in enumerate(sources) if others]
    found: dict[int, StereoDepth] = {}
    with ThreadPoolExecutor(workers or os.cpu_count()) as pool:
        for row, stereo in zip(rows, pool.map(matched, rows), strict=True):
            found[row] = stereo
            progress(len(found), len(rows))
    agreed = {row: _compared(row, views, found, sources) for row in found}
    maps = list(reconstruction.images)
    for row in found:
        known = Observed(views[row].log_depth, views[row].log_std)
        measured = with_known(_measured(row, views, found, agreed), known)
        joined = posterior(known, measured, options.correlation_px)
        maps[posed[row]] = _with_depth(images[row], views[row], joined)
    names = [image.name for image in images]
    report = DenseReport(
        {names[row]: [names[other] for other in others] for row, others in enumerate(sources)},
        {name: _share(agreed.get(row)) for row, name in enumerate(names)},
    )
    return replace(reconstruction, images=tuple(maps)), report


def _share(agreement: Agreement | None) -> float:
    return 0.0 if agreement is None else float(agreement.confirmed.mean())


class _Views:
    """Photos on the grid of the stage, made when they are needed."""

    def __init__(
        self, images: Sequence[RegisteredImage], view_of: Callable[[str], View], max_size: int
    ) -> None:
        self._images, self._view_of, self._max_size = images, view_of, max_size
        self._made: dict[int, DenseView] = {}

    def __getitem__(self, row: int) -> DenseView:
        if row not in self._made:
            image = self._images[row]
            self._made[row] = DenseView.of(image, self._view_of(image.name), self._max_size)
        return self._made[row]


def _compared(
    row: int, views: _Views, found: dict[int, StereoDepth], sources: list[list[int]]
) -> Agreement:
    """A map beside those of its sources."""
    own = found[row]
    others = [
        (views[other], found[other].log_depth, found[other].log_std)
        for other in sources[row]
        if other in found
    ]
    return compare_depth(views[row], own.log_depth, own.log_std, others)


def _measured(
    row: int, views: _Views, found: dict[int, StereoDepth], agreed: dict[int, Agreement]
) -> Observed:
    """What the photos say of a view: its own depth where others agree, and where they do not the
    depth of others' confirmed pixels, if that is about what was known."""
    view, agreement = views[row], agreed[row]
    confirmed = agreement.confirmed & _supported(view, found[row])
    log_depth = found[row].log_depth + agreement.mean_change
    std = np.hypot(found[row].log_std, np.float32(_NOISE_FACTOR * agreement.noise))
    others = [
        (
            views[other],
            found[other].log_depth,
            agreed[other].confirmed & _supported(views[other], found[other]),
        )
        for other in found
        if other != row
    ]
    seen = splat_depth(view, others)
    usable = ~confirmed & (np.abs(seen - view.log_depth) < _SEEN_STDS * view.log_std)
    return Observed(
        np.where(usable, seen, log_depth).astype(np.float32),
        np.where(usable, _SEEN_FACTOR * std, np.where(confirmed, std, np.inf)).astype(np.float32),
    )


def _supported(view: DenseView, stereo: StereoDepth) -> Bool:
    """Where the photo may be used and says anything."""
    return view.usable & (stereo.cost < _MAX_COST)


def _with_depth(image: RegisteredImage, view: DenseView, joined: Observed) -> RegisteredImage:
    depth = np.exp(joined.log_depth)
    variance = (joined.log_std * depth) ** 2
    prior = DepthPrior.from_arrays(depth, variance, view.usable, metric=image.depth.metric)
    return replace(image, depth=prior)
