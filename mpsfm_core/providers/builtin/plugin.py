"""Plugin module that registers the built-in providers, which need no network weights.

The module imports no provider code, so that listing the providers is fast.
"""

from __future__ import annotations

from mpsfm_core.providers import ProviderSpec, hookimpl
from mpsfm_core.providers.uncertainty.calibration import DepthCalibration, NormalCalibration

FLAT_CALIBRATION = DepthCalibration(relative_std=0.5)
"""Depth uncertainty of the plane that replaces a missing depth map. The mapper estimates equal
poses for a relative std from 0.3 to 0.5, and worse poses for 1.0. [tuned: sample scene]"""
FROM_DEPTH_CALIBRATION = NormalCalibration(std_scale=1.0, std_floor_deg=1.0)
"""Calibration of normals that are fitted to depth maps. The angular std that the plane fit predicts
is raised to at least 1 degree."""

_LICENSE = "Apache-2.0"


@hookimpl
def mpsfm_providers() -> list[ProviderSpec]:
    """Return the specifications of the built-in providers."""
    return [*_matching(), *_depth(), *_normals(), *_masks()]


def _matching() -> list[ProviderSpec]:
    return [
        ProviderSpec(
            kind="features",
            name="sift",
            factory="mpsfm_core.providers.builtin.sift:Sift",
            options="mpsfm_core.providers.builtin.options:SiftOptions",
            summary="RootSIFT of COLMAP on the CPU",
            requires=("pycolmap",),
            code_license=_LICENSE,
            tags=("sift",),
        ),
        ProviderSpec(
            kind="matcher",
            name="mutual-nearest",
            factory="mpsfm_core.providers.builtin.mutual_nearest:MutualNearest",
            options="mpsfm_core.providers.builtin.options:MutualNearestOptions",
            capabilities=frozenset({"sparse"}),
            summary="mutual nearest descriptors with ratio test, for any features",
            code_license=_LICENSE,
        ),
    ]


def _depth() -> list[ProviderSpec]:
    return [
        ProviderSpec(
            kind="depth",
            name="files",
            factory="mpsfm_core.providers.builtin.files:DepthFiles",
            options="mpsfm_core.providers.builtin.options:DepthFileOptions",
            capabilities=frozenset({"uncached"}),
            summary="depth maps of a sensor or any network, read from files",
            code_license=_LICENSE,
            contract="mpsfm_core.testing.builtin_contracts:depth_files",
            # The variance that the depth files or their options declare is used unchanged.
            calibration=DepthCalibration(std_scale=1.0, relative_std=0.0, std_floor=0.0),
        ),
        ProviderSpec(
            kind="depth",
            name="flat",
            factory="mpsfm_core.providers.builtin.constant_depth:ConstantDepth",
            summary="a plane parallel to the image: no prior at all, for photos with much overlap",
            code_license=_LICENSE,
            accuracy="none: it does not look at the photo (a network: pip install mpsfm-compact)",
            calibration=FLAT_CALIBRATION,
        ),
        ProviderSpec(
            kind="depth",
            name="matcher",
            factory="mpsfm_core.providers.builtin.delegated_depth:MatcherDepth",
            capabilities=frozenset({"uncached"}),
            summary="the depth that the matcher predicts for its pairs (pair-depth)",
            code_license=_LICENSE,
            contract="mpsfm_core.testing.builtin_contracts:depth_of_matcher",
            # [reference] The factor converts MASt3R's confidence to a depth std. The depth std has
            # no term that is proportional to depth.
            calibration=DepthCalibration(std_scale=0.862, relative_std=0.0),
        ),
        ProviderSpec(
            kind="depth",
            name="multiview",
            factory="mpsfm_core.providers.builtin.delegated_depth:MultiViewDepth",
            capabilities=frozenset({"uncached"}),
            summary="the depth of the multi-view network, which sees several photos at once",
            code_license=_LICENSE,
            contract="mpsfm_core.testing.builtin_contracts:depth_of_multiview",
        ),
    ]


def _normals() -> list[ProviderSpec]:
    return [
        ProviderSpec(
            kind="normals",
            name="files",
            factory="mpsfm_core.providers.builtin.files:NormalFiles",
            options="mpsfm_core.providers.builtin.options:NormalFileOptions",
            capabilities=frozenset({"uncached"}),
            summary="normal maps read from files",
            code_license=_LICENSE,
            contract="mpsfm_core.testing.builtin_contracts:normal_files",
            calibration=NormalCalibration(std_scale=1.0, std_floor_deg=0.0),
        ),
        ProviderSpec(
            kind="normals",
            name="from-depth",
            factory="mpsfm_core.providers.builtin.normals_from_depth:NormalsFromDepth",
            options="mpsfm_core.providers.builtin.options:NormalsFromDepthOptions",
            capabilities=frozenset({"needs-depth", "variance", "intrinsics-aware"}),
            summary="normals of planes fitted to the depth prior",
            code_license=_LICENSE,
            contract="mpsfm_core.testing.builtin_contracts:from_depth",
            calibration=FROM_DEPTH_CALIBRATION,
        ),
    ]


def _masks() -> list[ProviderSpec]:
    return [
        ProviderSpec(
            kind="mask",
            name="files",
            factory="mpsfm_core.providers.builtin.files:MaskFiles",
            options="mpsfm_core.providers.builtin.options:MaskFileOptions",
            capabilities=frozenset({"uncached"}),
            summary="masks read from image files",
            code_license=_LICENSE,
            contract="mpsfm_core.testing.builtin_contracts:mask_files",
        ),
    ]
