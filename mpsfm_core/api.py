"""The public functions; :mod:`mpsfm_core` exports them.

Each function imports what it needs when it is called: the light module of a plugin imports
``mpsfm_core``, and listing plugins must not load the optimizers.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from mpsfm_core.config import Config
    from mpsfm_core.pipeline.run import ReconstructionResult
    from mpsfm_core.providers.registry import Registry


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
    """Reconstruct a folder of photos; see :func:`mpsfm_core.pipeline.run.reconstruct`."""
    from mpsfm_core.pipeline.run import reconstruct

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
