"""Mask providers, which mark the pixels that the reconstruction may use."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

import numpy as np

from mpsfm_core.data import Bool, View
from mpsfm_core.data.errors import DataError
from mpsfm_core.providers.protocols import ProviderSpec
from mpsfm_core.providers.provider_kind import ProviderKind
from mpsfm_core.providers.validation import name_violations, provider_errors, require_array


@runtime_checkable
class MaskProvider(Protocol):
    """Provider of masks, which mark the pixels that the reconstruction may use."""

    def mask(self, view: View) -> Bool:
        """Compute the mask of the pixels in an image that the reconstruction may use.

        Args:
            view: Undistorted image with its camera.

        Returns:
            Mask (H, W) bool in the size of the image, True where the reconstruction may use a
            pixel. The core combines the masks of the user and of all mask providers, so the mask
            need not contain ``view.mask``.
        """
        ...


def run_mask(spec: ProviderSpec, provider: MaskProvider, view: View) -> Bool:
    """Compute the mask of usable pixels of an image and validate the mask."""
    with provider_errors(spec, view.name):
        return validate_mask(spec, view, provider.mask(view))


def validate_mask(spec: ProviderSpec, view: View, output: object) -> Bool:
    """Validate that a mask is a bool array in the size of the image.

    Args:
        spec: Specification of the provider, with its capabilities.
        view: Undistorted image that the provider processed.
        output: Return value of the provider.

    Returns:
        The validated mask as returned by the provider.

    Raises:
        ProviderOutputError: The provider's output violates a rule of the interface. The error
            message names provider, image, field and rule.
    """
    with name_violations(spec, view.name):
        mask = require_array(output, "mask", np.dtype(np.bool_), 2)
        expected = (view.camera.height, view.camera.width)
        if mask.shape != expected:
            raise DataError(
                "mask", f"the mask must have the image's shape {expected}, got {mask.shape}"
            )
        return mask


KIND = ProviderKind(
    name="mask",
    title="Masks",
    protocol=MaskProvider,
    checks="mpsfm_core.testing.checks.mask:CHECKS",
    run=run_mask,
    predicts_maps=True,
)
