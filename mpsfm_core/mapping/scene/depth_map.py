"""The depth of one image: its prior, its scale in the world, and its refined form."""

from __future__ import annotations

import numpy as np

from mpsfm_core.data import Bool, DepthPrior, Float32, Float64, Int64, MappingImage, PinholeCamera
from mpsfm_core.geometry import sample_bilinear, scale_pixels
from mpsfm_core.optimize.depth_integration import RefinedDepth
from mpsfm_core.optimize.subsampling import compute_subsampling_step, subsample, upsample


class DepthMap:
    """Prior depth of an image and what the reconstruction has made of it.

    The prior is ``scale`` times itself in world units. Once refined, ``refined`` stands for it.

    Attributes:
        camera: intrinsics of the map's grid.
        keypoints: (n, 2) float64, the image's keypoints in pixels of the grid.
        keypoint_valid: (n,) bool, the prior is valid around the keypoint.
        active: whether the scale has been set, so that the depth means something in the world.
        keypoint_log_std: (n,) float64, std of the prior's log depth at the keypoints.
        typical_log_std: its median where the prior is valid; NaN without such a keypoint.
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
        """(h, w) bool, where the prior is valid."""
        return self.prior.valid

    @property
    def depth(self) -> Float32:
        """(h, w) float32, the best depth known, world units."""
        depth: Float32 = self._best * np.float32(self._factor)
        return depth

    @property
    def variance(self) -> Float32:
        """(h, w) float32, variance of :attr:`depth` by the prior's declaration, world units^2."""
        variance: Float32 = (self.log_std * self.depth) ** 2
        return variance

    def prior_at_keypoints(self, rows: Int64 | slice = slice(None)) -> Float64:
        """Unscaled prior depth at keypoints; meaningful where :attr:`keypoint_valid`."""
        return self._prior_at[rows]

    def at_keypoints(self, rows: Int64 | slice = slice(None)) -> Float64:
        """Best depth at keypoints, world units; meaningful where :attr:`keypoint_valid`."""
        return self._best_at[rows] * self._factor

    def set_scale(self, scale: float) -> None:
        """Change the prior's scale; a refined map is scaled along."""
        self.scale, self.active = scale, True
        self._factor = scale / self.refined.scale if self.refined else scale

    def set_refined(self, refined: RefinedDepth) -> None:
        """Let a refined map stand for the prior.

        Of a map refined on a thinned grid, the change of the prior is interpolated.
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

    def set_camera(self, camera: PinholeCamera) -> None:
        """Use other intrinsics, given for the image's own grid."""
        rows, columns = self.prior.shape
        self.camera = camera.resized(columns, rows)

    def reset(self) -> None:
        """Forget scale and refinement."""
        self.scale, self.active, self.refined = 1.0, False, None
        self._use_prior()

    def _use_prior(self) -> None:
        self._best, self._best_at, self._factor = self.prior.depth, self._prior_at, self.scale

    def _sample(self, values: Float32) -> tuple[Float64, Bool]:
        return sample_bilinear(values, self.prior.valid, self.keypoints)
