"""Structure-from-Motion with monocular depth and normal priors from swappable plugins."""

from __future__ import annotations

from mpsfm_core.api import load_config, reconstruct
from mpsfm_core.data import (
    DenseMatches,
    DepthPrior,
    Features,
    MultiViewPrior,
    NormalPrior,
    PairDepth,
    PairMatches,
    PinholeCamera,
    SparseMatches,
    View,
)
from mpsfm_core.data.errors import MpsfmError
from mpsfm_core.data.options import Options
from mpsfm_core.providers import ProviderContext, ProviderSpec, WeightsFile, hookimpl

__all__ = [
    "DenseMatches",
    "DepthPrior",
    "Features",
    "MultiViewPrior",
    "MpsfmError",
    "NormalPrior",
    "Options",
    "PairDepth",
    "PairMatches",
    "PinholeCamera",
    "ProviderContext",
    "ProviderSpec",
    "SparseMatches",
    "View",
    "WeightsFile",
    "hookimpl",
    "load_config",
    "reconstruct",
]
