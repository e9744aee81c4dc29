"""Options of reading images and videos."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from pydantic import Field

from mpsfm_core.data.options import Options, expert


class VideoOptions(Options):
    """Options of choosing frames of a video."""

    motion: float = expert(0.08, gt=0, lt=1)
    """Median motion of tracked points to the next frame, as a share of the diagonal. Larger values
    give fewer frames [3 to 5 degrees of rotation of a phone]."""
    overlap: float = expert(0.7, gt=0, lt=1)
    """Share of tracked points below which the next frame is chosen. Larger values give more
    frames."""
    max_frames: int = Field(300, ge=2)
    """Maximum number of frames. Above it, evenly spaced frames are chosen."""


class InputOptions(Options):
    """Options of reading and undistorting images."""

    max_image_size: int | None = Field(None, ge=32)
    """Longer side in pixels to which larger images are reduced; null keeps the size [paper 4]. The
    reference command uses 1200. Larger values give more accurate keypoints and take more time."""
    max_pixels: int = expert(250_000_000, ge=1024)
    """Maximum number of pixels of an image or mask. Larger files are refused before decoding,
    because a small file can decode to gigabytes [above all cameras on the market]."""
    strict: bool = False
    """True: a damaged image ends the run. False: damaged images are left out with a warning, unless
    more than half are damaged."""
    masks: Path | None = None
    """Folder of masks of the original images: ``X.jpg.png``, ``X.png``, ``X_mask.png`` or ``X.jpg``
    for the image ``X.jpg``. Black pixels are not used [COLMAP mask_path]."""
    mask_orientation: Literal["auto", "stored", "upright"] = expert("auto")
    """Orientation of masks of images with an EXIF orientation if their size does not decide.
    ``stored``: as the stored pixels; ``upright``: as the image is displayed; ``auto``: as the masks
    whose size decides, else stored [COLMAP, which ignores EXIF orientation]."""
    default_focal_ratio: float = expert(1.2, gt=0)
    """Ratio of focal length to longer side for images without a known focal length [COLMAP
    default_focal_length_factor]."""
    blank_pixels: float = expert(0.0, ge=0, le=1)
    """Share of blank pixels after undistortion: 0 crops to valid pixels, 1 keeps all original
    pixels and masks blank corners [COLMAP blank_pixels]."""
    video: VideoOptions = Field(default_factory=VideoOptions)
    """Options for a video as input."""
