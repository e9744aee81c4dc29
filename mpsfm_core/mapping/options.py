"""Every setting of the mapper, with its source."""

from __future__ import annotations

from mpsfm_core.options import Options


class MapperOptions(Options):
    """Settings of :func:`mpsfm_core.mapping.mapper.reconstruct`."""

    seed: int = 0
    """Seed of every random choice (RANSAC)."""
