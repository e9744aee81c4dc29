"""Options of the providers; imports nothing heavy."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from mpsfm_core import Options, WeightsFile

SKYSEG = WeightsFile("hf://JianyuanWang/skyseg@main/skyseg.onnx", license="MIT")
"""Network of the reference, from the source that VGGT's authors use; its hash is recorded."""


class SkyOptions(Options):
    """Options of a sky segmentation network in an ONNX file."""

    model: str = SKYSEG.uri
    """Path or URI."""
    network: Literal["skyseg", "skysegsmall"] = "skyseg"
    """Preprocessing: ``skyseg`` 320 x 320, normalized [reference]; ``skysegsmall`` 384 x 384, 0..1.
    """
    sha256: str | None = None
    """Expected hash of ``model``."""
    threshold: float = Field(0.5, gt=0, lt=1)
    """Sky probability above which a pixel is masked. [reference]"""


class SimpleSkyOptions(Options):
    """Options of the rule-based mask.

    All defaults are tuned on the photos of the README. [ours]
    """

    brightness: float = Field(0.6, ge=0, le=1)
    """Minimum mean of the channels of bright sky."""
    warmth: float = Field(0.05, ge=0, le=1)
    """Maximum red minus blue of bright sky."""
    blueness: float = Field(0.1, ge=0, le=1)
    """Minimum blue minus red of darker sky."""
    roughness: float = Field(0.02, gt=0)
    """Maximum brightness step to a neighbor, in an image of 256 pixels."""
    min_share: float = Field(0.005, ge=0, le=1)
    """Minimum area of a sky region as a share of the image."""
