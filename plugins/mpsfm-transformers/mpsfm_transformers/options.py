"""What a user can set, and what is known of models by name. Imports nothing heavy."""

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
"""Reference, for Depth Anything V2 of size L on Virtual KITTI; others have not been measured."""
DEPTH_PRO = DepthCalibration(std_scale=1.0, relative_std=0.0875)
"""Reference."""
RELATIVE = DepthCalibration(std_scale=1.0, relative_std=0.16, shift_space="disparity")
"""A guess: twice the metric networks', for the shift that inverse depth lacks; fit it."""


@dataclass(frozen=True)
class Known:
    """What is known of the models whose name fits ``pattern``.

    ``license``: of the weights, from their model card. ``output``, ``metric``: only where the
    model's ``config.json`` does not say.
    """

    pattern: str
    license: str
    calibration: DepthCalibration = METRIC
    output: Output | None = None
    metric: bool | None = None


_NON_COMMERCIAL = "CC-BY-NC-4.0"
_MAGIC_LEAP = "Magic Leap: non-commercial research only"
KNOWN = (
    Known("depth-anything/Depth-Anything-V2-Metric-*-Small-hf", "Apache-2.0"),
    Known("depth-anything/Depth-Anything-V2-Metric-*", _NON_COMMERCIAL),
    Known("depth-anything/Depth-Anything-V2-Small-hf", "Apache-2.0", RELATIVE),
    Known("depth-anything/Depth-Anything-V2-*", _NON_COMMERCIAL, RELATIVE),
    Known("LiheYoung/depth-anything-*", "Apache-2.0", RELATIVE),
    Known("apple/DepthPro-hf", "Apple ML research terms", DEPTH_PRO),
    Known("Intel/zoedepth-*", "MIT"),
    Known("facebook/dpt-dinov2-*-nyu", "Apache-2.0", output="depth", metric=True),
    Known("facebook/dpt-dinov2-*-kitti", "Apache-2.0", output="depth", metric=True),
    Known("Intel/dpt-*", "Apache-2.0 or MIT, see its card", RELATIVE),
    Known("magic-leap-community/*", _MAGIC_LEAP),
    Known("ETH-CVG/lightglue_superpoint", f"Apache-2.0; its SuperPoint {_MAGIC_LEAP}"),
    Known("zju-community/efficientloftr", "Apache-2.0"),
    Known("facebook/dinov2-*", "Apache-2.0"),
    Known("facebook/dinov3-*", "DINOv3 License"),
)
"""The first that fits counts."""


def known(model: str) -> Known:
    """What is known of a model by its name."""
    name = model.partition("@")[0]
    unknown = Known("*", "of the chosen model, see its card", RELATIVE)
    return next((entry for entry in KNOWN if fnmatch(name, entry.pattern)), unknown)


class HubOptions(Options):
    """A model of the Hub, or a folder with one.

    The files are ``config.json``, ``preprocessor_config.json`` and safetensors; nothing else of a
    repository is read, and none of its code is run.
    """

    model: str
    """``ORG/NAME@REVISION``; a folder; or ``ORG/NAME``, whose first download is recorded by its
    hash, so that another version is refused later."""
    sha256: str | None = None
    """Expected hash of ``model.safetensors``."""

    @property
    def folder(self) -> Path | None:
        """The folder with the model, None for one of the Hub."""
        path = Path(self.model).expanduser()
        return path if path.is_dir() or self.model.startswith((".", "/", "~")) else None

    def uris(self) -> tuple[str, ...]:
        """Where :data:`FILES` are."""
        if self.folder is not None:
            return tuple(str(self.folder / name) for name in FILES)
        repository, _, revision = self.model.partition("@")
        return tuple(f"hf://{repository}@{revision or 'main'}/{name}" for name in FILES)

    def files(self) -> tuple[WeightsFile, ...]:
        """:data:`FILES`, as a run has to find or fetch them."""
        license = known(self.model).license
        hashes = (None, None, self.sha256)
        return tuple(
            WeightsFile(uri, sha256, license)
            for uri, sha256 in zip(self.uris(), hashes, strict=True)
        )


class DepthOptions(HubOptions):
    """Any model for depth estimation."""

    model: str = "depth-anything/Depth-Anything-V2-Metric-Indoor-Small-hf"
    output: Output | None = None
    """What the model predicts; null asks its ``config.json`` and the table of known models."""
    metric: bool | None = None
    """Whether that is in metres; null as above."""


class PromptOptions(HubOptions):
    """Prompt Depth Anything (CVPR 2025): a network that refines the depth of a sensor."""

    model: str = "depth-anything/prompt-depth-anything-vits-hf"
    directory: Path
    """Folder with the sensor's depth maps, read as by ``files``; holes are filled from beside
    them for the network."""
    suffix: str | None = None
    """Of the maps' names, as of ``files``."""
    scale: float = Field(1.0, gt=0)
    """Metres per stored unit: 0.001 for millimetres."""


class SuperPointOptions(HubOptions):
    """SuperPoint (2018), 256 dimensions."""

    model: str = "magic-leap-community/superpoint"
    max_keypoints: int = Field(6000, gt=0)
    """The strongest are kept (reference)."""
    resize: int | None = Field(1600, ge=32)
    """Longer side in pixels at which to detect, never enlarged (reference); null keeps the
    view's."""
    detection_threshold: float | None = Field(None, ge=0, lt=1)
    """Score to exceed; null for the model's own (0.005 of the published one)."""


class SparseOptions(HubOptions):
    """What LightGlue and SuperGlue share."""

    min_score: float | None = Field(None, ge=0, lt=1)
    """Smallest score of a match; null for the model's own."""


class LightGlueOptions(SparseOptions):
    """LightGlue (ICCV 2023)."""

    model: str = "ETH-CVG/lightglue_superpoint"
    depth_confidence: float = Field(-1.0, le=1)
    """Stop early above this share of confident points; -1 never (reference setting)."""
    width_confidence: float = Field(-1.0, le=1)
    """Drop points that are this certainly unmatchable; -1 never (reference setting)."""


class SuperGlueOptions(SparseOptions):
    """SuperGlue (CVPR 2020)."""

    model: str = "magic-leap-community/superglue_outdoor"


class EfficientLoftrOptions(HubOptions):
    """Efficient LoFTR (CVPR 2024)."""

    model: str = "zju-community/efficientloftr"
    resize: int = Field(1184, ge=64)
    """Longer side in pixels, never enlarged (published evaluation on MegaDepth)."""
    min_score: float | None = Field(None, ge=0, lt=1)
    """Smallest score of a coarse match; null for the model's own."""


class DinoOptions(HubOptions):
    """DINOv2 and DINOv3 and what is built as they are."""

    model: str = "facebook/dinov2-small"
    resize: int = Field(336, ge=32)
    """Longer side in pixels (as ``global-onnx``: the whole view, not the centre of it)."""


def hub_files(options: HubOptions) -> tuple[WeightsFile, ...]:
    """For ``ProviderSpec.weights``."""
    return options.files()
