"""Uncertainty models of priors, which convert the std of a network to a calibrated std.

The calibrated depth std is the maximum of the scaled network std, a std proportional to depth, and
a floor (appendix C of the paper). The option ``shift`` serves networks that predict depth up to
scale and shift. The same depth offset is added to all depth maps, so that the mapper only estimates
a scale per image. An option for depth edges increases the depth variance of pixels at depth
discontinuities.
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
"""Smallest valid depth or inverse depth after adding the offset ``shift``, as a fraction of the
median. Pixels with a smaller depth or inverse depth become invalid."""


class DepthCalibration(Options):
    """Uncertainty model of depth priors, which calibrates their standard deviation.

    The calibrated depth std is ``max(std_scale * network_std, relative_std * depth, std_floor)``.
    By default the std of the network is not scaled, and the smallest relative std is that of
    Metric3D v2 giant2. Plugins declare the values of the uncertainty model for their networks. The
    calibrated variance describes the depth errors that remain after the mapper has estimated a
    scale for the depth map of each image.
    """

    std_scale: float = Field(1.0, gt=0)
    """Factor of the network's depth std (``prior_std_multiplier`` of the reference implementation).
    A larger factor lowers the weight of the depth prior."""
    relative_std: float = Field(0.0263, ge=0)
    """Smallest depth std divided by depth [reference depth_uncertainty]."""
    std_floor: float = Field(0.02, ge=0)
    """Smallest depth std in meters, for metric priors only [paper appendix C]."""
    use_network_variance: bool = True
    """False ignores the depth variance that the network predicts."""
    shift: float = 0.0
    """Offset of predicted depth or inverse depth, in multiples of the median over the depth map.
    Metric networks predict depth with the offset 0."""
    shift_space: Literal["depth", "disparity"] = "depth"
    """Quantity to which the offset ``shift`` is added, either depth or, for networks that predict
    inverse depth up to scale and shift, disparity."""
    edge_ratio: float | None = Field(None, gt=1)
    """Depth ratio of neighboring pixels above which they are on a depth edge. Null treats no pixel
    as a depth edge."""
    edge_std_scale: float = Field(1.0, ge=1)
    """Factor by which the depth std of pixels on a depth edge is multiplied."""

    def apply(self, prior: DepthPrior) -> DepthPrior:
        """Return the depth prior with its calibrated variance, defined at every valid pixel."""
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
        """Return the depth prior with the offset :attr:`shift` applied to depth and variance."""
        if self.shift == 0 or not prior.valid.any():
            return prior
        depth = np.where(prior.valid, prior.depth, np.float32(1)).astype(np.float64)
        moved, gain, possible = self.shift_depth(depth, depth_medians(prior))
        variance = None if prior.variance is None else prior.variance * gain**2
        return DepthPrior.from_arrays(moved, variance, prior.valid & possible, metric=prior.metric)

    def shift_depth(
        self, depth: Float64, medians: tuple[float, float]
    ) -> tuple[Float64, Float64, Bool]:
        """Add the offset :attr:`shift` to depth values or to their inverse.

        Args:
            depth: Depth values of one depth map, in an array of any shape.
            medians: Medians of depth and inverse depth over the depth map, see
                :func:`depth_medians`.

        Returns:
            Arrays in the shape of ``depth`` with the shifted depth, the factor by which the offset
            changes the depth std, and the validity of the shifted depth.
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
    """Return the medians of depth and of inverse depth over the valid pixels of a depth prior."""
    depth = prior.depth[prior.valid].astype(np.float64)
    return float(np.median(depth)), float(np.median(1 / depth))


class NormalCalibration(Options):
    """Uncertainty model of normal priors, which calibrates their angular standard deviation.

    The calibrated angular std of a normal is ``max(std_scale * network_std, std_floor_deg)``. The
    option ``std_default_deg`` replaces ``std_scale * network_std`` if the network predicts no
    variance.
    """

    std_scale: float = Field(1.0, gt=0)
    """Factor of the angular std that a normals network predicts [reference
    prior_std_multiplier]."""
    std_floor_deg: float = Field(1.0, ge=0)
    """Smallest angular std of normals in degrees [reference inherent_polar_noise]."""
    std_default_deg: float = Field(7.6, gt=0)
    """Angular std of normals in degrees if the network predicts no variance [reference: effect of
    inherent_polar_noise]."""
    use_network_variance: bool = True
    """False ignores the angular variance that the network predicts."""

    def apply(self, prior: NormalPrior) -> NormalPrior:
        """Return the normal prior with its calibrated variance, defined at every valid pixel."""
        if prior.variance is not None and self.use_network_variance:
            std = self.std_scale * np.sqrt(np.maximum(prior.variance.astype(np.float64), 0))
        else:
            std = np.full(prior.shape, np.radians(self.std_default_deg))
        std = np.maximum(std, np.radians(self.std_floor_deg))
        variance = np.where(prior.valid, np.maximum(std**2, _MIN_VARIANCE), 0.0)
        return NormalPrior(prior.normals, variance.astype(np.float32), prior.valid)


Calibration = DepthCalibration | NormalCalibration
