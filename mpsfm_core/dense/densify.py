"""The dense stage: from a finished reconstruction to one with measured depth."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, NamedTuple, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from mpsfm_core.data import Bool, DepthPrior, Float32, View
from mpsfm_core.dense.dense_view import DenseView, PosedGrid
from mpsfm_core.dense.depth_posterior import (
    MIN_STD,
    UNKNOWN_LOG_STD,
    LogDepthMap,
    compute_depth_posterior,
    fuse_known_depth,
)
from mpsfm_core.dense.epipolar_error import estimate_pose_error_px, measure_patch_offsets
from mpsfm_core.dense.geometric_consistency import (
    DepthDifferences,
    GeometricConsistency,
    PosedDepth,
    compare_depths,
    evaluate_consistency,
    splat_depth,
)
from mpsfm_core.dense.options import DenseOptions
from mpsfm_core.dense.scale_uncertainty import (
    ScaleConstraints,
    estimate_scale_stds,
    measure_scale_constraints,
)
from mpsfm_core.dense.stereo import StereoDepth, match_stereo_depth
from mpsfm_core.dense.view_selection import select_source_views
from mpsfm_core.geometry import resize_map
from mpsfm_core.mapping.scene.reconstruction import Reconstruction, RegisteredImage
from mpsfm_core.support.threads import allowed

_T = TypeVar("_T", bound=np.generic)
_MAX_COST = 0.9
"""Of depth that counts as measured: black photos agree on everything (ours)."""
_SEEN_STDS = 1.5
"""Depth seen from elsewhere counts up to so many std of the known depth from it: what is further
may be seen past an edge (ours)."""
_SEEN_FROM = 16
"""Views whose depth is seen in a view, at most, so that time grows with the number of photos."""
_KEPT_ROUNDS = 4
"""Photos that are kept, in those that are matched with one: neighbours share them."""
_SEEN_FACTOR = 3.0
"""Its std in that of the view's own matches (ours)."""


@dataclass(frozen=True)
class DenseReport:
    """``sources``: image name -> the views it was matched with; ``confirmed``: image name -> share
    of its pixels whose depth other views confirm; ``measured``: image name -> (h, w) bool, where
    the photos say something about depth, and not the map before alone."""

    sources: dict[str, list[str]]
    confirmed: dict[str, float]
    measured: dict[str, Bool]

    def describe(self) -> dict[str, Any]:
        """For the summary."""
        return {"sources": self.sources, "confirmed": self.confirmed}


class ArrayStore(Protocol):
    """Gives an array of the same values that is held instead, in memory or elsewhere."""

    def __call__(self, array: NDArray[_T]) -> NDArray[_T]: ...


def in_memory(array: NDArray[_T]) -> NDArray[_T]:
    """The array itself."""
    return array


class StereoCheckpoints(Protocol):
    """Keeps what was found in the photos, for a run that goes on after it was killed."""

    def load(self, name: str) -> StereoDepth | None:
        """Of an image with the same reconstruction, photos and options; None if there is none."""

    def save(self, name: str, depth: StereoDepth) -> None:
        """ArrayStore that of an image; called from several threads."""


