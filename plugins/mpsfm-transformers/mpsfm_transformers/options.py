"""Options and the table of known models; imports nothing heavy."""

from __future__ import annotations

from dataclasses import dataclass
from fnmatch import fnmatch
from pathlib import Path
from typing import Literal

from pydantic import Field

from mpsfm_core import Options, WeightsFile
from mpsfm_core.providers.uncertainty.calibration import DepthCalibration

CONFIG, PROCESSOR, WEIGHTS = "config.json", "preprocessor_config.json", "model.safetensors"
FILES = (CONFIG, PROCESSOR, WEIGHTS)

Output = Literal["depth", "disparity"]

METRIC = DepthCalibration(std_scale=1.0, relative_std=0.079)
"""Calibration of metric models. [reference, for Depth Anything V2 of size L on Virtual KITTI]"""
DEPTH_PRO = DepthCalibration(std_scale=1.0, relative_std=0.0875)
"""Calibration of Depth Pro. [reference]"""
RELATIVE = DepthCalibration(std_scale=1.0, relative_std=0.16, shift_space="disparity")
"""Calibration of relative models, twice that of metric ones because of the unknown shift. [assumed]
"""


@dataclass(frozen=True)
class KnownModel:
    """KnownModel properties of models whose name matches ``pattern``.

    ``license``: license of the weights, from their model card. ``output``, ``metric``: only if the
    model's ``config.json`` does not define them.
    """

    pattern: str
    license: str
    calibration: DepthCalibration = METRIC
    output: Output | None = None
    metric: bool | None = None


_NON_COMMERCIAL = "CC-BY-NC-4.0"
_MAGIC_LEAP = "Magic Leap: non-commercial research only"
KNOWN = (
    KnownModel("depth-anything/Depth-Anything-V2-Metric-*-Small-hf", "Apache-2.0"),
    KnownModel("depth-anything/Depth-Anything-V2-Metric-*", _NON_COMMERCIAL),
    KnownModel("depth-anything/Depth-Anything-V2-Small-hf", "Apache-2.0", RELATIVE),
    KnownModel("depth-anything/Depth-Anything-V2-*", _NON_COMMERCIAL, RELATIVE),
    KnownModel("LiheYoung/depth-anything-*", "Apache-2.0", RELATIVE),
    KnownModel("apple/DepthPro-hf", "Apple ML research terms", DEPTH_PRO),
    KnownModel("Intel/zoedepth-*", "MIT"),
    KnownModel("facebook/dpt-dinov2-*-nyu", "Apache-2.0", output="depth", metric=True),
    KnownModel("facebook/dpt-dinov2-*-kitti", "Apache-2.0", output="depth", metric=True),
    KnownModel("Intel/dpt-*", "Apache-2.0 or MIT, see its card", RELATIVE),
    KnownModel("magic-leap-community/*", _MAGIC_LEAP),
    KnownModel("ETH-CVG/lightglue_superpoint", f"Apache-2.0; its SuperPoint {_MAGIC_LEAP}"),
    KnownModel("zju-community/efficientloftr", "Apache-2.0"),
    KnownModel("facebook/dinov2-*", "Apache-2.0"),
    KnownModel("facebook/dinov3-*", "DINOv3 License"),
)
"""Table of known models; the first match counts."""


def look_up_model(model: str) -> KnownModel:
    """Look up the known properties of a model by its name."""
    name = model.partition("@")[0]
    unknown = KnownModel("*", "of the chosen model, see its card", RELATIVE)
    return next((entry for entry in KNOWN if fnmatch(name, entry.pattern)), unknown)


