"""Where the providers of this project's own plugins come from: install hints, no more."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

_ONNX = ("onnx", "onnx-joint", "moge-2-small")
_METRIC3D = ("metric3d-v2-small", "metric3d-v2-large", "metric3d-v2-giant2")

PLUGIN_PROVIDERS: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {
        "mpsfm-compact": ("depth/compact", "normals/compact", "mask/compact"),
        "mpsfm-onnx": tuple(f"{k}/{n}" for k in ("depth", "normals") for n in _ONNX),
        "mpsfm-metric3d-onnx": tuple(f"{k}/{n}" for k in ("depth", "normals") for n in _METRIC3D),
        "mpsfm-dsine": ("normals/dsine",),
        "mpsfm-flip-consistency": ("wrapper/flip-consistency",),
        "mpsfm-kornia[weights]": (
            "features/xfeat",
            "features/aliked",
            "features/disk",
            "matcher/lighterglue",
            "matcher/lightglue-aliked",
            "matcher/lightglue-disk",
        ),
        "mpsfm-kornia": (
            "features/dedode",
            "features/kornia-sift",
            "matcher/lightglue-dedode",
            "matcher/adalam",
            "matcher/loftr",
        ),
        "mpsfm-lightglue-onnx": (
            "features/superpoint",
            "features/disk-onnx",
            "matcher/lightglue-superpoint",
            "matcher/lightglue-disk-onnx",
        ),
        "mpsfm-transformers": (
            "depth/transformers",
            "depth/prompt-depth-anything",
            "features/superpoint-hub",
            "matcher/lightglue-superpoint-hub",
            "matcher/superglue",
            "matcher/efficient-loftr",
            "retrieval/dino",
        ),
        "mpsfm-depth-anything-3": ("multiview/depth-anything-3",),
        "mpsfm-mast3r": ("matcher/mast3r", "matcher/mast3r-sparse"),
        "mpsfm-roma": ("matcher/roma", "matcher/roma-sparse"),
        "mpsfm-vismatch": tuple(
            f"matcher/vismatch{network}{how}"
            for network in ("", "-roma", "-mast3r")
            for how in ("", "-sparse")
        ),
        "mpsfm-retrieval": ("retrieval/appearance", "retrieval/global-onnx"),
        "mpsfm-sky": ("mask/sky", "mask/sky-simple"),
    }
)
"""Requirement for pip -> the providers that it brings, as ``kind/name``."""

EXECUTORS: Mapping[str, str] = MappingProxyType({"dask": "mpsfm-dask", "ray": "mpsfm-ray"})
"""Executor -> what to install for it."""

VIEWERS: Mapping[str, str] = MappingProxyType({"viser": "mpsfm-viser", "rerun": "mpsfm-rerun"})
"""Viewer -> what to install for it."""

EXPORTS: Mapping[str, str] = MappingProxyType({"rerun": "mpsfm-rerun"})
"""Format of an export -> what to install for it."""


def install_hint(homes: Mapping[str, str], name: str) -> str:
    """How to get what is named, as the end of a sentence; empty if it is none of ours.

    ``homes``: :data:`VIEWERS`, :data:`EXPORTS`.
    """
    return f"; pip install {homes[name]}" if name in homes else ""


def requirement_for(kind: str, name: str) -> str:
    """What to install for a provider, empty if it is none of ours."""
    provider = f"{kind}/{name}"
    return next((home for home, brought in PLUGIN_PROVIDERS.items() if provider in brought), "")
