"""Depth map of one image, with its prior, scale and refined depth."""

from __future__ import annotations

from functools import cached_property
from threading import Lock
from typing import Any, Protocol

import cv2
import numpy as np

from mpsfm_core.data import Bool, DepthPrior, Float32, Float64, Int64, MappingImage, PinholeCamera
from mpsfm_core.geometry import sample_bilinear, sample_nearest, scale_pixels
from mpsfm_core.optimize.depth_integration import Anchors, RefinedDepth
from mpsfm_core.optimize.subsampling import compute_subsampling_step, subsample, upsample
from mpsfm_core.support.disk_arrays import current_store, store_fields

EDGE_WIDTH = 1 / 160
"""Half the width of the square window around a keypoint in which its depth is compared, relative to
the width of the depth map. [ours]"""
MAX_EDGE_RATIO = 1.05
"""A keypoint is at a depth edge if the largest depth in its window is more than this factor times
the smallest. [ours]"""


class RefinesDepth(Protocol):
    """Object that refines the depth map of one image, such as a depth integrator."""

    def refine(self, anchors: Anchors, *, scale: float, start: RefinedDepth | None) -> RefinedDepth:
        """Refine the depth map, see :meth:`DepthIntegrator.refine`."""


class DepthRefinement:
    """Refinement of a depth map that is computed when its result is first used.

    The inputs are stored when the refinement is requested, so the result does not depend on when
    it is computed. The result is stored by :func:`~mpsfm_core.support.disk_arrays.current_store`
    of the thread that requests the refinement.

    Args:
        integrator: Depth integrator of the image.
        anchors: Triangulated points that constrain the depth map.
        scale: Scale of the depth prior.
        previous: Previous refinement of the depth map, from whose result the refinement starts.
    """

    def __init__(
        self,
        integrator: RefinesDepth,
        anchors: Anchors,
        scale: float,
        previous: DepthRefinement | None = None,
    ) -> None:
        self.scale = scale
        self._inputs: tuple[RefinesDepth, Anchors, DepthRefinement | None] | None
        self._inputs = integrator, anchors, previous
        self._result: RefinedDepth | None = None
        self._store = current_store()
        self._lock = Lock()

    @classmethod
    def from_result(cls, result: RefinedDepth) -> DepthRefinement:
        """Build a refinement from its result."""
        refinement = cls.__new__(cls)
        refinement.scale, refinement._inputs = result.scale, None
        refinement._result = store_fields(result, current_store())
        refinement._lock = Lock()
        return refinement

    @property
    def result(self) -> RefinedDepth:
        """The refined depth map, which is computed at the first access."""
        pending = [self]
        while (inputs := pending[-1]._inputs) is not None and inputs[2] is not None:
            pending.append(inputs[2])
        for refinement in reversed(pending):
            refinement._compute()
        assert self._result is not None
        return self._result

    def _compute(self) -> None:
        """Compute the result from the result of the previous refinement."""
        with self._lock:
            if self._inputs is not None:
                integrator, anchors, previous = self._inputs
                start = previous.result if previous else None
                result = integrator.refine(anchors, scale=self.scale, start=start)
                self._result = store_fields(result, self._store)
                self._inputs = None

    def depth(self, prior: DepthPrior) -> Float32:
        """Return the refined depth on the pixel grid of the prior, in world units.

        If the depth was refined on a subsampled grid, its log ratio to the prior is interpolated.
        """
        refined = self.result
        if refined.log_depth.shape == prior.shape:
            return refined.depth
        step = compute_subsampling_step(prior.shape[1], refined.log_depth.shape[1])
        depth, valid = subsample(prior.depth, step), subsample(prior.valid, step)
        change = refined.log_depth - np.log(refined.scale * np.where(valid, depth, 1.0))
        factor = np.exp(upsample(change, valid, prior.shape))
        upsampled: Float32 = prior.depth * np.float32(refined.scale) * factor
        return upsampled

    def __reduce__(self) -> tuple[object, tuple[RefinedDepth]]:
        """Store only the result in a pickle."""
        return DepthRefinement.from_result, (self.result,)


