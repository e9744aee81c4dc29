"""Structure-from-Motion with monocular depth and normal priors from swappable plugins."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from mpsfm_core.data import (
    DenseMatches,
    DepthPrior,
    Features,
    GroupPrior,
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

if TYPE_CHECKING:
    from mpsfm_core.config import Config
    from mpsfm_core.pipeline import ReconstructionResult
    from mpsfm_core.registry import Registry

__all__ = [
    "DenseMatches",
    "DepthPrior",
    "Features",
    "GroupPrior",
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


# The two functions import what they need when they are called: a plugin's light module imports
# this package, and listing plugins must not load the optimisers.


def load_config(
    name_or_path: str | Path, overrides: Sequence[str] = (), registry: Registry | None = None
) -> Config:
    """Read, merge and check a configuration; see :func:`mpsfm_core.config.load_config`."""
    from mpsfm_core.config import load_config

    return load_config(name_or_path, overrides, registry)


def reconstruct(
    images: str | Path,
    output: str | Path | None = None,
    config: str | Path | Config = "default",
    *,
    intrinsics: str | Path | None = None,
    image_list: str | Path | None = None,
    poses: str | Path | None = None,
    overrides: Sequence[str] = (),
    registry: Registry | None = None,
) -> ReconstructionResult:
    """Reconstruct a folder of photos; see :func:`mpsfm_core.pipeline.reconstruct`."""
    from mpsfm_core.pipeline import reconstruct

    return reconstruct(
        images,
        output,
        config,
        intrinsics=intrinsics,
        image_list=image_list,
        poses=poses,
        overrides=overrides,
        registry=registry,
    )
