"""Structure-from-Motion with monocular depth and normal priors from exchangeable plugins.

The package ``mpsfm_core`` exports all names that users and plugin authors need. Modules with slow
imports are loaded when an exported name is first used, because listing the installed plugins
imports ``mpsfm_core``.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

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
from mpsfm_core.data.errors import InputError, MpsfmError
from mpsfm_core.data.options import Options
from mpsfm_core.providers import ProviderContext, ProviderSpec, WeightsFile, hookimpl

if TYPE_CHECKING:
    from mpsfm_core.config import Config
    from mpsfm_core.pipeline.run import ReconstructionResult
    from mpsfm_core.providers.registry import Registry

    __version__: str

__all__ = [
    "Config",
    "DenseMatches",
    "DepthPrior",
    "Features",
    "InputError",
    "MpsfmError",
    "MultiViewPrior",
    "NormalPrior",
    "Options",
    "PairDepth",
    "PairMatches",
    "PinholeCamera",
    "ProviderContext",
    "ProviderSpec",
    "ReconstructionResult",
    "Registry",
    "SparseMatches",
    "View",
    "WeightsFile",
    "__version__",
    "hookimpl",
    "load_config",
    "reconstruct",
]

_LAZY_MODULES = {
    "Config": "mpsfm_core.config",
    "ReconstructionResult": "mpsfm_core.pipeline.run",
    "Registry": "mpsfm_core.providers.registry",
}
"""Module of each exported name that is imported only when the name is first used."""


def __getattr__(name: str) -> Any:
    """Import an exported name at first use, or read the version of the installed package."""
    if name == "__version__":
        value: Any = importlib.import_module("mpsfm_core.providers.registry").core_version()
    elif name in _LAZY_MODULES:
        value = getattr(importlib.import_module(_LAZY_MODULES[name]), name)
    else:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