def densify(
    reconstruction: Reconstruction,
    view_of: Callable[[str], View],
    options: DenseOptions,
    workers: int | None = None,
    progress: Callable[[int, int], None] = lambda done, total: None,
    checkpoints: StereoCheckpoints | None = None,
    store_array: ArrayStore = in_memory,
    poses_use_depth: bool = True,
) -> tuple[Reconstruction, DenseReport]:
    """The reconstruction with depth that was measured in the photos where that is possible.

    ``view_of``: undistorted view by name. ``workers``: images at once, None for as many as the run
    may use; what comes out does not depend on it. ``progress``: is told how many images of how many
    are matched. ``checkpoints``: has what a run that was killed found, and keeps what this finds.
    ``store_array``: holds maps, those of the result too; called from several threads. ``poses_use_depth``:
    the mapper found the poses with the depth of these images, so that scales of pairs may hang
    together by it alone; else poses are taken to be right.
    Images that no other one overlaps store_array their maps, and so do those without confirmed pose.
    """
    posed = [row for row, image in enumerate(reconstruction.images) if image.confirmed]
    images = [reconstruction.images[row] for row in posed]
    near = select_source_views(images, max(options.num_sources, _SEEN_FROM))
    sources = [others[: options.num_sources] for others in near]
    compared_with = _compared_with(sources)
    views = _ViewCache(images, view_of, options)

    def matched(row: int) -> _MatchedImage:
        view, name = views[row], images[row].name
        stereo = checkpoints.load(name) if checkpoints else None
        if stereo is None:
            stereo = match_stereo_depth(view, [views[other] for other in sources[row]], options)
            if checkpoints:
                checkpoints.save(name, stereo)
        # where the photo may be used and says anything
        supported = view.usable & (stereo.cost < _MAX_COST)
        return _MatchedImage(view.grid, store_array(stereo.log_depth), stereo.parallax, store_array(supported))

    def compared(row: int) -> tuple[GeometricConsistency, ScaleConstraints | None]:
        own, differences = found[row], _differences(row, found, compared_with[row], options)
        patches = {
            j: measure_patch_offsets(views[row], own.log_depth, views[j], each.agree)
            for j, each in differences.items()
        }
        agreeing = {
            j: each.log_depth
            for j, each in differences.items()
            if not each.by_chance(patches[j].found)
        }
        of_poses = estimate_pose_error_px(patches[j] for j in agreeing)
        agreement = evaluate_consistency(own.parallax_px, agreeing.values(), of_poses)
        ties = _ties(own, agreeing, views[row], options) if poses_use_depth else None
        return _kept(agreement, store_array), ties

    def finished(row: int) -> tuple[RegisteredImage, Bool]:
        view = views[row]
        known = LogDepthMap(view.log_depth, view.log_std)
        measured = fuse_known_depth(_measured(row, view, found, agreed, near[row], options), known)
        joined = compute_depth_posterior(known, measured, options.correlation_px)
        image = _with_depth(images[row], view, joined, scale_std.get(row, 0.0), store_array)
        return image, store_array(measured.known)

    rows = [row for row, others in enumerate(sources) if others]
    found: dict[int, _MatchedImage] = {}
    with ThreadPoolExecutor(workers or allowed()) as pool:
        for row, own in zip(rows, pool.map(matched, rows), strict=True):
            found[row] = own
            progress(len(found), len(rows))
        judged = dict(zip(rows, pool.map(compared, rows), strict=True))
        agreed = {row: agreement for row, (agreement, _) in judged.items()}
        scale_std = estimate_scale_stds({row: ties for row, (_, ties) in judged.items() if ties})
        maps, which = list(reconstruction.images), {}
        for row, (image, measured) in zip(rows, pool.map(finished, rows), strict=True):
            maps[posed[row]], which[image.name] = image, measured
    names = [image.name for image in images]
    report = DenseReport(
        {names[row]: [names[other] for other in others] for row, others in enumerate(sources)},
        {name: _share(agreed.get(row)) for row, name in enumerate(names)},
        which,
    )
    return replace(reconstruction, images=tuple(maps)), report


def _share(agreement: GeometricConsistency | None) -> float:
    return 0.0 if agreement is None else float(agreement.confirmed.mean())


class _ViewCache:
    """Photos on the grid of the stage, made when they are needed; the last ones are kept."""

    def __init__(
        self,
        images: Sequence[RegisteredImage],
        view_of: Callable[[str], View],
        options: DenseOptions,
    ) -> None:
        self._images, self._view_of, self._options = images, view_of, options
        self._made = lru_cache(_KEPT_ROUNDS * (1 + options.num_sources))(self._make)

    def __getitem__(self, row: int) -> DenseView:
        return self._made(row)

    def _make(self, row: int) -> DenseView:
        image = self._images[row]
        return DenseView.of(image, self._view_of(image.name), self._options.max_size)