class HubOptions(Options):
    """Options of a model of the Hub, or of a folder with a model.

    Only ``config.json``, ``preprocessor_config.json`` and safetensors are read; no code of a
    repository is executed.
    """

    model: str
    """``ORG/NAME@REVISION``, a folder, or ``ORG/NAME``. Without a revision the hash of the first
    download is recorded, and another version is refused later.
    """
    sha256: str | None = None
    """Expected hash of ``model.safetensors``."""

    @property
    def folder(self) -> Path | None:
        """Return the folder with the model, or None for a model of the Hub."""
        path = Path(self.model).expanduser()
        return path if path.is_dir() or self.model.startswith((".", "/", "~")) else None

    def uris(self) -> tuple[str, ...]:
        """Return the addresses of :data:`FILES`."""
        if self.folder is not None:
            return tuple(str(self.folder / name) for name in FILES)
        repository, _, revision = self.model.partition("@")
        return tuple(f"hf://{repository}@{revision or 'main'}/{name}" for name in FILES)

    def files(self) -> tuple[WeightsFile, ...]:
        """Return :data:`FILES` as weights to locate or download."""
        license = look_up_model(self.model).license
        hashes = (None, None, self.sha256)
        return tuple(
            WeightsFile(uri, sha256, license)
            for uri, sha256 in zip(self.uris(), hashes, strict=True)
        )


class DepthOptions(HubOptions):
    """Options of models for depth estimation."""

    model: str = "depth-anything/Depth-Anything-V2-Metric-Indoor-Small-hf"
    output: Output | None = None
    """Output of the model; null: from ``config.json`` and the table of known models."""
    metric: bool | None = None
    """True if the output is in meters; null: as for ``output``."""


class PromptOptions(HubOptions):
    """Options of Prompt Depth Anything (CVPR 2025), which refines sensor depth."""

    model: str = "depth-anything/prompt-depth-anything-vits-hf"
    directory: Path
    """Folder with the depth maps of the sensor, as for ``files``; holes are filled for the network.
    """
    suffix: str | None = None
    """Suffix of the file names, as for ``files``."""
    scale: float = Field(1.0, gt=0)
    """Meters per stored unit: 0.001 for millimeters."""


class SuperPointOptions(HubOptions):
    """Options of SuperPoint (2018), 256 dimensions."""

    model: str = "magic-leap-community/superpoint"
    max_keypoints: int = Field(6000, gt=0)
    """Number of keypoints with the highest score to keep. [reference]"""
    resize: int | None = Field(1600, ge=32)
    """Longer side for detection in pixels, never enlarged; null: the size of the view. [reference]
    """
    detection_threshold: float | None = Field(None, ge=0, lt=1)
    """Minimum score; null: the threshold of the model (0.005 for the published one)."""


class SparseOptions(HubOptions):
    """Options of LightGlue and SuperGlue."""

    min_score: float | None = Field(None, ge=0, lt=1)
    """Minimum score of a match; null: the threshold of the model."""


class LightGlueOptions(SparseOptions):
    """Options of LightGlue (ICCV 2023)."""

    model: str = "ETH-CVG/lightglue_superpoint"
    depth_confidence: float = Field(-1.0, le=1)
    """Stop early above this share of confident points; -1: never. [reference]"""
    width_confidence: float = Field(-1.0, le=1)
    """Drop points that are unmatchable with this confidence; -1: never. [reference]"""


class SuperGlueOptions(SparseOptions):
    """Options of SuperGlue (CVPR 2020)."""

    model: str = "magic-leap-community/superglue_outdoor"


class EfficientLoftrOptions(HubOptions):
    """Options of Efficient LoFTR (CVPR 2024)."""

    model: str = "zju-community/efficientloftr"
    resize: int = Field(1184, ge=64)
    """Longer side in pixels, never enlarged. [published evaluation on MegaDepth]"""
    min_score: float | None = Field(None, ge=0, lt=1)
    """Minimum score of a coarse match; null: the threshold of the model."""


class DinoOptions(HubOptions):
    """Options of DINOv2, DINOv3 and models of the same architecture."""

    model: str = "facebook/dinov2-small"
    resize: int = Field(336, ge=32)
    """Longer side in pixels; the whole view is used, not its center."""


def hub_files(options: HubOptions) -> tuple[WeightsFile, ...]:
    """Return the weights for ``ProviderSpec.weights``."""
    return options.files()
