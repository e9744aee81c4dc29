"""Wrapper around a depth or normals provider that adds a variance."""

from __future__ import annotations

from typing import Any

from mpsfm_core import DepthPrior, NormalPrior, ProviderContext, View
from mpsfm_core.data.errors import DataError
from mpsfm_flip_consistency.fusion import fuse_depth, fuse_normals
from mpsfm_flip_consistency.mirror import mirror_depth, mirror_normals, mirror_view


class FlipConsistency:
    """Wrapper that runs a provider on a view and on its mirror image, and fuses both priors."""

    def __init__(self, inner: Any, options: None, context: ProviderContext) -> None:
        self._inner = inner

    def predict(self, view: View, depth: DepthPrior | None = None) -> DepthPrior | NormalPrior:
        """Predict a prior, with a variance from the predictions for the view and its mirror image.

        Args:
            view: The view.
            depth: Depth of the view, for normals providers that require depth.

        Raises:
            DataError: The priors of the view and of its mirror image have different sizes.
        """
        given, mirrored = ((), ()) if depth is None else ((depth,), (mirror_depth(depth),))
        first = self._inner.predict(view, *given)
        second = self._inner.predict(mirror_view(view), *mirrored)
        if first.shape != second.shape:
            text = f"must have one size for a view and its mirror image, got {first.shape} and "
            raise DataError("output", f"{text}{second.shape}")
        if isinstance(first, DepthPrior):
            return fuse_depth(first, mirror_depth(second))
        return fuse_normals(first, mirror_normals(second))
