"""Structure-from-Motion with monocular depth and normal priors from swappable plugins."""

from mpsfm_core.data import (
    DenseMatches,
    DepthPrior,
    Features,
    NormalPrior,
    PairDepth,
    PairMatches,
    PinholeCamera,
    SparseMatches,
    View,
)
from mpsfm_core.errors import MpsfmError
from mpsfm_core.options import Options
from mpsfm_core.providers import ProviderContext, ProviderSpec, WeightsFile, hookimpl

__all__ = [
    "DenseMatches",
    "DepthPrior",
    "Features",
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
]
