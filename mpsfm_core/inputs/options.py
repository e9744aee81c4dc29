"""Settings of the inputs room."""

from __future__ import annotations

from pathlib import Path

from pydantic import Field

from mpsfm_core.data.options import Options


class VideoOptions(Options):
    """Which frames of a video become photos."""

    motion: float = Field(0.08, gt=0, lt=1)
    """The next frame is taken when points have moved by this share of the diagonal (ours: about
    what 3 to 5 degrees of a phone's turn move them)."""
    overlap: float = Field(0.7, gt=0, lt=1)
    """... or when only this share of them is still seen."""
    max_frames: int = Field(300, ge=2)
    """Of more frames evenly spread ones are taken."""


class InputOptions(Options):
    """How photos become views."""

    max_image_size: int | None = Field(None, ge=32)
    """Longer side in pixels to which larger images are reduced, null keeps their size (the paper's
    evaluation; the published command reduces to 1200)."""
    max_pixels: int = Field(250_000_000, ge=1024)
    """Larger photos and masks are refused before they are decoded: a file of a few kilobytes can
    stand for gigabytes (ours: above every camera, 0.75 GB decoded)."""
    strict: bool = False
    """A damaged photo ends the run; else it is left out, with a warning and the reason in the
    summary, as long as no more than half of the photos are damaged."""
    masks: Path | None = None
    """Folder of masks of the original images, ``NAME.png`` or the name with ``.png`` for its own
    extension; black pixels are not used (COLMAP's convention)."""
    default_focal_ratio: float = Field(1.2, gt=0)
    """Focal length over the longer side when nothing is known (COLMAP:
    default_focal_length_factor)."""
    blank_pixels: float = Field(0.0, ge=0, le=1)
    """Undistortion: 0 keeps only the area that is seen everywhere, 1 keeps every original pixel
    with empty (masked) corners (COLMAP's option and default)."""
    video: VideoOptions = Field(default_factory=VideoOptions)
    """Of a video instead of photos."""
