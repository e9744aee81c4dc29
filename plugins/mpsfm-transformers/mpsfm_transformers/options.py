"""Options and table of known models, importable without torch."""

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
"""Variance calibration of depth models that predict meters.
[reference, for Depth Anything V2 of size L on Virtual KITTI]"""
DEPTH_PRO = DepthCalibration(std_scale=1.0, relative_std=0.0875)
"""Variance calibration of Depth Pro. [reference]"""
RELATIVE = DepthCalibration(std_scale=1.0, relative_std=0.16, shift_space="disparity")
"""Variance calibration of models that predict depth of unknown scale and shift. The depth std of
models with unknown shift is assumed to be twice that of metric models.
"""


@dataclass(frozen=True)
class KnownModel:
    """Properties of all models whose name matches ``pattern``.

    ``license`` is the license of the weights, from their model card. ``output`` and ``metric`` are
    set only if the model's ``config.json`` does not define them.
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
"""Table of known models. A model has the properties of the first entry whose pattern matches its
name."""


def look_up_model(model: str) -> KnownModel:
    """Return the known properties of a model by its name."""
    name = model.partition("@")[0]
    unknown = KnownModel("*", "of the chosen model, see its card", RELATIVE)
    return next((entry for entry in KNOWN if fnmatch(name, entry.pattern)), unknown)


class HubOptions(Options):
    """Options of a model on the Hugging Face Hub or in a local folder.

    Only ``config.json``, ``preprocessor_config.json`` and safetensors are read, and no code of a
    model repository is executed.
    """

    model: str
    """Name of the model, which is ``ORG/NAME@REVISION``, ``ORG/NAME``, or a folder. Without a
    revision, the hash of the first download is recorded, and a file with another hash is rejected
    later.
    """
    sha256: str | None = None
    """Expected SHA-256 hash of the file ``model.safetensors``."""

    @property
    def folder(self) -> Path | None:
        """Return the local folder of the model, or None for a model on the Hub."""
        path = Path(self.model).expanduser()
        return path if path.is_dir() or self.model.startswith((".", "/", "~")) else None

    def uris(self) -> tuple[str, ...]:
        """Return the URIs of the model files :data:`FILES`."""
        if self.folder is not None:
            return tuple(str(self.folder / name) for name in FILES)
        repository, _, revision = self.model.partition("@")
        return tuple(f"hf://{repository}@{revision or 'main'}/{name}" for name in FILES)

    def files(self) -> tuple[WeightsFile, ...]:
        """Return the model files :data:`FILES` with hash and license, for download."""
        license = look_up_model(self.model).license
        hashes = (None, None, self.sha256)
        return tuple(
            WeightsFile(uri, sha256, license)
            for uri, sha256 in zip(self.uris(), hashes, strict=True)
        )


class DepthOptions(HubOptions):
    """Options of a depth estimation model."""

    model: str = "depth-anything/Depth-Anything-V2-Metric-Indoor-Small-hf"
    output: Output | None = None
    """Quantity that the model predicts. null reads it from ``config.json`` or the table of known
    models."""
    metric: bool | None = None
    """True if the output is in meters. null reads it from ``config.json`` or the table of known
    models."""


class PromptOptions(HubOptions):
    """Options of Prompt Depth Anything (CVPR 2025), which refines sensor depth."""

    model: str = "depth-anything/prompt-depth-anything-vits-hf"
    directory: Path
    """Folder with sensor depth maps, as for the provider ``files``. Holes in the depth maps are
    filled before inference.
    """
    suffix: str | None = None
    """Suffix of the depth file names, as for the provider ``files``."""
    scale: float = Field(1.0, gt=0)
    """Meters per stored unit of depth, 0.001 for millimeters."""


class SuperPointOptions(HubOptions):
    """Options of the SuperPoint detector (2018), which has 256-dimensional descriptors."""

    model: str = "magic-leap-community/superpoint"
    max_keypoints: int = Field(6000, gt=0)
    """Maximum number of keypoints, selected by score. [reference]"""
    resize: int | None = Field(1600, ge=32)
    """Longer side of the resized image in pixels for detection. Images are never enlarged, and null
    keeps their size. [reference]
    """
    detection_threshold: float | None = Field(None, ge=0, lt=1)
    """Minimum score of a keypoint. null selects the threshold of the model (published: 0.005)."""


class SparseOptions(HubOptions):
    """Options that LightGlue and SuperGlue share."""

    min_score: float | None = Field(None, ge=0, lt=1)
    """Minimum score of a match. null selects the threshold in the model's ``config.json``."""


class LightGlueOptions(SparseOptions):
    """Options of the LightGlue matcher (ICCV 2023)."""

    model: str = "ETH-CVG/lightglue_superpoint"
    depth_confidence: float = Field(-1.0, le=1)
    """Share of keypoints with confident predictions at which LightGlue stops before its last layer.
    -1 disables early stopping. [reference]"""
    width_confidence: float = Field(-1.0, le=1)
    """Confidence at which LightGlue drops a keypoint as unmatchable. -1 keeps all keypoints.
    [reference]"""


class SuperGlueOptions(SparseOptions):
    """Options of the SuperGlue matcher (CVPR 2020)."""

    model: str = "magic-leap-community/superglue_outdoor"


class EfficientLoftrOptions(HubOptions):
    """Options of the Efficient LoFTR matcher (CVPR 2024)."""

    model: str = "zju-community/efficientloftr"
    resize: int = Field(1184, ge=64)
    """Longer side of the resized images in pixels. Images are never enlarged."""
    min_score: float | None = Field(None, ge=0, lt=1)
    """Minimum score of a coarse match. null selects the threshold of the model."""


class DinoOptions(HubOptions):
    """Options of DINOv2, DINOv3 and models of the same architecture, for image retrieval."""

    model: str = "facebook/dinov2-small"
    resize: int = Field(336, ge=32)
    """Longer side of the network input in pixels. The network input shows the whole image, not only
    its center."""


def hub_files(options: HubOptions) -> tuple[WeightsFile, ...]:
    """Return the model files on the Hub or on disk that the options select."""
    return options.files()
