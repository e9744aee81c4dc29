"""Depth providers, which predict the depth of a single image."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

import numpy as np

from mpsfm_core.data import DepthPrior, NormalPrior, View
from mpsfm_core.data.errors import DataError
from mpsfm_core.providers.kinds.normals import validate_normals
from mpsfm_core.providers.protocols import ProviderSpec
from mpsfm_core.providers.provider_kind import ProviderKind
from mpsfm_core.providers.validation import (
    name_violations,
    provider_errors,
    require_not_empty,
    require_undeclared,
    revalidate,
    type_name,
)


@runtime_checkable
class DepthProvider(Protocol):
    """Provider that predicts the depth of a single undistorted image."""

    def predict(self, view: View) -> DepthPrior:
        """Predict the z-depth map of an undistorted image.

        Args:
            view: Undistorted image with its camera.

        Returns:
            Depth (h, w) float32 along the optical axis, in meters if ``metric`` is true, else in an
            arbitrary unit. Optional depth variance (h, w) float32 in the squared unit of depth.
            Validity (h, w) bool of the depth values. The depth map covers the image and may have
            any resolution.
        """
        ...


@runtime_checkable
class JointProvider(DepthProvider, Protocol):
    """Depth provider that also predicts normals in one pass (capability ``joint-normals``)."""

    def predict_joint(self, view: View) -> tuple[DepthPrior, NormalPrior]:
        """Predict the depth and normals of an image in one network pass.

        Args:
            view: Undistorted image with its camera.

        Returns:
            Depth prior as in :meth:`predict`, and normal prior as in
            :meth:`NormalsProvider.predict`.
        """
        ...


@runtime_checkable
class FocalEstimator(DepthProvider, Protocol):
    """Depth provider that also estimates the focal length (capability ``estimates-focal``)."""

    def estimate_focal(self, view: View) -> float | None:
        """Estimate the focal length of an image from its pixels.

        Args:
            view: Undistorted image. The focal length estimate must not depend on ``view.camera``.

        Returns:
            Focal length in pixels of the image, or None if the provider cannot estimate it.
        """
        ...


def run_depth(spec: ProviderSpec, provider: DepthProvider, view: View) -> DepthPrior:
    """Predict the depth of an image and validate it, see :meth:`DepthProvider.predict`."""
    with provider_errors(spec, view.name):
        return validate_depth(spec, view, provider.predict(view))


def run_joint(
    spec: ProviderSpec, provider: JointProvider, view: View
) -> tuple[DepthPrior, NormalPrior]:
    """Predict depth and normals of an image in one network pass and validate both."""
    with provider_errors(spec, view.name):
        answer = provider.predict_joint(view)
        if not (isinstance(answer, tuple) and len(answer) == 2):
            raise DataError(
                "output", f"the output must be a pair (depth, normals), got {type_name(answer)}"
            )
        return validate_depth(spec, view, answer[0]), validate_normals(spec, view, answer[1])


def run_focal(spec: ProviderSpec, provider: FocalEstimator, view: View) -> float | None:
    """Estimate the focal length of an image in pixels; return None if there is no estimate."""
    with provider_errors(spec, view.name):
        focal = provider.estimate_focal(view)
        if focal is None:
            return None
        if not (isinstance(focal, (int, float, np.number)) and 0 < focal < np.inf):
            raise DataError(
                "focal", f"the focal length must be a positive number of pixels, got {focal!r}"
            )
        return float(focal)


def validate_depth(spec: ProviderSpec, view: View, output: object) -> DepthPrior:
    """Validate the type, values and declared capabilities of a predicted depth prior.

    Args:
        spec: Specification of the provider, with its capabilities.
        view: Undistorted image that the provider processed.
        output: Return value of the provider.

    Returns:
        The validated prior as returned by the provider.

    Raises:
        ProviderOutputError: The provider's output violates a rule of the interface. The error
            message names provider, image, field and rule.
    """
    with name_violations(spec, view.name):
        return check_depth_prior(spec, output, "depth")


def check_depth_prior(spec: ProviderSpec, output: object, field: str) -> DepthPrior:
    """Validate a depth prior, whose field name ``field`` an error message names."""
    prior = revalidate(output, DepthPrior, field)
    require_not_empty(prior.shape, field)
    if not prior.metric:
        require_undeclared(spec, "metric", field)
    if prior.variance is None:
        require_undeclared(spec, "variance", "variance")
    return prior


KIND = ProviderKind(
    name="depth",
    title="Depth",
    protocol=DepthProvider,
    checks="mpsfm_core.testing.checks.depth:CHECKS",
    capabilities={
        "metric": "The depth is in meters.",
        "variance": "The depth or normals have a variance that the network predicts.",
        "joint-normals": "The depth provider has the method predict_joint().",
        "estimates-focal": "The depth provider has the method estimate_focal().",
    },
    capability_methods={"joint-normals": "predict_joint", "estimates-focal": "estimate_focal"},
    run=run_depth,
    predicts_maps=True,
)
