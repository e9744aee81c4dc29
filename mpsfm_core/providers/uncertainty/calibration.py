"""Uncertainty model of a prior: from the std of a network to a calibrated std.

Paper appendix C: the total std is the maximum of the scaled network std, a std proportional to
depth, and a floor. Two extensions serve relative networks: a common shift, so that the mapper only
estimates a scale per image, and a larger variance at depth edges.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from pydantic import Field

from mpsfm_core.data import Bool, DepthPrior, Float64, NormalPrior
from mpsfm_core.data.options import Options
from mpsfm_core.geometry import log_depth_steps

_MIN_VARIANCE = 1e-12
_MIN_SHIFTED_RATIO = 0.01
"""Smallest shifted depth or inverse depth relative to its median; smaller values are invalid."""


class DepthCalibration(Options):
    """Depth uncertainty ``max(std_scale * network_std, relative_std * depth, std_floor)``.

    The defaults are those of Metric3D v2 giant2 in the reference implementation. Plugins declare
    values for other networks. The variance describes the errors after each image has received its
    own scale, as in the mapper; it excludes the error of that scale.
    """

    std_scale: float = Field(3.33, gt=0)
    """Factor of the network's std [reference prior_std_multiplier]; raising it trusts depth
    less."""
    relative_std: float = Field(0.0263, ge=0)
    """Smallest std relative to depth [reference depth_uncertainty]."""
    std_floor: float = Field(0.02, ge=0)
    """Smallest std in meters, for metric priors only [paper appendix C]."""
    use_network_variance: bool = True
    """False ignores the variance of the network."""
    shift: float = 0.0
    """Offset of depth or inverse depth in multiples of its median over the map; 0 for metric
    networks."""
    shift_space: Literal["depth", "disparity"] = "depth"
    """Quantity to shift: disparity for networks that predict affine-invariant inverse depth."""
    edge_ratio: float | None = Field(None, gt=1)
    """Ratio of neighboring depths above which a pixel is on an edge; null disables edges."""
    edge_std_scale: float = Field(1.0, ge=1)
    """Factor of the std of pixels on an edge."""

    def apply(self, prior: DepthPrior) -> DepthPrior:
        """Return the prior with its calibrated variance; every valid pixel has one."""
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
        variance = np.where(shifted.valid, np.maximum(std**2, _MIN_VARIANCE), 0.0)
        return DepthPrior(shifted.depth, variance.astype(np.float32), shifted.valid, shifted.metric)

    def shifted(self, prior: DepthPrior) -> DepthPrior:
        """Return the prior with :attr:`shift` applied to depth and network variance."""
        if self.shift == 0 or not prior.valid.any():
            return prior
        depth = np.where(prior.valid, prior.depth, np.float32(1)).astype(np.float64)
        moved, gain, possible = self.shift_depth(depth, depth_medians(prior))
        variance = None if prior.variance is None else prior.variance * gain**2
        return DepthPrior.from_arrays(moved, variance, prior.valid & possible, metric=prior.metric)

    def shift_depth(
        self, depth: Float64, medians: tuple[float, float]
    ) -> tuple[Float64, Float64, Bool]:
        """Apply :attr:`shift` to depth values.

        Args:
            depth: Depth values of a map, of any shape.
            medians: Medians of depth and inverse depth over the map, see :func:`depth_medians`.

        Returns:
            Shifted depth, factor of its std, and validity, of the shape of ``depth``.
        """
        in_depth = self.shift_space == "depth"
        quantity = depth if in_depth else 1 / depth
        median = medians[0] if in_depth else medians[1]
        moved = quantity + self.shift * median
        possible = moved > _MIN_SHIFTED_RATIO * median
        moved = np.where(possible, moved, median)
        if in_depth:
            return moved, np.ones_like(moved), possible
        return 1 / moved, (quantity / moved) ** 2, possible


def depth_medians(prior: DepthPrior) -> tuple[float, float]:
    """Return the medians of depth and of inverse depth over the valid pixels."""
    depth = prior.depth[prior.valid].astype(np.float64)
    return float(np.median(depth)), float(np.median(1 / depth))


class NormalCalibration(Options):
    """Angular uncertainty of normals: ``max(std_scale * network_std, std_floor_deg)``.

    ``std_default_deg`` replaces the std of a network without variance.
    """

    std_scale: float = Field(1.0, gt=0)
    """Factor of the network's angular std [reference prior_std_multiplier]."""
    std_floor_deg: float = Field(1.0, ge=0)
    """Smallest angular std [reference inherent_polar_noise]."""
    std_default_deg: float = Field(7.6, gt=0)
    """Angular std without network variance [reference: effect of its floor]."""
    use_network_variance: bool = True
    """False ignores the variance of the network."""

    def apply(self, prior: NormalPrior) -> NormalPrior:
        """The prior with its total variance; every valid pixel has one."""
        if prior.variance is not None and self.use_network_variance:
            std = self.std_scale * np.sqrt(np.maximum(prior.variance.astype(np.float64), 0))
        else:
            std = np.full(prior.shape, np.radians(self.std_default_deg))
        std = np.maximum(std, np.radians(self.std_floor_deg))
        variance = np.where(prior.valid, np.maximum(std**2, _MIN_VARIANCE), 0.0)
        return NormalPrior(prior.normals, variance.astype(np.float32), prior.valid)


Calibration = DepthCalibration | NormalCalibration