class _MatchedImage(NamedTuple):
    """What is kept of a matched photo: ``supported`` (h, w) says where it says anything."""

    grid: PosedGrid
    log_depth: Float32
    parallax: Float32
    supported: Bool

    def log_std(self, std_px: float | Float32) -> Float32:
        """Of a match that is as sure, (h, w)."""
        std: Float32 = np.float32(std_px) / self.parallax_px
        return std

    @property
    def parallax_px(self) -> Float32:
        """Of each pixel, (h, w)."""
        return resize_map(self.parallax, *self.grid.camera.size)

    def posed_depth(self, options: DenseOptions) -> PosedDepth:
        """What was found."""
        return PosedDepth(self.grid, self.log_depth, self.log_std(options.match_std_px))


def _compared_with(sources: Sequence[Sequence[int]]) -> list[list[int]]:
    """Of each view its sources, and those whose source it is, in order."""
    beside = [set(others) for others in sources]
    for row, others in enumerate(sources):
        for other in others:
            beside[other].add(row)
    return [sorted(others) for others in beside]


def _differences(
    row: int, found: Mapping[int, _MatchedImage], others: Sequence[int], options: DenseOptions
) -> dict[int, DepthDifferences]:
    """From a map to those of other views, where it is supported."""
    own = found[row].posed_depth(options)
    return {
        other: compare_depths(own, found[other].posed_depth(options)).where(found[row].supported)
        for other in others
        if other in found
    }


def _kept(agreement: GeometricConsistency, store_array: ArrayStore) -> GeometricConsistency:
    return replace(agreement, views=store_array(agreement.views), mean_change=store_array(agreement.mean_change))


def _ties(
    own: _MatchedImage, differences: Mapping[int, Float32], view: DenseView, options: DenseOptions
) -> ScaleConstraints:
    """A map beside those of others and the depth that was known of the ``view``."""
    known = view.log_std < UNKNOWN_LOG_STD
    std = float(np.median(view.log_std[known])) if known.any() else UNKNOWN_LOG_STD
    change = own.log_depth - view.log_depth
    return measure_scale_constraints(differences, change, std, options.correlation_px)


def _measured(
    row: int,
    view: DenseView,
    found: Mapping[int, _MatchedImage],
    agreed: Mapping[int, GeometricConsistency],
    near: Sequence[int],
    options: DenseOptions,
) -> LogDepthMap:
    """What the photos say of a view: its own depth where others agree, and where they do not the
    depth of others' confirmed pixels, if that is about what was known."""
    own, agreement = found[row], agreed[row]
    confirmed = agreement.confirmed
    log_depth = own.log_depth + agreement.mean_change
    std = own.log_std(agreement.std_px if confirmed.any() else options.match_std_px)
    std = np.maximum(std, np.float32(MIN_STD))
    others = (
        (found[j].grid, found[j].log_depth, agreed[j].confirmed) for j in sorted(near) if j in found
    )
    seen = splat_depth(own.grid, others)
    usable = ~confirmed & (np.abs(seen - view.log_depth) < _SEEN_STDS * view.log_std)
    return LogDepthMap(
        np.where(usable, seen, log_depth).astype(np.float32),
        np.where(usable, _SEEN_FACTOR * std, np.where(confirmed, std, np.inf)).astype(np.float32),
    )


def _with_depth(
    image: RegisteredImage, view: DenseView, joined: LogDepthMap, scale_std: float, store_array: ArrayStore
) -> RegisteredImage:
    depth = np.exp(joined.log_depth)
    variance = (joined.log_std**2 + np.float32(scale_std**2)) * depth**2
    prior = DepthPrior.from_arrays(depth, variance, view.usable, metric=image.depth.metric)
    assert prior.variance is not None
    maps = store_array(prior.depth), store_array(prior.variance), store_array(prior.valid)
    return replace(image, depth=DepthPrior(*maps, metric=prior.metric))
