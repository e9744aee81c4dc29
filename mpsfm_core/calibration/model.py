"""The uncertainty model of a prior: what a network says about itself, made trustworthy.

Paper appendix C: the total std is the maximum of the scaled network std, a std proportional to
depth, and a floor.
"""

from __future__ import annotations

import numpy as np
from pydantic import Field

from mpsfm_core.data import DepthPrior, NormalPrior
from mpsfm_core.options import Options


class DepthCalibration(Options):
    """``std = max(std_scale * network_std, relative_std * depth, std_floor)``.

    ``std_floor`` is in metres and applies to metric priors only. The defaults are those of
    Metric3D v2 giant2 in the reference (its other backends' values stand in their plugins).
    """

    std_scale: float = Field(3.33, gt=0)
    """Multiplies the network's std (reference ``prior_std_multiplier``)."""
    relative_std: float = Field(0.0263, ge=0)
    """Std as a share of depth (reference ``depth_uncertainty``)."""
    std_floor: float = Field(0.02, ge=0)
    """Smallest std in metres (paper appendix C: 2 cm)."""
    use_network_variance: bool = True
    """False ignores what the network says of itself."""

    def apply(self, prior: DepthPrior) -> DepthPrior:
        """The prior with its total variance; every valid pixel has one."""
        depth = prior.depth.astype(np.float64)
        std = self.relative_std * depth
        if prior.metric:
            std = np.maximum(std, self.std_floor)
        if prior.variance is not None and self.use_network_variance:
            std = np.maximum(std, self.std_scale * np.sqrt(np.maximum(prior.variance, 0)))
        variance = np.where(prior.valid, np.maximum(std**2, 1e-12), 0.0).astype(np.float32)
        return DepthPrior(prior.depth, variance, prior.valid, prior.metric)


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
        variance = np.where(prior.valid, np.maximum(std**2, 1e-12), 0.0).astype(np.float32)
        return NormalPrior(prior.normals, variance, prior.valid)
