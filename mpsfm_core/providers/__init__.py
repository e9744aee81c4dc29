"""Plugin interface of providers: protocols, hooks and specifications.

The registry of installed plugins is :class:`mpsfm_core.providers.registry.Registry`.
"""

from mpsfm_core.providers.kinds import CAPABILITIES, KINDS, PROVIDER_KINDS
from mpsfm_core.providers.kinds.depth import DepthProvider, FocalEstimator, JointProvider
from mpsfm_core.providers.kinds.features import FeatureProvider
from mpsfm_core.providers.kinds.mask import MaskProvider
from mpsfm_core.providers.kinds.matcher import Matcher, require_features
from mpsfm_core.providers.kinds.multiview import MultiViewProvider
from mpsfm_core.providers.kinds.normals import NormalsProvider
from mpsfm_core.providers.kinds.retrieval import RetrievalProvider
from mpsfm_core.providers.protocols import (
    API_VERSION,
    ENTRY_POINT_GROUP,
    Capability,
    Executor,
    ExportFormat,
    Hooks,
    Kind,
    ModelExport,
    ProviderContext,
    ProviderSpec,
    WeightsFile,
    hookimpl,
    hookspec,
    weights_from_option,
)
from mpsfm_core.providers.provider_kind import ProviderKind

__all__ = [
    "API_VERSION",
    "CAPABILITIES",
    "ENTRY_POINT_GROUP",
    "KINDS",
    "PROVIDER_KINDS",
    "Capability",
    "DepthProvider",
    "Executor",
    "ExportFormat",
    "FeatureProvider",
    "FocalEstimator",
    "Hooks",
    "JointProvider",
    "Kind",
    "MaskProvider",
    "Matcher",
    "ModelExport",
    "MultiViewProvider",
    "NormalsProvider",
    "ProviderContext",
    "ProviderKind",
    "ProviderSpec",
    "RetrievalProvider",
    "WeightsFile",
    "hookimpl",
    "hookspec",
    "require_features",
    "weights_from_option",
]
