"""Registration of the Depth Anything 3 provider, without heavy imports."""

from __future__ import annotations

from mpsfm_core import ProviderSpec, hookimpl
from mpsfm_core.providers.uncertainty.calibration import DepthCalibration
from mpsfm_depth_anything_3.options import LICENSES, DepthAnything3Options, weights


@hookimpl
def mpsfm_providers() -> list[ProviderSpec]:
    """Register the provider of depth, poses and intrinsics for groups of images."""
    return [
        ProviderSpec(
            kind="multiview",
            name="depth-anything-3",
            factory="mpsfm_depth_anything_3.provider:DepthAnything3",
            options=DepthAnything3Options,
            capabilities=frozenset({"variance", "proposes-poses", "proposes-intrinsics"}),
            summary="Depth Anything 3: depth, poses and intrinsics of photo groups",
            requires=("torch", "depth_anything_3"),
            install_hint="pip install --no-deps depth-anything-3 (most of its dependencies are "
            "not needed)",
            code_license="Apache-2.0",
            weights_license=f"{LICENSES['da3-small']} (small, base), {LICENSES['da3-large']}",
            weights=weights,
            # [assumed: the depth variance was not calibrated, because the weights were not
            # available]
            calibration=DepthCalibration(std_scale=1.0, relative_std=0.05),
            contract="mpsfm_depth_anything_3.contract:contract",
        )
    ]
