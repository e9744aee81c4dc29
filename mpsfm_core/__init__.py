"""Structure-from-Motion with monocular depth and normal priors from exchangeable plugins.

The package ``mpsfm_core`` exports all names that users and plugin authors need. The module that
defines an exported name is imported when the name is first used, so that commands start fast.
"""

from __future__ import annotations

import importlib
import sys
import warnings
from typing import TYPE_CHECKING, Any

if "pycolmap" in sys.modules and "zlib" not in sys.modules:
    warnings.warn(
        "import mpsfm_core or zlib before pycolmap: the wheels of pycolmap contain a zlib that "
        "replaces the one of Python, and the process may abort when it compresses files",
        stacklevel=2,
    )
importlib.import_module("zlib")  # before any module of this package imports pycolmap

if TYPE_CHECKING:
    from mpsfm_core.api import (
        build_mesh,
        densify,
        evaluate,
        extract_features,
        from_colmap,
        fuse,
        load_images,
        match_images,
        predict_priors,
        run_mapper,
        texture_mesh,
        to_colmap,
        undistort_views,
    )
    from mpsfm_core.calibration.calibrate import CalibrationImages, calibrate
    from mpsfm_core.config import Config, load_config
    from mpsfm_core.data import (
        DenseMatches,
        DepthPrior,
        Features,
        MappingProblem,
        MultiViewPrior,
        NormalPrior,
        PairDepth,
        PairMatches,
        PinholeCamera,
        Rig,
        SparseMatches,
        VerifiedPair,
        View,
    )
    from mpsfm_core.data.errors import Cancelled, InputError, MpsfmError
    from mpsfm_core.data.options import Options
    from mpsfm_core.extraction.match_graph import MatchGraph, Priors
    from mpsfm_core.extraction.problem_builder import build_problem
    from mpsfm_core.mapping.scene.reconstruction import MappingResult, Reconstruction
    from mpsfm_core.pipeline.localize import LocalizationResult, localize
    from mpsfm_core.pipeline.run import ReconstructionResult, reconstruct
    from mpsfm_core.providers import ProviderContext, ProviderSpec, WeightsFile, hookimpl
    from mpsfm_core.providers.provider_config import ProviderConfig
    from mpsfm_core.providers.registry import Registry
    from mpsfm_core.results import plots
    from mpsfm_core.results.exports.formats import export

    __version__: str

_LAZY_MODULES = {
    "mpsfm_core.api": (
        "build_mesh",
        "densify",
        "evaluate",
        "extract_features",
        "from_colmap",
        "fuse",
        "load_images",
        "match_images",
        "predict_priors",
        "run_mapper",
        "texture_mesh",
        "to_colmap",
        "undistort_views",
    ),
    "mpsfm_core.calibration.calibrate": ("CalibrationImages", "calibrate"),
    "mpsfm_core.config": ("Config", "load_config"),
    "mpsfm_core.data": (
        "DenseMatches",
        "DepthPrior",
        "Features",
        "MappingProblem",
        "MultiViewPrior",
        "NormalPrior",
        "PairDepth",
        "PairMatches",
        "PinholeCamera",
        "Rig",
        "SparseMatches",
        "VerifiedPair",
        "View",
    ),
    "mpsfm_core.data.errors": ("Cancelled", "InputError", "MpsfmError"),
    "mpsfm_core.data.options": ("Options",),
    "mpsfm_core.extraction.match_graph": ("MatchGraph", "Priors"),
    "mpsfm_core.extraction.problem_builder": ("build_problem",),
    "mpsfm_core.mapping.scene.reconstruction": ("MappingResult", "Reconstruction"),
    "mpsfm_core.pipeline.localize": ("LocalizationResult", "localize"),
    "mpsfm_core.pipeline.run": ("ReconstructionResult", "reconstruct"),
    "mpsfm_core.providers": ("ProviderContext", "ProviderSpec", "WeightsFile", "hookimpl"),
    "mpsfm_core.providers.provider_config": ("ProviderConfig",),
    "mpsfm_core.providers.registry": ("Registry",),
    "mpsfm_core.results.exports.formats": ("export",),
}
"""Exported names by defining module; a module is imported when one of its names is first used."""

_LAZY_NAMES = {name: module for module, names in _LAZY_MODULES.items() for name in names}

__all__ = [
    "CalibrationImages",
    "Cancelled",
    "Config",
    "DenseMatches",
    "DepthPrior",
    "Features",
    "InputError",
    "LocalizationResult",
    "MappingProblem",
    "MappingResult",
    "MatchGraph",
    "MpsfmError",
    "MultiViewPrior",
    "NormalPrior",
    "Options",
    "PairDepth",
    "PairMatches",
    "PinholeCamera",
    "Priors",
    "ProviderConfig",
    "ProviderContext",
    "ProviderSpec",
    "Reconstruction",
    "ReconstructionResult",
    "Registry",
    "Rig",
    "SparseMatches",
    "VerifiedPair",
    "View",
    "WeightsFile",
    "__version__",
    "build_mesh",
    "build_problem",
    "calibrate",
    "densify",
    "evaluate",
    "export",
    "extract_features",
    "from_colmap",
    "fuse",
    "hookimpl",
    "load_config",
    "load_images",
    "localize",
    "match_images",
    "plots",
    "predict_priors",
    "reconstruct",
    "run_mapper",
    "texture_mesh",
    "to_colmap",
    "undistort_views",
]


def __getattr__(name: str) -> Any:
    """Import an exported name at first use, or read the version of the installed package."""
    if name == "__version__":
        value: Any = importlib.import_module("mpsfm_core.providers.registry").core_version()
    elif name == "plots":
        value = importlib.import_module("mpsfm_core.results.plots")
    elif name in _LAZY_NAMES:
        value = getattr(importlib.import_module(_LAZY_NAMES[name]), name)
    else:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
