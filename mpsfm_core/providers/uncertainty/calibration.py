"""The uncertainty model of a prior: what a network says about itself, made trustworthy.

Paper appendix C: the total std is the maximum of the scaled network std, a std proportional to
depth, and a floor. To it come what relative networks need, a common shift that leaves one scale
per image to the mapper, and more variance at depth edges.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from pydantic import Field

from mpsfm_core.data import Bool, DepthPrior, Float64, NormalPrior
from mpsfm_core.data.options import Options
from mpsfm_core.geometry import log_depth_steps

_SMALLEST_VARIANCE = 1e-12
_SMALLEST_SHARE = 0.01
"""Of its median: what a shift makes smaller than that, or negative, is no depth any more."""


class DepthCalibration(Options):
    """``std = max(std_scale * network_std, relative_std * depth, std_floor)``.

    ``std_floor`` is in metres and applies to metric priors only. The defaults are those of
    Metric3D v2 giant2 in the reference (its other backends' values stand in their plugins).

    The variance is that of what remains after each image was given its own scale, as the mapper
    does; an error of the scale of a whole image is not in it.
    """

    std_scale: float = Field(3.33, gt=0)
    """Multiplies the network's std (reference ``prior_std_multiplier``)."""
    relative_std: float = Field(0.0263, ge=0)
    """Std as a share of depth (reference ``depth_uncertainty``)."""
    std_floor: float = Field(0.02, ge=0)
    """Smallest std in metres (paper appendix C: 2 cm)."""
    use_network_variance: bool = True
    """False ignores what the network says of itself."""
    shift: float = 0.0
    """Added to depth or inverse depth, in depth_medians of it over the map; 0 for metric networks."""
    shift_space: Literal["depth", "disparity"] = "depth"
    """What ``shift`` is added to: disparity for networks that predict affine inverse depth."""
    edge_ratio: float | None = Field(None, gt=1)
    """A pixel beside a larger ratio of neighbouring depths lies on an edge (reference, for
    normals: 1.015); null knows no edges."""
    edge_std_scale: float = Field(1.0, ge=1)
    """Multiplies the std of pixels on an edge."""

    def apply(self, prior: DepthPrior) -> DepthPrior:
        """The prior shifted and with its total variance; every valid pixel has one."""
        shifted = self.shifted(prior)
        depth = shifted.depth.astype(np.float64)
        std = self.relative_std * depth
        if prior.metric:
            std = np.maximum(std, self.std_floor)
        if shifted.variance is not None and self.use_network_variance:
            std = np.maximum(std, self.std_scale * np.sqrt(np.maximum(shifted.variance, 0)))
        if self.edge_ratio is not None:
            edges = log_depth_steps(prior.depth, prior.valid) > np.log(self.edge_ratio)
            std = np.where(edges, self.edge_std_scale * std, std)
        variance = np.where(shifted.valid, np.maximum(std**2, _SMALLEST_VARIANCE), 0.0)
        return DepthPrior(shifted.depth, variance.astype(np.float32), shifted.valid, shifted.metric)

    def shifted(self, prior: DepthPrior) -> DepthPrior:
        """The prior with :attr:`shift` applied to depth and network variance."""
        if self.shift == 0 or not prior.valid.any():
            return prior
        depth = np.where(prior.valid, prior.depth, np.float32(1)).astype(np.float64)
        moved, gain, possible = self.shift_depth(depth, depth_medians(prior))
        variance = None if prior.variance is None else prior.variance * gain**2
        return DepthPrior.from_arrays(moved, variance, prior.valid & possible, metric=prior.metric)

    def shift_depth(
        self, depth: Float64, depth_medians: tuple[float, float]
    ) -> tuple[Float64, Float64, Bool]:
        """Apply :attr:`shift` to depth values of a map with the given :func:`depth_medians`.

        Returns:
            The new depth, the factor of its std, and where there is one; of the shape of
            ``depth``.
        """
        in_depth = self.shift_space == "depth"
        quantity = depth if in_depth else 1 / depth
        median = depth_medians[0] if in_depth else depth_medians[1]
        moved = quantity + self.shift * median
        possible = moved > _SMALLEST_SHARE * median
        moved = np.where(possible, moved, median)
        if in_depth:
            return moved, np.ones_like(moved), possible
        return 1 / moved, (quantity / moved) ** 2, possible


def depth_medians(prior: DepthPrior) -> tuple[float, float]:
    """Medians of depth and of inverse depth over a map with valid pixels."""
    depth = prior.depth[prior.valid].astype(np.float64)
    return float(np.median(depth)), float(np.median(1 / depth))


class NormalCalibration(Options):
    """``std = max(std_scale * network_std, std_floor_deg)``, an angle.

    ``std_default_deg`` is the std of a network that gives none.
    """

    std_scale: float = Field(1.0, gt=0)
    """Multiplies the network's angular std (reference ``prior_std_multiplier``)."""
    std_floor_deg: float = Field(1.0, ge=0)
    """Smallest angular std (reference ``inherent_polar_noise`` means 1 degree)."""
    std_default_deg: float = Field(7.6, gt=0)
    """Without network variance (what the reference's floor amounts to, see its defect list)."""
    use_network_variance: bool = True

    def apply(self, prior: NormalPrior) -> NormalPrior:
        """The prior with its total variance; every valid pixel has one."""
        if prior.variance is not None and self.use_network_variance:
            std = self.std_scale * np.sqrt(np.maximum(prior.variance.astype(np.float64), 0))
        else:
            std = np.full(prior.shape, np.radians(self.std_default_deg))
        std = np.maximum(std, np.radians(self.std_floor_deg))
        variance = np.where(prior.valid, np.maximum(std**2, _SMALLEST_VARIANCE), 0.0)
        return NormalPrior(prior.normals, variance.astype(np.float32), prior.valid)


Calibration = DepthCalibration | NormalCalibration
