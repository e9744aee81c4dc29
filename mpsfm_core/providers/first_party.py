"""Tables of the pip packages that contain this project's plugins, for install advice."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

_ONNX = ("onnx", "onnx-joint", "moge-2-small")
_METRIC3D = ("metric3d-v2-small", "metric3d-v2-large", "metric3d-v2-giant2")

PLUGIN_PROVIDERS: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {
        "mpsfm-compact": ("depth/compact", "normals/compact", "mask/compact", "camera/compact"),
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
"""Providers, as ``kind/name``, that each pip requirement of this project installs."""

EXECUTORS: Mapping[str, str] = MappingProxyType({"dask": "mpsfm-dask", "ray": "mpsfm-ray"})
"""Pip package of each executor, which distributes extraction and mapping, by executor name."""

VIEWERS: Mapping[str, str] = MappingProxyType({"viser": "mpsfm-viser", "rerun": "mpsfm-rerun"})
"""Pip package that contains a live viewer, by the name of the viewer."""

EXPORTS: Mapping[str, str] = MappingProxyType({"rerun": "mpsfm-rerun"})
"""Pip package that contains an export format, by the name of the format."""


def install_hint(distributions: Mapping[str, str], name: str) -> str:
    """Return the pip command for a missing plugin as the end of a message, or an empty string.

    Args:
        distributions: Pip package by plugin name, such as the table :data:`VIEWERS`.
        name: Name of the executor, viewer or export format.
    """
    return f"; pip install {distributions[name]}" if name in distributions else ""


def requirement_for(kind: str, name: str) -> str:
    """Return the pip requirement that installs a provider of this project, or an empty string."""
    provider = f"{kind}/{name}"
    return next((r for r, provided in PLUGIN_PROVIDERS.items() if provider in provided), "")