class ResumedRefinement(DepthRefinement):
    """Refined depth map of an earlier reconstruction, from which later refinements start.

    The map is subsampled whenever it is used, because that is cheaper than storing it again.

    Args:
        depth: Refined depth map, on the pixel grid of the depth prior.
        factor: Factor from the unit of ``depth`` to world units.
        scale: Scale of the depth prior.
        width: Width to which depth maps are subsampled for refinement.
    """

    def __init__(self, depth: DepthPrior, factor: float, scale: float, width: int) -> None:
        self.scale = scale
        self._inputs, self._lock = None, Lock()
        self._depth, self._factor, self._width = depth, np.float32(factor), width

    @property
    def result(self) -> RefinedDepth:
        """The subsampled depth map."""
        step = compute_subsampling_step(self._depth.shape[1], self._width)
        values = subsample(self._depth.depth, step) * self._factor
        valid = subsample(self._depth.valid, step)
        known = values[valid].astype(np.float64)
        log_depth = np.full(values.shape, np.log(np.median(known)) if len(known) else 0.0)
        log_depth[valid] = np.log(known)
        return RefinedDepth.from_log_depth(log_depth, valid, self.scale)

    def depth(self, prior: DepthPrior) -> Float32:
        """Return the refined depth map (h, w) in world units, at the resolution of the prior."""
        depth: Float32 = self._depth.depth * self._factor
        return depth


class LazyDepth(DepthPrior):
    """Depth map of a reconstruction, which is refined when its depth is first read.

    The object then becomes an ordinary :class:`~mpsfm_core.data.DepthPrior`, whose arrays are
    stored by :func:`~mpsfm_core.support.disk_arrays.current_store` of the thread that made the
    object.

    Args:
        prior: Unscaled depth prior, or the depth map of a reconstruction in other units.
        refinement: Refinement of the depth map, or None to use the scaled prior.
        scale: Scale of the depth prior, in world units per unit of the prior.
        metric: True if the world unit is the meter.
    """

    def __init__(
        self, prior: DepthPrior, refinement: DepthRefinement | None, scale: float, *, metric: bool
    ) -> None:
        # the arrays of the base class stay undefined, so that reading them calls __getattr__
        inputs = prior, refinement, scale, current_store()
        vars(self).update(metric=metric, _inputs=inputs, _lock=Lock())

    def __getattr__(self, name: str) -> Any:
        """Compute depth, variance and mask at the first access."""
        if name not in ("depth", "variance", "valid"):
            raise AttributeError(name)
        self.compute()
        return vars(self)[name]

    def compute(self) -> None:
        """Compute and store depth, variance and mask, unless they are computed."""
        lock = vars(self).get("_lock")
        if lock is not None:
            with lock:
                self._compute()

    def without_scale(self) -> tuple[DepthPrior, float]:
        """Return a depth map, and the factor that scales it to this one; nothing is computed."""
        prior, refinement, scale, _ = vars(self).get("_inputs", (self, None, 1.0, None))
        return (prior, scale) if refinement is None else (self, 1.0)

    def _compute(self) -> None:
        """Scale depth to world units, with the relative variance of the prior."""
        if "_inputs" not in vars(self):
            return
        prior, refinement, scale, store = vars(self)["_inputs"]
        depth = prior.depth
        if refinement is not None:
            depth, scale = refinement.depth(prior), scale / refinement.scale
        depth = depth * np.float32(scale)
        ratio = depth / np.where(prior.valid, prior.depth, np.float32(1))
        variance = None if prior.variance is None else prior.variance * ratio**2
        result = DepthPrior.from_arrays(depth, variance, prior.valid, metric=self.metric)
        vars(self).update(vars(store_fields(result, store)))
        del vars(self)["_inputs"], vars(self)["_lock"]
        object.__setattr__(self, "__class__", DepthPrior)

    def __reduce__(self) -> tuple[object, ...]:
        """Store depth, variance and mask in a pickle."""
        return DepthPrior, (self.depth, self.variance, self.valid, self.metric)


