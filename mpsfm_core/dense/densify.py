"""Densification, which improves depth maps by multi-view stereo where images overlap.

The input depth of an image is the mapper's refined depth map. Densification has five stages. The
first stage selects source views (:mod:`~mpsfm_core.dense.view_selection`). The second stage
computes stereo depth by plane-sweep stereo (:mod:`~mpsfm_core.dense.stereo`). The third stage
checks the consistency of neighboring stereo depth maps
(:mod:`~mpsfm_core.dense.geometric_consistency`). The fourth stage estimates the uncertainty of
poses and depth scales (:mod:`~mpsfm_core.dense.epipolar_error`,
:mod:`~mpsfm_core.dense.scale_uncertainty`). The fifth stage fuses stereo depth with input depth
(:mod:`~mpsfm_core.dense.depth_posterior`), and raises the std next to depth edges
(:mod:`~mpsfm_core.dense.depth_edges`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, NamedTuple, Protocol

import numpy as np

from mpsfm_core.data import Bool, DepthPrior, Float32, View
from mpsfm_core.dense.dense_view import DenseView, PosedGrid
from mpsfm_core.dense.depth_edges import add_edge_variance
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
from mpsfm_core.dense.stereo import (
    WINDOW_RADIUS,
    StereoDepth,
    match_stereo_depth,
    measure_parallax,
)
from mpsfm_core.dense.view_selection import select_source_views
from mpsfm_core.geometry import resize_map
from mpsfm_core.mapping.scene.reconstruction import Reconstruction, RegisteredImage
from mpsfm_core.support.disk_arrays import ArrayStore, current_store, store_fields
from mpsfm_core.support.threads import thread_limit

_NUM_SOURCES = 5
"""Maximum number of source views per reference view. More source views give more complete depth,
but stereo takes longer [ours]."""
_MATCH_STD_PX = 0.5
"""Assumed std of a stereo match in pixels, for the tolerance of the consistency check [ours]."""
_MAX_COST = 0.9
"""Maximum matching cost of a pixel with valid stereo depth [ours]."""
_MIN_COST_GAIN = 0.1
"""Minimum cost gain of a pixel whose depth is known, see :class:`StereoDepth`
[tuned: benchmarks.street]."""
_MAX_SPLAT_STDS = 1.5
"""Maximum log depth difference between projected neighbor depth and input depth, in stds [ours].

