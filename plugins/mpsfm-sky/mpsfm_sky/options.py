"""Options of the sky mask providers, importable without onnxruntime."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from mpsfm_core import Options, WeightsFile

SKYSEG = WeightsFile("hf://JianyuanWang/skyseg@main/skyseg.onnx", license="MIT")
"""Sky network of the reference implementation, from the source that VGGT's authors use."""


class SkyOptions(Options):
    """Options of a sky segmentation network in an ONNX file."""

    model: str = SKYSEG.uri
    """Path or URI of the ONNX file of the sky network."""
    network: Literal["skyseg", "skysegsmall"] = "skyseg"
    """Name of the image preprocessing that the network requires. ``skyseg`` resizes to 320 x 320
    pixels and normalizes by the mean and std of ImageNet [reference]. ``skysegsmall`` resizes to
    384 x 384 pixels with values in 0..1.
    """
    sha256: str | None = None
    """Expected SHA-256 hash of the file ``model``."""
    threshold: float = Field(0.5, gt=0, lt=1)
    """Sky probability above which a pixel is masked. A higher threshold masks fewer pixels.
    [reference]"""


class SimpleSkyOptions(Options):
    """Options of the rule-based sky mask, which needs no network.

    All defaults were tuned on the images that the README lists.
    """

    brightness: float = Field(0.6, ge=0, le=1)
    """Minimum mean of the RGB channels (0..1) of bright sky."""
    warmth: float = Field(0.05, ge=0, le=1)
    """Maximum difference of red minus blue (0..1) of bright sky."""
    blueness: float = Field(0.1, ge=0, le=1)
    """Minimum difference of blue minus red (0..1) of darker sky."""
    roughness: float = Field(0.02, gt=0)
    """Maximum difference in brightness (0..1) between adjacent sky pixels, after resizing the image
    to a longer side of 256 pixels."""
    min_share: float = Field(0.005, ge=0, le=1)
    """Minimum area of a sky region relative to the area of the image."""