class DepthMap:
    """Depth of an image in world units, from the refined map or else from the scaled prior.

    Attributes:
        prior: Unscaled depth prior of the image.
        normals: Normal prior.
        camera: Intrinsics in pixels of the depth map.
        scale: Scale of the depth prior, in world units per unit of the prior.
        active: True if the scale of the depth prior has been estimated.
        refinement: Last refinement of the depth map, or None before refinement.
        keypoints: (n, 2) float64 keypoints in pixels of the depth map.
        keypoint_valid: (n,) bool mask of the keypoints around which the depth prior is valid.
        keypoint_log_std: (n,) float64 standard deviation of the log depth at the keypoints.
        typical_log_std: Median of ``keypoint_log_std`` where valid, NaN without valid keypoints.
    """

    def __init__(self, image: MappingImage) -> None:
        self.prior: DepthPrior = image.depth
        self.normals = image.normals
        rows, columns = image.depth.shape
        self.camera = image.camera.resized(columns, rows)
        self.keypoints: Float64 = scale_pixels(image.keypoints, image.camera.size, self.camera.size)
        self._prior_at, self.keypoint_valid = self._sample(image.depth.depth)
        self.keypoint_log_std: Float64 = self._sample(self.log_std)[0]
        known = self.keypoint_log_std[self.keypoint_valid]
        self.typical_log_std = float(np.median(known)) if len(known) else np.nan
        self.scale = 1.0
        self.active = False
        self.refinement: DepthRefinement | None = None
        self._refined_at: Float64 | None = None

    @property
    def log_std(self) -> Float32:
        """(h, w) float32 standard deviation of the log depth prior, 0 where invalid."""
        variance = self.prior.variance
        assert variance is not None  # MappingImage checks it
        std = np.sqrt(variance) / np.maximum(self.prior.depth, 1e-12)
        return np.where(self.prior.valid, std, 0).astype(np.float32)

    @property
    def valid(self) -> Bool:
        """(h, w) bool mask of the pixels with a valid depth prior."""
        return self.prior.valid

    @property
    def depth(self) -> Float32:
        """(h, w) float32 refined depth, or scaled depth prior, in world units."""
        if self.refinement is None:
            return self.scaled_prior
        refined = self.refinement.depth(self.prior)
        depth: Float32 = refined * np.float32(self.scale / self.refinement.scale)
        return depth

    @property
    def scaled_prior(self) -> Float32:
        """(h, w) float32 scaled depth prior, in world units."""
        depth: Float32 = self.prior.depth * np.float32(self.scale)
        return depth

    @property
    def variance(self) -> Float32:
        """(h, w) float32 declared variance of :attr:`depth`, in squared world units."""
        variance: Float32 = (self.log_std * self.depth) ** 2
        return variance

    @cached_property
    def keypoint_at_edge(self) -> Bool:
        """(n,) bool mask of the keypoints at edges of the depth prior, or near invalid depth."""
        columns = self.camera.width
        kernel = np.ones((2 * max(1, round(EDGE_WIDTH * columns)) + 1,) * 2)
        depth = np.where(self.prior.valid, self.prior.depth, np.float32(0))
        ratio = cv2.dilate(depth, kernel) / np.maximum(cv2.erode(depth, kernel), 1e-12)
        at_edge: Bool = sample_nearest(ratio > MAX_EDGE_RATIO, self.keypoints)
        return at_edge

    def prior_at_keypoints(self, rows: Int64 | slice = slice(None)) -> Float64:
        """Return the unscaled depth prior (m,) at keypoints with a valid depth prior."""
        return self._prior_at[rows]

    def at_keypoints(self, rows: Int64 | slice = slice(None)) -> Float64:
        """Return the depth (m,) in world units at keypoints with a valid depth prior."""
        if self.refinement is None:
            return self._prior_at[rows] * self.scale
        if self._refined_at is None:
            self._refined_at = self._sample(self.refinement.depth(self.prior))[0]
        return self._refined_at[rows] * (self.scale / self.refinement.scale)

    def set_scale(self, scale: float) -> None:
        """Set the scale of the depth prior, and rescale the refined depth by the same factor."""
        self.scale, self.active = scale, True

    def set_refinement(self, refinement: DepthRefinement) -> None:
        """Replace the scaled depth prior by the result of a refinement."""
        self.refinement, self._refined_at = refinement, None
        self.set_scale(refinement.scale)

    def resume(self, depth: DepthPrior, scale: float, width: int) -> None:
        """Load the refined depth map of a reconstruction.

        Args:
            depth: Refined depth in world units, on the pixel grid of the depth prior.
            scale: Scale of the depth prior.
            width: Width to which depth maps are subsampled for refinement.
        """
        depth, factor = depth.without_scale() if isinstance(depth, LazyDepth) else (depth, 1.0)
        self.set_refinement(ResumedRefinement(depth, factor, scale, width))

    def set_camera(self, camera: PinholeCamera) -> None:
        """Set the intrinsics of the depth map from a camera in pixels of the image."""
        rows, columns = self.prior.shape
        self.camera = camera.resized(columns, rows)

    def reset(self) -> None:
        """Discard the scale and the refined depth of the depth map."""
        self.scale, self.active, self.refinement = 1.0, False, None
        self._refined_at = None

    def _sample(self, values: Float32) -> tuple[Float64, Bool]:
        return sample_bilinear(values, self.prior.valid, self.keypoints)
