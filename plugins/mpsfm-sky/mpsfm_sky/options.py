"""What a user can set. Imports nothing heavy."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from mpsfm_core import Options, WeightsFile

SKYSEG = WeightsFile("hf://JianyuanWang/skyseg@main/skyseg.onnx", license="MIT")
"""The reference's network, from where the authors of VGGT take it; its hash is recorded."""


class SkyOptions(Options):
    """A sky segmentation network in an ONNX file."""

    model: str = SKYSEG.uri
    """Path or URI."""
    network: Literal["skyseg", "skysegsmall"] = "skyseg"
    """How it wants the image: ``skyseg`` 320 x 320, normalised (the reference's); ``skysegsmall``
    384 x 384 with values in 0..1, normalised inside."""
    sha256: str | None = None
    """Expected hash of ``model``."""
    threshold: float = Field(0.5, gt=0, lt=1)
    """Pixels that are more probably sky are not used (reference)."""


class SimpleSkyOptions(Options):
    """Smooth, bright or blue regions at the upper border (all defaults ours, chosen on the photos
    that the README names)."""

    brightness: float = Field(0.6, ge=0, le=1)
    """Mean of the channels from which on a pixel that is not warm may be sky."""
    warmth: float = Field(0.05, ge=0, le=1)
    """How much more red than blue it may have."""
    blueness: float = Field(0.1, ge=0, le=1)
    """How much more blue than red makes a darker pixel sky."""
    roughness: float = Field(0.02, gt=0)
    """Largest step of brightness to a neighbour, on an image of 256 pixels."""
    min_share: float = Field(0.005, ge=0, le=1)
    """Regions smaller than this share of the image are no sky."""