Projected neighbor depth that differs more from input depth may belong to another surface behind an
edge."""
_MAX_SPLAT_VIEWS = 16
"""Maximum number of neighboring views whose depth is projected into a view; bounds the run time."""
_NUM_CACHED_NEIGHBORHOODS = 4
"""Number of reference views that the view cache can hold together with their source views."""
_SPLAT_STD_FACTOR = 3.0
"""Ratio of the std of depth projected from neighbors to the std of the view's stereo depth
[ours]."""


@dataclass(frozen=True)
class DenseReport:
    """Source images, confirmed pixel ratios and stereo masks of all densified images."""

    sources: dict[str, list[str]]
    """Image name -> names of the source images for stereo."""
    confirmed: dict[str, float]
    """Image name -> ratio of pixels whose stereo depth another view confirms, in [0, 1]."""
    measured: dict[str, Bool]
    """Image name -> (h, w) mask of pixels whose depth comes from stereo."""

    def describe(self) -> dict[str, Any]:
        """Return the densification entries of `summary.json`."""
        return {"sources": self.sources, "confirmed": self.confirmed}


class StereoCheckpoints(Protocol):
    """Storage of the stereo depth of each image, so that an interrupted run can resume."""

    def load(self, name: str) -> StereoDepth | None:
        """Return the stored stereo depth of an image, or None if there is none.

        Implementations of `load` must check that reconstruction, images and options have not
        changed.
        """

    def save(self, name: str, depth: StereoDepth) -> None:
        """Store the stereo depth of an image; several threads may call this method."""


MatchImages = Callable[[Mapping[str, Sequence[str]]], None]
"""Function that runs stereo matching for images and stores their depth maps. Its argument maps the
name of each reference image to the names of its source images."""


def densify(
    reconstruction: Reconstruction,
    view_of: Callable[[str], View],
    options: DenseOptions,
    workers: int | None = None,
    progress: Callable[[int, int], None] = lambda done, total: None,
    checkpoints: StereoCheckpoints | None = None,
    match_remotely: MatchImages | None = None,
    poses_use_depth: bool = True,
) -> tuple[Reconstruction, DenseReport]:
    """Refine the depth maps of a reconstruction by multi-view stereo.

    Images without confirmed pose, held-out images and images without overlap keep their depth
    maps. The densified depth maps do not depend on the number of threads. Large arrays are stored
    by :func:`~mpsfm_core.support.disk_arrays.current_store`.

    Args:
        reconstruction: Posed images with refined depth maps.
        view_of: Function that returns the undistorted view of an image, by image name.
        options: Options of multi-view stereo.
        workers: Number of worker threads (None uses all threads that the process may use).
        progress: Callback that receives the number of finished images and the number of all images.
        checkpoints: Storage of stereo depth, so that an interrupted run can resume (None stores
            nothing).
        match_remotely: Function that runs stereo in other processes, reports progress, and stores
            the stereo depth that ``checkpoints`` then loads (None runs stereo in threads).
        poses_use_depth: True if depth priors constrained the poses. With depth priors, the scale of
            an image pair may depend on the priors alone, so a scale variance is added to the depth
            variance.

    Returns:
        The reconstruction with densified depth maps, and a report on source images and stereo
        pixels.
    """
    images = reconstruction.dense_images
    steps = _DensifySteps(images, view_of, options, checkpoints, poses_use_depth)
    rows = [row for row, views in enumerate(steps.sources) if views]
    if match_remotely is not None:
        match_remotely({name: views for name, views in steps.source_names.items() if views})
    with ThreadPoolExecutor(workers or thread_limit()) as pool:
        for row, image in zip(rows, pool.map(steps.match_image, rows), strict=True):
            steps.matched[row] = image
            if match_remotely is None:
                progress(len(steps.matched), len(rows))
        checks = dict(zip(rows, pool.map(steps.check_image, rows), strict=True))
        steps.consistency.update({row: result for row, (result, _) in checks.items()})
        constraints = {row: known for row, (_, known) in checks.items() if known}
        steps.scale_stds.update(estimate_scale_stds(constraints))
        dense_images, measured_masks = {}, {}
        for dense_image, mask in pool.map(steps.fuse_image, rows):
            dense_images[dense_image.name], measured_masks[dense_image.name] = dense_image, mask
    all_images = (dense_images.get(image.name, image) for image in reconstruction.images)
    return replace(reconstruction, images=tuple(all_images)), steps.report(measured_masks)


class _DensifySteps:
    """Steps of densification for one image each, which run in parallel threads.

    The attributes ``matched``, ``consistency`` and ``scale_stds`` contain the results of a step for
    all images, which the next step needs.
    """

    def __init__(
        self,
        images: Sequence[RegisteredImage],
        view_of: Callable[[str], View],
        options: DenseOptions,
        checkpoints: StereoCheckpoints | None,
        poses_use_depth: bool,
    ) -> None:
        self._images, self._options, self._checkpoints = images, options, checkpoints
        self._store_array, self._poses_use_depth = current_store(), poses_use_depth
        self._neighbors = select_source_views(images, max(_NUM_SOURCES, _MAX_SPLAT_VIEWS))
        self.sources = [views[:_NUM_SOURCES] for views in self._neighbors]
        self.source_names = {
            image.name: [images[view].name for view in views]
            for image, views in zip(images, self.sources, strict=True)
        }
        self._compared_views = _symmetric_neighbors(self.sources)
        self._views = DenseViewCache(
            {image.name: image for image in images}.__getitem__, view_of, options
        )
        self.matched: dict[int, _MatchedImage] = {}
        self.consistency: dict[int, GeometricConsistency] = {}
        self.scale_stds: dict[int, float] = {}

    def match_image(self, row: int) -> _MatchedImage:
        """Compute or load the stereo depth of an image."""
        view, name = self._view(row), self._images[row].name
        stereo = self._checkpoints.load(name) if self._checkpoints else None
        if stereo is None:
            stereo = self._views.match(name, self.source_names[name])
            if self._checkpoints:
                self._checkpoints.save(name, stereo)
        supported = view.usable & (stereo.cost < _MAX_COST)
        explained = stereo.cost_gain > _MIN_COST_GAIN
        store = self._store_array
        maps = store(stereo.log_depth), stereo.parallax, store(supported), store(explained)
        return _MatchedImage(view.grid, *maps)

    def check_image(self, row: int) -> tuple[GeometricConsistency, ScaleConstraints | None]:
        """Check stereo depth against neighboring views, and measure constraints of the scale."""
        image = self.matched[row]
        differences = _compare_with_views(row, self.matched, self._compared_views[row])
        patches = {
            source: measure_patch_offsets(
                self._view(row), image.log_depth, self._view(source), difference.agree
            )
            for source, difference in differences.items()
        }
        consistent = {
            source: difference.log_depth
            for source, difference in differences.items()
            if not difference.is_coincidental(patches[source].matched_ratio)
        }
        pose_std_px = estimate_pose_error_px(patches[source] for source in consistent)
        view = self._view(row)
        parallax = (
            resize_map(measure_parallax(view, [self._view(source)]), *view.camera.size)
            for source in consistent
        )
        differences_and_parallax = zip(consistent.values(), parallax, strict=True)
        consistency = evaluate_consistency(view.shape, differences_and_parallax, pose_std_px)
        constraints = (
            _measure_constraints(image, consistent, view, self._options)
            if self._poses_use_depth
            else None
        )
        return _store_consistency(consistency, self._store_array), constraints

    def fuse_image(self, row: int) -> tuple[RegisteredImage, Bool]:
        """Fuse stereo depth with input depth, and return the mask of pixels with stereo depth.

        If nothing in the source views matches a pixel near its depth, the pixel shows sky or a
        moving object, or is occluded. The std of its depth is then unknown, and the pixel
        contributes to no cloud or mesh.
        """
        view = self._view(row)
        known = LogDepthMap(view.log_depth, view.log_std)
        stereo = _merge_stereo_depth(
            row, view, self.matched, self.consistency, self._neighbors[row]
        )
        measured = fuse_known_depth(stereo, known)
        posterior = compute_depth_posterior(known, measured, self._options.correlation_px)
        if self._options.check_validity:
            posterior = add_edge_variance(posterior, self.consistency[row].views, WINDOW_RADIUS)
            posterior = posterior.with_min_std(~self.matched[row].explained, UNKNOWN_LOG_STD)
        scale_std = self.scale_stds.get(row, 0.0)
        image = _replace_depth(self._images[row], view, posterior, scale_std, self._store_array)
        return image, self._store_array(measured.known)

    def report(self, measured: dict[str, Bool]) -> DenseReport:
        """Return the report of all images, with the masks of pixels with stereo depth."""
        confirmed = {
            image.name: _confirmed_ratio(self.consistency.get(row))
            for row, image in enumerate(self._images)
        }
        return DenseReport(self.source_names, confirmed, measured)

    def _view(self, row: int) -> DenseView:
        return self._views[self._images[row].name]


def _confirmed_ratio(consistency: GeometricConsistency | None) -> float:
    return 0.0 if consistency is None else float(consistency.confirmed.mean())


class DenseViewCache:
    """Cache of views at stereo resolution, which are loaded on demand by image name.

    Args:
        image_of: Function that returns a registered image with its refined depth map.
        view_of: Function that returns the undistorted view of an image.
        options: Options of multi-view stereo.
    """

    def __init__(
        self,
        image_of: Callable[[str], RegisteredImage],
        view_of: Callable[[str], View],
        options: DenseOptions,
    ) -> None:
        self._image_of, self._view_of, self._options = image_of, view_of, options
        self._cached_load = lru_cache(_NUM_CACHED_NEIGHBORHOODS * (1 + _NUM_SOURCES))(self._load)

    def __getitem__(self, name: str) -> DenseView:
        return self._cached_load(name)

    def match(self, name: str, sources: Sequence[str]) -> StereoDepth:
        """Estimate the stereo depth of an image from its source images."""
        return match_stereo_depth(self[name], [self[source] for source in sources])

    def _load(self, name: str) -> DenseView:
        return DenseView.from_view(
            self._image_of(name), self._view_of(name), self._options.max_size
        )


class _MatchedImage(NamedTuple):
    """Stereo depth of an image for the consistency check and the fusion."""

    grid: PosedGrid
    log_depth: Float32
    """(h, w) natural log of the stereo depth in world units."""
    parallax: Float32
    """:attr:`StereoDepth.parallax`."""
    supported: Bool
    """(h, w) bool, True at pixels with low matching cost that the user does not mask."""
    explained: Bool
    """(h, w) bool, True at pixels that match better at their depth than at infinite depth."""

    def log_std(self, std_px: float | Float32) -> Float32:
        """Convert the std of a match in pixels to the std of log depth (h, w)."""
        std: Float32 = np.float32(std_px) / self.parallax_px
        return std

    @property
    def parallax_px(self) -> Float32:
        """(h, w) motion of projections in the source views, in pixels per unit of log depth."""
        return resize_map(self.parallax, *self.grid.camera.size)

    def posed_depth(self) -> PosedDepth:
        """Return the stereo depth map with its pose and the std of an assumed match error."""
        return PosedDepth(self.grid, self.log_depth, self.log_std(_MATCH_STD_PX))


def _symmetric_neighbors(sources: Sequence[Sequence[int]]) -> list[list[int]]:
    """Return the neighbors of each view, its source views and the views that use it as source."""
    neighbors = [set(views) for views in sources]
    for row, views in enumerate(sources):
        for view in views:
            neighbors[view].add(row)
    return [sorted(views) for views in neighbors]


def _compare_with_views(
    row: int, matched: Mapping[int, _MatchedImage], views: Sequence[int]
) -> dict[int, DepthDifferences]:
    """Compare the stereo depth of an image with the stereo depth of neighboring views."""
    depth = matched[row].posed_depth()
    return {
        view: compare_depths(depth, matched[view].posed_depth()).where(matched[row].supported)
        for view in views
        if view in matched
    }


def _store_consistency(
    consistency: GeometricConsistency, store_array: ArrayStore
) -> GeometricConsistency:
    return replace(
        consistency,
        views=store_array(consistency.views),
        mean_change=store_array(consistency.mean_change),
        parallax_px=store_array(consistency.parallax_px),
    )


def _measure_constraints(
    image: _MatchedImage, differences: Mapping[int, Float32], view: DenseView, options: DenseOptions
) -> ScaleConstraints:
    """Measure how well an image constrains the relative scales of its stereo pairs."""
    known = view.log_std < UNKNOWN_LOG_STD
    std = float(np.median(view.log_std[known])) if known.any() else UNKNOWN_LOG_STD
    change = image.log_depth - view.log_depth
    return measure_scale_constraints(differences, change, std, options.correlation_px)


def _merge_stereo_depth(
    row: int,
    view: DenseView,
    matched: Mapping[int, _MatchedImage],
    consistency: Mapping[int, GeometricConsistency],
    neighbors: Sequence[int],
) -> LogDepthMap:
    """Merge the consistent stereo depth of an image with depth projected from neighbors.

    Pixels that another view confirms use the stereo depth of the image. Unconfirmed pixels use
    confirmed depth projected from neighbors, if this depth is close to the input depth.
    """
    image, confirmed = matched[row], consistency[row].confirmed
    log_depth = image.log_depth + consistency[row].mean_change
    std = image.log_std(consistency[row].std_px if confirmed.any() else _MATCH_STD_PX)
    std = np.where(confirmed, consistency[row].log_std, std)
    std = np.maximum(std, np.float32(MIN_STD))
    neighbor_depths = (
        (matched[j].grid, matched[j].log_depth, consistency[j].confirmed)
        for j in sorted(neighbors)
        if j in matched
    )
    splatted = splat_depth(image.grid, neighbor_depths)
    deviation = np.abs(splatted - view.log_depth)
    use_splatted = ~confirmed & (deviation < _MAX_SPLAT_STDS * view.log_std)
    stereo_std = np.where(confirmed, std, np.inf)
    return LogDepthMap(
        np.where(use_splatted, splatted, log_depth).astype(np.float32),
        np.where(use_splatted, _SPLAT_STD_FACTOR * std, stereo_std).astype(np.float32),
    )


def _replace_depth(
    image: RegisteredImage,
    view: DenseView,
    posterior: LogDepthMap,
    scale_std: float,
    store_array: ArrayStore,
) -> RegisteredImage:
    """Replace the depth map of an image, and add the variance of the depth scale."""
    depth = np.exp(posterior.log_depth)
    variance = (posterior.log_std**2 + np.float32(scale_std**2)) * depth**2
    prior = DepthPrior.from_arrays(depth, variance, view.usable, metric=image.depth.metric)
    return replace(image, depth=store_fields(prior, store_array))
