"""Multi-view providers, which predict the depth of several images jointly."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol, runtime_checkable

from mpsfm_core.data import MultiViewPrior, View
from mpsfm_core.data.errors import DataError
from mpsfm_core.providers.kinds.depth import check_depth_prior
from mpsfm_core.providers.protocols import ProviderSpec
from mpsfm_core.providers.provider_kind import ProviderKind
from mpsfm_core.providers.validation import (
    name_violations,
    provider_errors,
    require_undeclared,
    revalidate,
    type_name,
)


@runtime_checkable
class MultiViewProvider(Protocol):
    """Provider that predicts the depth of several images jointly."""

    def predict_group(self, views: Sequence[View]) -> MultiViewPrior:
        """Predict the depth of several images in one common unit.

        Args:
            views: One or more undistorted images of one scene, of any sizes.

        Returns:
            One depth prior per image, in the order of ``views`` and in one common unit. Providers
            with the capability ``proposes-poses`` also return camera poses ``cam_from_group`` (n,
            3, 4) float64, with translations in the unit of depth. Providers with the capability
            ``proposes-intrinsics`` also return intrinsics fx, fy, cx, cy (n, 4) float64 in pixels
            of each image.
        """
        ...


def run_multiview(
    spec: ProviderSpec, provider: MultiViewProvider, views: Sequence[View]
) -> MultiViewPrior:
    """Predict the depth of several images jointly and validate the depth priors."""
    with provider_errors(spec, _group_name(views)):
        return validate_multiview(spec, views, provider.predict_group(tuple(views)))


def validate_multiview(spec: ProviderSpec, views: Sequence[View], output: object) -> MultiViewPrior:
    """Validate the depth priors, poses and intrinsics that a multi-view network predicts.

    Args:
        spec: Specification of the provider, with its capabilities.
        views: Undistorted images that the provider processed.
        output: Return value of the provider.

    Returns:
        The validated priors as returned by the provider.

    Raises:
        ProviderOutputError: The provider's output violates a rule of the interface. The error
            message names provider, images, field and rule.
    """
    with name_violations(spec, _group_name(views)):
        group = revalidate(output, MultiViewPrior, "output")
        if not isinstance(group.depth, tuple) or len(group.depth) != len(views):
            found = len(group.depth) if isinstance(group.depth, tuple) else type_name(group.depth)
            raise DataError(
                "depth", f"the depth must be a tuple of {len(views)} priors, got {found}"
            )
        for prior in group.depth:
            check_depth_prior(spec, prior, "depth")
        if group.poses is None:
            require_undeclared(spec, "proposes-poses", "poses")
        if group.intrinsics is None:
            require_undeclared(spec, "proposes-intrinsics", "intrinsics")
        return group


def _group_name(views: Sequence[View]) -> str:
    return ", ".join(view.name for view in views)


KIND = ProviderKind(
    name="multiview",
    title="Multi-view networks",
    protocol=MultiViewProvider,
    checks="mpsfm_core.testing.checks.multiview:CHECKS",
    capabilities={
        "metric": "The depth is in meters.",
        "variance": "The depth or normals have a variance that the network predicts.",
        "proposes-poses": "The multi-view provider predicts relative camera poses.",
        "proposes-intrinsics": "The multi-view provider predicts camera intrinsics.",
    },
    predicts_maps=True,
)
