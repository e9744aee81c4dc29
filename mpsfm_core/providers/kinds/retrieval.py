"""Retrieval providers, which compute global descriptors of images."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

import numpy as np

from mpsfm_core.data import Float32, View
from mpsfm_core.data.errors import DataError
from mpsfm_core.providers.protocols import ProviderSpec
from mpsfm_core.providers.provider_kind import ProviderKind
from mpsfm_core.providers.validation import (
    name_violations,
    provider_errors,
    require_array,
    require_not_empty,
)


@runtime_checkable
class RetrievalProvider(Protocol):
    """Provider of global image descriptors for image retrieval."""

    def describe(self, view: View) -> Float32:
        """Compute the global descriptor of an undistorted image.

        Args:
            view: Undistorted image with its camera.

        Returns:
            Global descriptor (d,) float32 with the same dimension d for every image. The dot
            product of two global descriptors is the similarity of their images, so descriptors
            have unit length unless their length is part of the similarity.
        """
        ...


def run_retrieval(spec: ProviderSpec, provider: RetrievalProvider, view: View) -> Float32:
    """Compute the global descriptor of an image and validate the descriptor."""
    with provider_errors(spec, view.name):
        return validate_retrieval(spec, view, provider.describe(view))


def validate_retrieval(spec: ProviderSpec, view: View, output: object) -> Float32:
    """Validate that a global descriptor is a finite, non-empty float32 vector.

    Args:
        spec: Specification of the provider, with its capabilities.
        view: Undistorted image that the provider processed.
        output: Return value of the provider.

    Returns:
        The validated descriptor as returned by the provider.

    Raises:
        ProviderOutputError: The provider's output violates a rule of the interface. The error
            message names provider, image, field and rule.
    """
    with name_violations(spec, view.name):
        vector = require_array(output, "descriptor", np.dtype(np.float32), 1)
        require_not_empty(vector.shape, "descriptor")
        if not np.isfinite(vector).all():
            raise DataError("descriptor", "must be finite")
        return vector


KIND = ProviderKind(
    name="retrieval",
    title="Retrieval",
    protocol=RetrievalProvider,
    checks="mpsfm_core.testing.checks.retrieval:CHECKS",
    run=run_retrieval,
    example_scene="indoor",
    sees_truth=True,
    template_requirements=("opencv-python-headless>=4.8",),
)
