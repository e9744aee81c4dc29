"""Features providers, which detect and describe sparse local features."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

from mpsfm_core.data import Features, View
from mpsfm_core.providers.protocols import ProviderSpec
from mpsfm_core.providers.provider_kind import ProviderKind
from mpsfm_core.providers.validation import (
    name_violations,
    provider_errors,
    require_inside,
    revalidate,
)


@runtime_checkable
class FeatureProvider(Protocol):
    """Provider that detects and describes sparse local features."""

    def extract(self, view: View) -> Features:
        """Detect and describe the local features of an undistorted image.

        Args:
            view: Undistorted image with its camera.

        Returns:
            Keypoints (n, 2) float64 in pixels of ``view``, not of a resized image. Descriptors (n,
            d) float32 with the same dimension d for every image. Optional detection scores (n,)
            float32 and optional keypoint scales (n,) float32 in pixels, as sigma, radius or
            diameter, whichever the matchers of these features expect. The standard deviation
            ``std_px`` of keypoint positions in pixels.
        """
        ...


def run_features(spec: ProviderSpec, provider: FeatureProvider, view: View) -> Features:
    """Extract the features of an image and validate the keypoints and descriptors."""
    with provider_errors(spec, view.name):
        return validate_features(spec, view, provider.extract(view))


def validate_features(spec: ProviderSpec, view: View, output: object) -> Features:
    """Validate the values of extracted features, whose keypoints must be inside the image.

    Args:
        spec: Specification of the provider, with its capabilities.
        view: Undistorted image that the provider processed.
        output: Return value of the provider.

    Returns:
        The validated features as returned by the provider.

    Raises:
        ProviderOutputError: The provider's output violates a rule of the interface. The error
            message names provider, image, field and rule.
    """
    with name_violations(spec, view.name):
        features = revalidate(output, Features, "features")
        require_inside(features.keypoints, view.camera, "keypoints")
        return features


KIND = ProviderKind(
    name="features",
    title="Features",
    protocol=FeatureProvider,
    checks="mpsfm_core.testing.checks.features:CHECKS",
    run=run_features,
    example_scene="indoor",
    sees_truth=True,
    template_requirements=("opencv-python-headless>=4.8",),
)
