"""Depth map of one image, with its prior, scale and refined depth."""

from __future__ import annotations

import numpy as np

from mpsfm_core.data import Bool, DepthPrior, Float32, Float64, Int64, MappingImage, PinholeCamera
from mpsfm_core.geometry import sample_bilinear, scale_pixels
from mpsfm_core.optimize.depth_integration import RefinedDepth
from mpsfm_core.optimize.subsampling import compute_subsampling_step, subsample, upsample


class DepthMap:
    """Depth of an image in world units, from the refined map or else from the scaled prior.

    Attributes:
        prior: Unscaled depth prior of the image.
        normals: Normal prior.
        camera: Intrinsics in pixels of the depth map.
        scale: Scale of the depth prior, in world units per unit of the prior.
        active: True if the scale of the depth prior has been estimated.
        refined: Refined depth of the image, or None before refinement.
        log_std: (h, w) float32 standard deviation of the log depth prior, 0 where invalid.
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
        variance = image.depth.variance
        assert variance is not None  # MappingImage checks it
        self.log_std: Float32 = np.where(
            image.depth.valid, np.sqrt(variance) / np.maximum(image.depth.depth, 1e-12), 0
        ).astype(np.float32)
        self._prior_at, self.keypoint_valid = self._sample(image.depth.depth)
        self.keypoint_log_std: Float64 = self._sample(self.log_std)[0]
        known = self.keypoint_log_std[self.keypoint_valid]
        self.typical_log_std = float(np.median(known)) if len(known) else np.nan
        self.scale = 1.0
        self.active = False
        self.refined: RefinedDepth | None = None
        self._use_prior()

    @property
    def valid(self) -> Bool:
        """(h, w) bool mask of the pixels with a valid depth prior."""
        return self.prior.valid

    @property
    def depth(self) -> Float32:
        """(h, w) float32 refined depth, or scaled depth prior, in world units."""
        depth: Float32 = self._best * np.float32(self._factor)
        return depth

    @property
    def variance(self) -> Float32:
        """(h, w) float32 declared variance of :attr:`depth`, in squared world units."""
        variance: Float32 = (self.log_std * self.depth) ** 2
        return variance

    def prior_at_keypoints(self, rows: Int64 | slice = slice(None)) -> Float64:
        """Return the unscaled depth prior (m,) at keypoints with a valid depth prior."""
        return self._prior_at[rows]

    def at_keypoints(self, rows: Int64 | slice = slice(None)) -> Float64:
        """Return the depth (m,) in world units at keypoints with a valid depth prior."""
        return self._best_at[rows] * self._factor

    def set_scale(self, scale: float) -> None:
        """Set the scale of the depth prior, and rescale the refined depth by the same factor."""
        self.scale, self.active = scale, True
        self._factor = scale / self.refined.scale if self.refined else scale

    def set_refined(self, refined: RefinedDepth) -> None:
        """Replace the scaled depth prior by refined depth.

        If the depth was refined on a subsampled grid, its log ratio to the prior is interpolated.
        """
        self.refined = refined
        self._best = refined.depth
        if refined.log_depth.shape != self.prior.shape:
            step = compute_subsampling_step(self.prior.shape[1], refined.log_depth.shape[1])
            depth, valid = subsample(self.prior.depth, step), subsample(self.prior.valid, step)
            change = refined.log_depth - np.log(refined.scale * np.where(valid, depth, 1.0))
            factor = np.exp(upsample(change, valid, self.prior.shape))
            self._best = self.prior.depth * np.float32(refined.scale) * factor
        self._best_at = self._sample(self._best)[0]
        self.set_scale(refined.scale)

    def resume(self, depth: DepthPrior, scale: float, width: int) -> None:
        """Load the refined depth map of a reconstruction.

        Args:
            depth: Refined depth in world units, on the pixel grid of the depth prior.
            scale: Scale of the depth prior.
            width: Width to which depth maps are subsampled for refinement.
        """
        step = compute_subsampling_step(depth.shape[1], width)
        values, valid = subsample(depth.depth, step), subsample(depth.valid, step)
        known = values[valid].astype(np.float64)
        log_depth = np.full(values.shape, np.log(np.median(known)) if len(known) else 0.0)
        log_depth[valid] = np.log(known)
        self.set_refined(RefinedDepth.from_log_depth(log_depth, valid, scale))

    def set_camera(self, camera: PinholeCamera) -> None:
        """Set the intrinsics of the depth map from a camera in pixels of the image."""
        rows, columns = self.prior.shape
        self.camera = camera.resized(columns, rows)

    def reset(self) -> None:
        """Discard the scale and the refined depth of the depth map."""
        self.scale, self.active, self.refined = 1.0, False, None
        self._use_prior()

    def _use_prior(self) -> None:
        self._best, self._best_at, self._factor = self.prior.depth, self._prior_at, self.scale

    def _sample(self, values: Float32) -> tuple[Float64, Bool]:
        return sample_bilinear(values, self.prior.valid, self.keypoints)
