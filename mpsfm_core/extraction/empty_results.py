"""Empty provider results, used for images on which a provider failed."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from mpsfm_core.data import (
    DepthPrior,
    Features,
    MultiViewPrior,
    NormalPrior,
    PairMatches,
    SparseMatches,
)


@dataclass(frozen=True, eq=False)
class JointPrior:
    """Depth and normals from one forward pass of a network."""

    depth: DepthPrior
    normals: NormalPrior


def _depth() -> DepthPrior:
    zero = np.zeros((1, 1), dtype=np.float32)
    return DepthPrior(zero, zero, np.zeros((1, 1), dtype=np.bool_))


def _normals() -> NormalPrior:
    zero = np.zeros((1, 1), dtype=np.float32)
    return NormalPrior(np.zeros((1, 1, 3), np.float32), zero, np.zeros((1, 1), dtype=np.bool_))


def _matches() -> PairMatches:
    none = np.zeros(0, dtype=np.float32)
    return PairMatches(SparseMatches(np.zeros((0, 2), dtype=np.int64), none))


EMPTY_RESULTS: Mapping[type, Callable[[], object]] = MappingProxyType(
    {
        Features: lambda: Features(np.zeros((0, 2)), np.zeros((0, 0), dtype=np.float32)),
        DepthPrior: _depth,
        NormalPrior: _normals,
        MultiViewPrior: lambda: MultiViewPrior(()),
        JointPrior: lambda: JointPrior(_depth(), _normals()),
        PairMatches: _matches,
    }
)
"""Constructors of empty provider results by data class. Masks and global descriptors have no empty
result."""
