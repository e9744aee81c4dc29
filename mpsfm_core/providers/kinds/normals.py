"""Normals providers, which predict the surface normals of a single image."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

import numpy as np

from mpsfm_core.data import DepthPrior, NormalPrior, PinholeCamera, View, dot_with_rays
from mpsfm_core.data.errors import DataError
from mpsfm_core.providers.protocols import ProviderSpec
from mpsfm_core.providers.provider_kind import ProviderKind
from mpsfm_core.providers.validation import (
    name_violations,
    provider_errors,
    require_not_empty,
    require_undeclared,
    revalidate,
)

MAX_MEDIAN_NORMAL_VARIANCE = np.pi**2
"""Largest plausible median of the angular variance of normals in rad^2. No angle exceeds pi, so a
larger median is in degrees or no variance."""

FACING_TOLERANCE = 1e-3
"""Largest dot product of a unit normal that faces the camera with its viewing ray. The limit is
positive because of rounding, see :data:`~mpsfm_core.data.UNIT_NORMAL_TOLERANCE`."""


@runtime_checkable
class NormalsProvider(Protocol):
    """Provider that predicts the surface normals of a single undistorted image."""

    def predict(self, view: View, depth: DepthPrior | None = None) -> NormalPrior:
        """Predict the surface normals of an undistorted image.

        Args:
            view: Undistorted image with its camera.
            depth: Depth prior of the image with variance if the provider has the capability
                ``needs-depth``, else None.

        Returns:
            Unit normals (h, w, 3) float32 in the camera frame that face the camera. Optional
            variance (h, w) float32 of the normal's angle in rad^2. Validity (h, w) bool of the
            normals. The normal map covers the image and may have any resolution.
        """
        ...


def run_normals(
    spec: ProviderSpec, provider: NormalsProvider, view: View, depth: DepthPrior | None = None
) -> NormalPrior:
    """Predict the normals of an image and validate the normal prior.

    The provider receives the prior ``depth`` only if it has the capability ``needs-depth``.
    """
    given = depth if "needs-depth" in spec.capabilities else None
    with provider_errors(spec, view.name):
        return validate_normals(spec, view, provider.predict(view, given))


def validate_normals(spec: ProviderSpec, view: View, output: object) -> NormalPrior:
    """Validate that predicted normals are unit vectors that face the camera.

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
        prior = revalidate(output, NormalPrior, "normals")
        require_not_empty(prior.shape, "normals")
        _require_facing(prior, view.camera)
        if prior.variance is None:
            if spec.kind == "normals":
                require_undeclared(spec, "variance", "variance")
        elif prior.valid.any():
            median = float(np.median(prior.variance[prior.valid]))
            if median > MAX_MEDIAN_NORMAL_VARIANCE:
                raise DataError(
                    "variance", f"the variance must be in rad^2, but its median is {median:.3g}"
                )
        return prior


def _require_facing(prior: NormalPrior, camera: PinholeCamera) -> None:
    facing_away = (dot_with_rays(camera, prior.normals) > FACING_TOLERANCE)[prior.valid]
    if facing_away.any():
        ratio = f"{100 * facing_away.mean():.3g} % of the valid pixels"
        raise DataError("normals", f"normals must face the camera (n . ray < 0), not so at {ratio}")


KIND = ProviderKind(
    name="normals",
    title="Normals",
    protocol=NormalsProvider,
    checks="mpsfm_core.testing.checks.normals:CHECKS",
    capabilities={
        "variance": "The depth or normals have a variance that the network predicts.",
        "needs-depth": "The normals provider requires the depth prior of the image.",
    },
    predicts_maps=True,
)
